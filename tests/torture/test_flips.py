"""Flipped bits in all that is written for runs and their caches: noticed, or harmless."""

import json
from collections import Counter
from pathlib import Path

import pytest

from tests.torture.conftest import SHORT, Record, Server
from tests.torture.test_kills import COMMON, Place

pytestmark = pytest.mark.slow

FLIPS = 60 if SHORT else 1000
TRANSFORMS = "dataparser_transforms.json"
KINDS = {
    *(f".cache/{name}" for name in ("evidence", "features", "regions", "texts")),
    *(f"normlift/{name}" for name in ("field.safetensors", "manifest.json", "queries.safetensors", "texts.npz")),
    *("config.yml", TRANSFORMS, "nerfstudio_models/*.ckpt", "splat.json", "transforms.json"),
}


def test_flipped_bits_are_noticed_or_harmless(server: Server, tmp_path: Path, record: Record) -> None:
    """Half of the runs came from a nerfstudio run, half from a PLY file, one has texts of its own."""
    place = Place(server, tmp_path)
    server.command(*place.lift("--timestamp", "one", "--queries", "red", "--vote-k", 6))
    splat = ("export", "--load-config", place.config, "--output-dir", place.folder / "out")
    server.command(*splat)
    cameras = ("--transforms", place.folder / "room", "--world-transform", place.trained.parent / TRANSFORMS)
    more = ("--vote-k", 6, "--storage", "evidence", "--timestamp", "ply", "--output-dir", place.folder / "outputs")
    server.command("lift", "--load-ply", place.folder / "out" / "splat.ply", *cameras, *COMMON, *more)
    result = tmp_path / "flips.json"
    server.command("flips", place.folder, 0, FLIPS, result)
    found: dict[str, dict[str, int]] = json.loads(result.read_text())
    outcomes = sum((Counter(counts) for counts in found.values()), Counter())
    assert outcomes.total() == FLIPS
    assert set(outcomes) <= {"noticed", "harmless"}, found
    assert set(found) >= KINDS or SHORT
    assert outcomes["noticed"] > 0.8 * FLIPS, found
    for kind, counts in sorted(found.items()):
        record(f"one flipped bit, `{kind}`", sum(counts.values()), f"{counts.get('noticed', 0)} noticed, "
               f"{counts.get('harmless', 0)} harmless")  # fmt: skip
