"""Flipped bits in all that is written for runs and their caches: noticed, or harmless.

Noticed: refused with our message, computed again (caches) or warned of (config.yml, which people may edit).
Harmless: the same answers, parameters and stored vectors, bit for bit. Anything else is a wrong answer without a word.
"""

import random
import warnings
from collections import Counter, defaultdict
from pathlib import Path

import pytest
import torch

from normlift_ns.core.evidence import Evidence
from normlift_ns.encoders.cache import _read, _write
from normlift_ns.errors import InputError
from normlift_ns.lifted_run import open_run
from normlift_ns.pipeline import lift_run
from tests.io.test_digests import flipped
from tests.torture.conftest import SHORT, Record, Server
from tests.torture.test_kills import COMMON, Place

FLIPS = 60 if SHORT else 1000
TRANSFORMS = "dataparser_transforms.json"
KEPT = {"regions": "labels", "features": "features", "texts": "text"}
"""Folders of the cache, and the tensor in their files."""
KINDS = {
    *(f".cache/{name}" for name in ("evidence", *KEPT)),
    *(f"normlift/{name}" for name in ("field.safetensors", "manifest.json", "queries.safetensors", "texts.npz")),
    *("config.yml", TRANSFORMS, "nerfstudio_models/*.ckpt", "splat.json", "transforms.json"),
}
Numbers = dict[str, torch.Tensor]


def kind(path: Path, runs: Path) -> str:
    """The file without what differs between runs."""
    first, second, *_ = parts = path.relative_to(runs).parts
    if first == ".cache":
        return f".cache/{second}"
    return "/".join(parts[1:]) if second != "nerfstudio_models" else "nerfstudio_models/*.ckpt"


def numbers(path: Path, runs: Path) -> Numbers:
    """All that can be had of a run, or of a file of the cache."""
    where = path.relative_to(runs).parts
    if where[:2] == (".cache", "evidence"):
        evidence = Evidence.load(path, key=path.stem)
        return {"columns": evidence.rows.column, "weights": evidence.rows.weight, "blank": evidence.unlabeled.weight}
    if where[0] == ".cache":
        kept = _read(path, KEPT[where[1]], lambda kept: True)
        if kept is None:
            raise InputError("computed again")
        return {"kept": kept}
    run = open_run(runs / where[0] / "config.yml", device="cpu")
    asked, stored = run.ask("red", "yellow"), run.ask_stored()
    found = {"relevancy": asked.relevancy, "selected": asked.selected, **run.scene.parameters}
    found |= {f"camera {i}": camera.world_to_camera for i, camera in enumerate(run.scene.train.cameras)}
    return found | ({} if stored is None else {"stored": stored.relevancy, "found": stored.selected})


def outcome(path: Path, runs: Path, expected: Numbers) -> str:
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        try:
            found = numbers(path, runs)
        except (InputError, FileNotFoundError):
            return "noticed"
        except Exception as error:  # a bug of ours, which is what this looks for
            return f"wrong: {type(error).__name__}: {error}"
    if any("has changed since normlift_ns wrote it" in str(warning.message) for warning in said):
        return "noticed"
    same = found.keys() == expected.keys() and all(torch.equal(found[name], expected[name]) for name in found)
    return "harmless" if same else "wrong"


@pytest.mark.slow
def test_flipped_bits_are_noticed_or_harmless(server: Server, tmp_path: Path, record: Record) -> None:
    """Half of the runs came from a nerfstudio run, half from a PLY file, one has texts of its own."""
    place = Place(server, tmp_path)
    server.command(*place.lift("--timestamp", "one", "--queries", "red", "--vote-k", 6))
    server.command("export", "--load-config", place.config, "--output-dir", place.folder / "out")
    cameras = ("--transforms", place.folder / "room", "--world-transform", place.trained.parent / TRANSFORMS)
    more = ("--vote-k", 6, "--storage", "evidence", "--timestamp", "ply", "--output-dir", place.folder / "outputs")
    server.command("lift", "--load-ply", place.folder / "out" / "splat.ply", *cameras, *COMMON, *more)
    left = (torch.arange(80).expand(60, 80) // 40, torch.eye(2))
    texts = {"red": torch.tensor([1.0, 0.0]), "yellow": torch.tensor([0.0, 1.0])}
    how = {"timestamp": "own", "check_alignment": False, "device": "cpu"}
    own = lift_run(place.trained, features=[left] * 5, texts=texts, **how)
    assert {path.name for path in own.folder.rglob("*.npz")} == {"texts.npz"}
    _write(place.runs / ".cache" / "texts" / "t.safetensors", "text", torch.rand(16))

    files = sorted(path for path in place.runs.rglob("*") if path.is_file())
    expected = {path: numbers(path, place.runs) for path in files}
    draw, found = random.Random(0), defaultdict(Counter)
    for _ in range(FLIPS):
        path = draw.choice(files)
        whole = path.read_bytes()
        bit = draw.randrange(8 * len(whole))
        path.write_bytes(flipped(whole, bit))
        result = outcome(path, place.runs, expected[path])
        assert result in ("noticed", "harmless"), (path, bit, result)
        found[kind(path, place.runs)][result] += 1
        path.write_bytes(whole)
    assert set(found) >= KINDS or SHORT
    assert sum(counts["noticed"] for counts in found.values()) > 0.8 * FLIPS, found
    for name, counts in sorted(found.items()):
        told = f"{counts['noticed']} noticed, {counts['harmless']} harmless"
        record(f"one flipped bit, `{name}`", counts.total(), told)
