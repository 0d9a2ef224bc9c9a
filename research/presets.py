"""Accuracy of faster presets of the lift on one GPU, each compared with the same lift in float64.

    python -m research.presets

The scene is the fox capture with every third training view and grid regions. A region has one of 40 classes, that of
the place in its middle. Its feature is the CLIP text vector of the class with noise of length 0.5 in every view. The
error of a preset is the length of the difference between its refined direction and that of float64, for each Gaussian
with a direction in float64.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch.nn.functional import normalize

from normlift_ns import Camera, RefineConfig, SemanticField, lift, nearest_neighbors, refine
from normlift_ns.core.partition import spatial_order
from normlift_ns.core.refine import decay_width
from normlift_ns.kernels.vote import vote
from research.gpu_cases import Case, capture_case, timed
from research.report import RESULTS, Report
from tests.captures import SHARED


class Outcome(NamedTuple):
    directions: torch.Tensor
    """Refined directions, [N, D]."""
    known: torch.Tensor


def world_features(case: Case) -> torch.Tensor:
    """Return [S, 512] rows: the class vector of the place in the middle of each region, with noise."""
    from normlift_ns import render  # noqa: PLC0415

    g = torch.Generator().manual_seed(0)
    names = normalize(torch.from_numpy(np.load(SHARED / "clip_vectors" / "lvis_v1_text.npy")).float(), dim=1)
    classes = names[torch.randperm(len(names), generator=g)[:40]]
    means = case.scene.means
    centres = means[torch.randperm(len(means), generator=g)[:40].to(means.device)]
    rows = []
    for camera, labels, count in zip(case.cameras, case.labels, case.counts):
        place, alpha = render(case.scene, camera, means, backend="torch")
        total = torch.zeros(count, 4, device=means.device, dtype=torch.float64)
        total.index_add_(0, labels.flatten().long(), torch.cat([place, alpha[..., None]], 2).flatten(0, 1).double())
        nearest = torch.cdist((total[:, :3] / total[:, 3:]).float(), centres).argmin(1).cpu()
        noise = normalize(torch.randn(count, classes.shape[1], generator=g), dim=1)
        rows.append(normalize(classes[nearest] + 0.5 * noise, dim=1))
    return torch.cat(rows).cuda()


def run(case: Case, table: torch.Tensor, precision: str) -> tuple[Outcome, Any]:
    """Run one whole lift: evidence, lift, neighbors and vote."""
    exact = precision == "exact"
    dtype = torch.float64 if exact else torch.float32
    evidence = case.evidence(dtype=dtype)
    lifted = lift(evidence, table.to(dtype))
    config, means = RefineConfig(), case.scene.means
    numbers, own = config.numbers, lifted.scalars.own_evidence
    neighbors = nearest_neighbors(means, config.k)
    if precision == "tf32":
        directions = lifted.directions()
        source, row_of = (torch.arange(len(means), dtype=torch.int32, device=means.device) for _ in range(2))
        vote(
            *(spatial_order(means), neighbors.index, neighbors.distance, directions, row_of),
            *(lifted.scalars.reliability, source),
            tau=numbers.tau, gamma=numbers.gamma, delta=numbers.delta,
            width=float(decay_width(neighbors.spacing, config)),
            own=own if config.vote == "posterior" else None, prior=config.prior,
            precision="tf32",
        )  # fmt: skip
    else:
        read = partial(lifted.directions, dtype=torch.float16) if precision == "half" else lifted.directions
        source = refine(means, read, lifted.scalars.reliability, config, own=own, neighbors=neighbors)
    return Outcome(lifted.directions(source.long()), lifted.scalars.norm[source.long()] > 0), (lifted, source)


def low_rank(case: Case, table: torch.Tensor) -> tuple[Outcome, Any]:
    """Return the default lift, stored in a basis that changes no cosine by more than 5e-2."""
    _, (lifted, source) = run(case, table, "float32")
    field = SemanticField.build(lifted, case.scene.means, source, tolerance=5e-2, storage="low_rank")
    return Outcome(field.directions(), field.valid()), None


def half_resolution(case: Case) -> Case:
    cameras = []
    for camera in case.cameras:
        width, height = camera.width // 2, camera.height // 2
        scale = torch.tensor([[width / camera.width], [height / camera.height], [1.0]], dtype=camera.K.dtype)
        cameras.append(Camera(camera.K * scale, camera.world_to_camera, width, height))
    labels = [x[1 : 2 * c.height : 2, 1 : 2 * c.width : 2].contiguous() for x, c in zip(case.labels, cameras)]
    smaller = Case(case.name, case.scene, cameras, labels)
    smaller.__dict__["counts"] = case.counts  # the same table, whatever a smaller image still shows
    return smaller


def main(output: Path) -> None:
    report = Report("presets")
    full = capture_case("fox")
    case = Case("fox", full.scene, full.cameras[::3], full.labels[::3])
    table = world_features(case)
    fewer = replace(case, cameras=case.cameras[::2], labels=case.labels[::2])
    columns = torch.cat([
        torch.arange(sum(case.counts[:v]), sum(case.counts[: v + 1])) for v in range(0, len(case.cameras), 2)
    ])  # fmt: skip
    small = half_resolution(case)
    presets: dict[str, Callable[[], tuple[Outcome, Any]]] = {
        "exact": lambda: run(case, table, "exact"),
        "float32": lambda: run(case, table, "float32"),
        "tf32": lambda: run(case, table, "tf32"),
        "half": lambda: run(case, table, "half"),
        "low_rank": lambda: low_rank(case, table),
        "half_resolution": lambda: run(small, table, "float32"),
        "every_second_view": lambda: run(fewer, table[columns.cuda()], "float32"),
    }
    exact = None
    for name, preset in presets.items():
        torch.cuda.reset_peak_memory_stats()
        with torch.no_grad():
            seconds, (found, _) = timed(preset)
        exact = found if exact is None else exact
        error = torch.where(found.known[:, None], found.directions.double(), 0.0) - exact.directions.double()
        error = error.norm(dim=1)[exact.known]
        report.add(f"{name}.s", seconds, "s", error.square().mean().sqrt())
        report.add(f"{name}.rms_error", error.square().mean().sqrt(), "length of the difference, RMS")
        report.add(f"{name}.other_share", (error > 0.1).float().mean(), "of Gaussians, off by more than 0.1")
        report.add(f"{name}.peak_gib", torch.cuda.max_memory_allocated() / 2**30, "GiB")
    report.write(output)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=RESULTS, help="folder of the JSON file")
    main(parser.parse_args().output)
