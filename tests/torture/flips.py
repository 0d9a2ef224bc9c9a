"""Single flipped bits in all files that are written for a run and in its caches: what becomes of them.

Noticed: refused with our message, computed again (caches) or warned of (config.yml, which people may edit).
Harmless: the same answers, parameters and stored vectors, bit for bit. Anything else is a wrong answer without a word.
"""

import json
import random
import warnings
from collections import Counter, defaultdict
from pathlib import Path

import torch

from normlift_ns.core.evidence import Evidence
from normlift_ns.encoders.cache import _read, _write
from normlift_ns.errors import InputError
from normlift_ns.lifted_run import LiftedRun, open_run
from normlift_ns.pipeline import lift_run
from tests.io.test_digests import flipped

KEPT = {"regions": "labels", "features": "features", "texts": "text"}
"""Folders of the cache, and the tensor in their files."""
Numbers = dict[str, torch.Tensor]


def main(folder: Path, seed: int, count: int, output: Path) -> None:
    """Flips `count` bits, of files chosen at random; writes the outcomes by kind of file.

    Args:
        folder: has outputs/room with runs and .cache.
    """
    runs = folder / "outputs" / "room" / "normlift"
    own = _own_features(runs)
    _write(runs / ".cache" / "texts" / "t.safetensors", "text", torch.rand(16))
    files = sorted(path for path in runs.rglob("*") if path.is_file())
    expected = {path: _numbers(path, runs) for path in files}
    draw, found = random.Random(seed), defaultdict(Counter)
    assert {path.name for path in own.folder.rglob("*.npz")} == {"texts.npz"}
    for _ in range(count):
        path = draw.choice(files)
        whole = path.read_bytes()
        bit = draw.randrange(8 * len(whole))
        path.write_bytes(flipped(whole, bit))
        outcome = _outcome(path, runs, expected[path])
        if outcome.startswith("wrong"):
            print(f"{path}, bit {bit}: {outcome}")
        found[kind(path, runs)][outcome] += 1
        path.write_bytes(whole)
    output.write_text(json.dumps(found))


def kind(path: Path, runs: Path) -> str:
    """The file without what differs between runs."""
    parts = path.relative_to(runs).parts
    if parts[0] == ".cache":
        return f".cache/{parts[1]}"
    return "/".join(parts[1:]) if parts[1] != "nerfstudio_models" else "nerfstudio_models/*.ckpt"


def _own_features(runs: Path) -> LiftedRun:
    """A run with texts of the user's own."""
    (trained,) = runs.parent.glob("splatfacto/*/config.yml")
    left = (torch.arange(80).expand(60, 80) // 40, torch.eye(2))
    texts = {"red": torch.tensor([1.0, 0.0]), "yellow": torch.tensor([0.0, 1.0])}
    return lift_run(trained, features=[left] * 5, texts=texts, timestamp="own", check_alignment=False, device="cpu")


def _numbers(path: Path, runs: Path) -> Numbers:
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
    asked = run.ask("red", "yellow")
    stored = run.ask_stored()
    numbers = {"relevancy": asked.relevancy, "selected": asked.selected, **run.scene.parameters}
    poses = {f"camera {i}": camera.world_to_camera for i, camera in enumerate(run.scene.train.cameras)}
    return numbers | poses | ({} if stored is None else {"stored": stored.relevancy, "found": stored.selected})


def _outcome(path: Path, runs: Path, expected: Numbers) -> str:
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        try:
            found = _numbers(path, runs)
        except (InputError, FileNotFoundError):
            return "noticed"
        except Exception as error:  # a bug of ours, which is what this looks for
            return f"wrong: {type(error).__name__}: {error}"
    if any("has changed since normlift_ns wrote it" in str(warning.message) for warning in said):
        return "noticed"
    same = found.keys() == expected.keys() and all(torch.equal(found[name], expected[name]) for name in found)
    return "harmless" if same else "wrong"
