"""A lift and its answers in few numbers, so that two versions of the program can be compared.

The committed golden.json was made by version 0.1.

Another number of threads, or another kind of processor, rounds the last bits otherwise: four of 295,534 entries of the
demo room's evidence come or go, and one Gaussian in a hundred (six on a capture) copies another of its nearly equal
neighbours. So numbers are compared one by one on the kind of machine that golden.json names only, and elsewhere by
means, counts and a sample of the sources.
"""

import json
import os
import platform
import re
import sys
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np
import torch
from plyfile import PlyData
from safetensors.numpy import load_file

from normlift_ns.encoders.color import _names, embed_colors
from tests.processes import run

TEXTS = {"demo": ("red", "yellow", "sky blue"), "fox": ("orange", "crimson"), "tabletop": ("dusty red", "black")}
"""Queries of each scene, stored in its run."""
VOTE = ("--vote", "paper", "--vote-k", 36, "--vote-sigma-d", 1, "--vote-tau", 0.95)
VOTE += ("--vote-gamma", 0.4, "--vote-delta", 0)
"""Of version 0.1, which knew no consensus."""
SINCE = {"verdict", "nearest", "suggested_threshold", "histogram", "read_as"}
"""What an answer tells since."""
NUMBERS = {"class_id", "instance_id"}
"""What exports tell since, in place of `label`, which is `class_id` - 1."""
SAMPLES = 64
SAME_SOURCES, LOOSE, FEW = 0.9, 0.01, 5
"""On another machine: the share of equal sources, how far floats may be apart, and whole numbers at least."""


_LIFT = """
import sys
import numpy as np
from skimage.segmentation import slic
from normlift_ns.cli.lift import entrypoint
from normlift_ns.segmentation import regions

def superpixels(image, count):
    labels = slic(image.numpy(), n_segments=count, compactness=10.0, start_label=0)
    return np.unique(labels, return_inverse=True)[1].reshape(labels.shape).astype(np.int32)

regions.superpixels = superpixels
entrypoint()
"""
"""ns-normlift with the superpixels of versions 0.1 and 0.2, which are those of scikit-image."""


def run_commands(scene: str, config: Path, folder: Path) -> None:
    """Lifts a run (8 views, half resolution, colour encoder, the method of version 0.1), asks it and exports what is
    found.
    """
    lift = ("--encoder", "color", "--max-views", 8, "--lift-downscale", 2, "--consensus", False, *VOTE)
    _command("ns-normlift", "--load-config", config, *lift, "--timestamp", "golden", "--output-dir", folder)
    (lifted,) = folder.glob("*/normlift/golden/config.yml")
    ask = ("--load-config", lifted, "--text-embeddings", single_colors(folder / "texts.npz"), "--threshold", 0.5)
    _command("ns-normlift-query", *ask, "--text", *TEXTS[scene], "--save-query", True)
    files = ("--output-json", folder / "answers.json", "--output-npz", folder / "answers.npz")
    _command("ns-normlift-query", *ask, "--text", *TEXTS[scene], "brown", *files)
    _command("ns-normlift-export", "--load-config", lifted, "--output-dir", folder / "export", "--select", "selection")


def single_colors(path: Path) -> Path:
    """Write the vectors of color names as version 0.1 had them: each name was one color, without other shades."""
    vectors = embed_colors(np.stack(list(_names().values()))).astype(np.float32)
    np.savez(path, **dict(zip(_names(), vectors)))
    return path


def _command(name: str, *flags: object) -> None:
    threads = {"OMP_NUM_THREADS": "2", "NUMBA_NUM_THREADS": "2", "CUDA_VISIBLE_DEVICES": ""}
    start = [sys.executable, "-c", _LIFT] if name == "ns-normlift" else [str(Path(sys.executable).with_name(name))]
    run(*start, *flags, env=os.environ | threads)


def summarize(folder: Path) -> dict[str, Any]:
    """Integers by their digest, or as they are where there are few; floats by a sample and their mean."""
    (run,) = folder.glob("*/normlift/golden")
    manifest = json.loads((run / "normlift" / "manifest.json").read_text())
    answers = np.load(folder / "answers.npz")
    found: dict[str, Any] = {
        "machine": machine(),
        "form": manifest["form"],
        "forms": {
            name: {k: v for k, v in way.items() if k != "bound_quantiles"} for name, way in manifest["forms"].items()
        },
        "statistics": {
            name: x for name, x in manifest["statistics"].items() if name not in ("changed_share", "recognition")
        },
        "answers": without_news(json.loads((folder / "answers.json").read_text())),
        "objects": without_numbers(json.loads((folder / "export" / "splat_objects.json").read_text())),
    }
    for file in sorted((run / "normlift").glob("*.safetensors")):
        arrays = sorted(load_file(file).items())
        found[file.stem] = {name: _array(array, name) for name, array in arrays if name != "means"}  # not in 0.1
    found["npz"] = {name: _array(answers[name]) for name in ("relevancy", "reliability", "valid")}
    vertices = PlyData.read(folder / "export" / "splat.ply")["vertex"]
    found["ply"] = {p.name: _array(np.asarray(vertices[p.name])) for p in vertices.properties if p.name not in NUMBERS}
    found["ply"]["label"] = _array(np.asarray(vertices["class_id"]).astype(int) - 1)
    found["rows"] = _array(np.load(folder / "export" / "splat_rows.npy"))
    return found


def without_news(answers: dict[str, Any]) -> dict[str, Any]:
    """Answers as version 0.1 told them."""
    assert all(set(one) >= SINCE for one in answers["queries"])
    told = [{key: value for key, value in one.items() if key not in SINCE} for one in answers["queries"]]
    return {**{key: value for key, value in answers.items() if key != "coordinates"}, "queries": told}


def without_numbers(found: Any) -> Any:
    """Objects as version 0.1 told them."""
    if isinstance(found, dict):
        return {key: without_numbers(value) for key, value in found.items() if key not in NUMBERS}
    return [without_numbers(x) for x in found] if isinstance(found, list) else found


def machine() -> dict[str, str]:
    facts = Path("/proc/cpuinfo").read_text() if Path("/proc/cpuinfo").exists() else ""
    lines = re.findall(r"^(?:cpu family|model|model name|stepping)\s*: (.*)", facts, re.MULTILINE)
    model = " ".join(lines[:4]) or platform.processor()
    return {"torch": torch.__version__, "instructions": torch.backends.cpu.get_cpu_capability(), "processor": model}


def _array(array: np.ndarray, name: str = "") -> dict[str, Any]:
    if array.dtype.kind != "f":
        exact = np.ascontiguousarray(array.astype(np.int64))
        digest = blake2b(exact.tobytes(), digest_size=16).hexdigest()
        some = exact.ravel()[:: max(1, exact.size // 512)].tolist() if name == "source" else []
        return {"shape": list(array.shape), "digest": digest, "sample": some}
    flat = array.astype(np.float64).ravel()
    some = flat[np.linspace(0, len(flat) - 1, min(SAMPLES, len(flat))).astype(int)] if len(flat) > 0 else flat
    mean = float(flat.mean()) if len(flat) > 0 else 0.0
    return {"shape": list(array.shape), "mean": round(mean, 8), "sample": [round(x, 8) for x in some.tolist()]}


def compare(found: dict[str, Any], golden: dict[str, Any], tolerance: float) -> list[str]:
    """Places where two summaries of a scene differ; with another processor or torch, loosely.

    Where texts share Gaussians, objects are left out: of version 0.1 they overlap, now each Gaussian is in one.
    """
    if sum(query["gaussians"] for query in golden["objects"]["queries"]) > golden["rows"]["shape"][0]:
        found, golden = ({k: v for k, v in summary.items() if k != "objects"} for summary in (found, golden))
    if found["machine"] == golden["machine"]:
        return differences(found, golden, tolerance)
    ours, theirs = found["field"]["source"]["sample"], golden["field"]["source"]["sample"]
    same = np.mean(np.equal(ours, theirs))
    lines = [] if same >= SAME_SOURCES else [f"source: {same:.2%} of a sample are equal"]
    return lines + differences(without_bits(found), without_bits(golden), LOOSE, loose=True)


def without_bits(summary: Any) -> Any:
    """The summary without what one entry more or less changes altogether: digests, samples and the machine."""
    if not isinstance(summary, dict):
        return summary
    return {k: without_bits(v) for k, v in summary.items() if k not in ("digest", "sample", "machine")}


def differences(found: Any, golden: Any, tolerance: float, path: str = "", *, loose: bool = False) -> list[str]:
    """Places where two values differ: floats by more than the tolerance (relative to values above 1), all else at
    all; loosely, whole numbers differ as floats do, by that share of them or a few."""
    if loose and isinstance(found, int) and isinstance(golden, int) and not isinstance(found, bool):
        return [] if abs(found - golden) <= max(FEW, tolerance * golden) else [f"{path}: {found} is not {golden}"]
    pairs: Any = None
    if isinstance(found, dict) and isinstance(golden, dict):
        pairs = [(name, found.get(name), golden.get(name)) for name in sorted({*found, *golden})]
    if isinstance(found, list) and isinstance(golden, list) and len(found) == len(golden):
        pairs = [(i, a, b) for i, (a, b) in enumerate(zip(found, golden))]
    if pairs is not None:
        return [x for name, a, b in pairs for x in differences(a, b, tolerance, f"{path}/{name}", loose=loose)]
    if isinstance(found, float) and isinstance(golden, float):
        return [] if abs(found - golden) <= tolerance * max(1.0, abs(golden)) else [f"{path}: {found} is not {golden}"]
    return [] if found == golden else [f"{path}: {found} is not {golden}"]
