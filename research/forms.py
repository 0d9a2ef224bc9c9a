"""Size of a semantic field in its three storage forms, and their effect on queries, with and without consensus.

On the tabletop capture, the exact instance masks are the regions. Features are real CLIP text vectors of the names of
the objects, with new noise of a given length in every view. Errors are measured on every eighth of the 1,203 names of
the vector file, against float64 directions. On the tabletop, the plain room and the fox, the color encoder uses masks
or, if there are none, superpixels. Its errors are measured on the color names of the survey.

    python -m research.forms
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from matplotlib.colors import XKCD_COLORS
from PIL import Image
from rich.console import Console
from rich.table import Table
from torch import Tensor
from torch.nn.functional import normalize

from normlift_ns import Camera, Evidence, SemanticField, lift, rasterize_evidence
from normlift_ns.core.consensus import consensus
from normlift_ns.demo.capture import demo_cameras, view_image, view_labels
from normlift_ns.encoders.base import joint_partition
from normlift_ns.encoders.color import ColorEncoder
from normlift_ns.segmentation.regions import Superpixels
from research.report import RESULTS, Report
from tests.captures import SHARED, trained_scene, training_cameras, training_indices
from tests.plain_room import plain_room

NOISE = (0.0, 0.05, 0.5, 1.5)
TOLERANCES = (1e-3, 1e-2, 5e-2)
CASES = (*(f"noise{noise}" for noise in NOISE), "demo_colour", "tabletop_colour", "fox_colour")


def mask_labels() -> list[Tensor]:
    """Return the tabletop's twelve exact instance masks in its 44 training views."""
    folder = SHARED / "captures" / "tabletop" / "instance"
    return [
        torch.from_numpy(np.array(Image.open(folder / f"{i:04d}.png")).astype(np.int32)) - 1
        for i in training_indices("tabletop")
    ]


def mask_evidence() -> Evidence:
    """Return the evidence of these masks."""
    labels = mask_labels()
    return rasterize_evidence(
        trained_scene("tabletop"), training_cameras("tabletop"), labels, num_regions=[12] * len(labels)
    )


class Case(NamedTuple):
    """A scene to lift."""

    name: str
    """Prefix of the keys, followed by an underscore."""
    means: Tensor
    evidence: Evidence
    features: Tensor
    """[S, D], float64."""
    queries: Tensor
    """[Q, D], float64."""


def clip_cases(some: Sequence[str]) -> Iterator[Case]:
    """Yield the tabletop with noise of several lengths."""
    if not any(name.startswith("noise") for name in some):
        return
    evidence, means = mask_evidence(), trained_scene("tabletop").means
    vectors = np.load(SHARED / "clip_vectors" / "lvis_v1_text.npy").astype(np.float64)
    names = normalize(torch.from_numpy(vectors), dim=1)
    index = {name: i for i, name in enumerate(json.loads((SHARED / "clip_vectors" / "lvis_v1_names.json").read_text()))}
    mapping = json.loads((SHARED / "clip_vectors" / "tabletop_map.json").read_text())
    classes = names[[index[mapping[str(i)]] for i in range(1, 13)]]
    for noise in (noise for noise in NOISE if f"noise{noise}" in some):
        features = classes.repeat(evidence.num_views, 1)
        g = torch.Generator().manual_seed(0)
        features = features + noise * torch.randn(features.shape, generator=g, dtype=torch.float64) / 512**0.5
        yield Case(f"noise{noise}", means, evidence, normalize(features, dim=1), names[::8])


def colour_cases(some: Sequence[str]) -> Iterator[Case]:
    """Yield cases with the mean colors of masks, or of superpixels if there are none."""
    encoder, room = ColorEncoder(), plain_room()
    names = [name.removesuffix("_colour") for name in some if name.endswith("_colour")]
    queries = encoder.text(sorted(name.removeprefix("xkcd:") for name in XKCD_COLORS)[::5]).double()
    for name in names:
        scene = room.scene if name == "demo" else trained_scene(name)
        cameras = demo_cameras(width=320, height=240) if name == "demo" else training_cameras(name)
        images = [view_image(room, x) for x in cameras] if name == "demo" else photographs(name, cameras)
        labels = (
            [view_labels(room, camera).int() - 1 for camera in cameras] if name == "demo"
            else mask_labels() if name == "tabletop"
            else [Superpixels().labels(image, "")[0, 0] for image in images]
        )  # fmt: skip
        labels = [joint_partition(of_view[None])[0] for of_view in labels]  # numbers without gaps
        rows = [encoder.encode(image, of_view[None]) for image, of_view in zip(images, labels)]
        evidence = rasterize_evidence(scene, cameras, labels, num_regions=[len(x) for x in rows])
        yield Case(f"{name}_colour", scene.means, evidence, normalize(torch.cat(rows).double(), dim=1), queries)


def photographs(name: str, cameras: Sequence[Camera]) -> list[Tensor]:
    """Return the training images at the size of their cameras. Lens distortion is kept, because it hardly affects
    colors."""
    files = sorted((SHARED / "captures" / name / "images").iterdir())
    size = (cameras[0].width, cameras[0].height)
    pictures = (Image.open(files[i]).convert("RGB").resize(size) for i in training_indices(name))
    return [torch.from_numpy(np.array(picture)) for picture in pictures]


def compare(case: Case, tolerances: Sequence[float], report: Report, table: Table) -> None:
    """Compare all storage forms of one case at every tolerance."""
    lifted = lift(case.evidence, case.features.float())
    some = torch.randperm(len(case.means), generator=torch.Generator().manual_seed(0))[:20000]
    exact = lift(case.evidence, case.features).directions(some) @ case.queries.T
    measured: dict[tuple[str, int | None], float] = {}
    for tolerance in tolerances:
        forms = SemanticField.build(lifted, case.means, tolerance=tolerance).manifest["forms"]
        chosen = min((f for f in forms if forms[f]["bound"] <= tolerance), key=lambda f: forms[f]["bytes"])
        for form, facts in forms.items():
            key = (form, facts.get("rank"))
            if key not in measured:
                field = SemanticField.build(lifted, case.means, storage=form, tolerance=tolerance)
                measured[key] = float((field.query(case.queries.float(), refined=False)[some] - exact).abs().max())
            size = facts["bytes"] / len(case.means)
            mark = " (chosen)" if form == chosen else ""
            bound, error = f"{facts['bound']:.1e}", f"{measured[key]:.1e}"
            row = (case.name, f"{tolerance:g}", form + mark, str(key[1] or ""), f"{size:.1f}", bound, error)
            table.add_row(*row)
            report.add(f"{case.name}_tol{tolerance:g}_{form}_bytes", size, "bytes per Gaussian", measured[key])
            print(*row, flush=True)
            if key[1] is not None:
                dimension = case.features.shape[1]
                report.add(f"{case.name}_tol{tolerance:g}_rank", key[1], f"of {dimension}", measured[key])


def main(arguments: argparse.Namespace) -> None:
    torch.set_grad_enabled(False)
    report, some = Report("forms"), arguments.cases
    table = Table("case", "tolerance", "form", "rank", "bytes per Gaussian", "bound", "measured")
    for case in chain(clip_cases(some), colour_cases(some)):
        compare(case, arguments.tolerances, report, table)
        agreed = consensus(case.evidence, case.features)
        report.add(f"{case.name}_agreement", agreed.agreement[0], "of 1")
        other = case._replace(name=f"{case.name}_consensus", features=agreed.features)
        compare(other, arguments.tolerances, report, table)
    Console(width=120).print(table)
    report.write(arguments.output)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", nargs="+", default=list(CASES), choices=CASES)
    parser.add_argument("--tolerances", nargs="+", type=float, default=list(TOLERANCES))
    parser.add_argument("--output", type=Path, default=RESULTS, help="folder of the JSON file")
    main(parser.parse_args())
