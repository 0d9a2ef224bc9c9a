"""Time, memory and error of the core on the fox capture on the CPU: evidence, lift, neighbors and vote.

python -m research.cpu            all 45 views at full resolution python -m research.cpu --quick    every fourth
Gaussian, 4 views
"""

from __future__ import annotations

import argparse
import math
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import torch

from normlift_ns import (
    Camera,
    GaussianScene,
    RasterSettings,
    RefineConfig,
    lift,
    nearest_neighbors,
    rasterize_evidence,
    refine,
)
from normlift_ns.core.sparse import sum_duplicates
from normlift_ns.progress import peak_gib
from normlift_ns.rasterization import numba as compiled
from normlift_ns.rasterization.projection import assign_tiles
from normlift_ns.rasterization.rasterize import RasterBatch, RasterJob
from research.gpu_cases import grid_labels
from research.report import RESULTS, Report, stopwatch
from tests.captures import SHARED, trained_scene, training_cameras

OTHER = 1e-3
"""Length of the difference above which a refined direction counts as different."""


def clip_like_table(rows: int) -> torch.Tensor:
    """Return [rows, 512] unit rows: CLIP text vectors of random names with noise of length 0.5."""
    g = torch.Generator().manual_seed(0)
    names = torch.from_numpy(np.load(SHARED / "clip_vectors" / "lvis_v1_text.npy").astype(np.float32))
    table = torch.nn.functional.normalize(names, dim=1)[torch.randint(0, len(names), (rows,), generator=g)]
    return torch.nn.functional.normalize(table + 0.5 * torch.randn(table.shape, generator=g) / 512**0.5, dim=1)


def relative_difference(a, b) -> float:
    """Return the Frobenius norm of the difference of two sparse matrices, relative to the norm of the second."""
    joined = [
        torch.cat(pair)
        for pair in ((a.row_index(), b.row_index()), (a.column, b.column), (a.weight.double(), -b.weight))
    ]
    return float(sum_duplicates(*joined)[2].norm() / b.weight.norm())


WARM = """
import time
import torch
start = time.process_time()
from normlift_ns.rasterization import numba
print(time.process_time() - start)
for kernel, signature in numba.kernel_signatures(torch.float32):
    start = time.process_time()
    kernel.compile(signature)
    print(kernel.__name__, time.process_time() - start, sum(kernel.stats.cache_misses.values()))
"""


def warming() -> dict[str, float]:
    """Return the CPU seconds that a new process takes to import numba and to load each kernel from the cache."""
    _, child = (  # the first one compiles what no cache holds
        subprocess.run([sys.executable, "-c", WARM], capture_output=True, text=True, check=True) for _ in range(2)
    )
    first, *kernels = child.stdout.split("\n")[:-1]
    rows = [line.split() for line in kernels]
    if any(misses != "0" for _, _, misses in rows):
        raise RuntimeError(f"a second process compiled kernels again, so the cache does not work: {child.stdout}")
    return {"import": float(first), **{name: float(seconds) for name, seconds, _ in rows}}


def stages(scene: GaussianScene, camera: Camera, labels: torch.Tensor) -> tuple[dict[str, float], float]:
    """Return the CPU milliseconds of each stage of one view, and the share of the pairs of `assign_tiles` that are
    kept."""
    job = RasterJob(scene, False, RasterSettings(), torch.float32)
    batch = RasterBatch([camera], [labels], [int(labels.max()) + 1])
    projected = job.project(camera)
    tasks: dict[str, Callable[[], Any]] = {
        "project": lambda: job.project(camera),
        "lists": lambda: compiled._tiles(projected, camera, job.settings),
        "view": lambda: compiled.views_evidence(job, batch),
    }
    spent: dict[str, list[float]] = {name: [] for name in tasks}
    for _ in range(5):
        for name, task in tasks.items():
            start = time.process_time()
            task()
            spent[name].append(1e3 * (time.process_time() - start))
    kept = len(compiled._tiles(projected, camera, job.settings)[2][1])
    share = kept / len(assign_tiles(projected, camera.width, camera.height, job.settings.tile_size).indices)
    milliseconds = {name: median(values) for name, values in spent.items()}
    milliseconds["sums"] = milliseconds["view"] - milliseconds["project"] - milliseconds["lists"]
    return milliseconds, share


def main(quick: bool, output: Path) -> None:
    report = Report("cpu")
    scene, cameras = trained_scene("fox"), training_cameras("fox")
    if quick:
        scene, cameras = scene.select(slice(None, None, 4)), cameras[:4]
    labels = [grid_labels(camera) for camera in cameras]
    rasterize_evidence(scene, cameras[:1], labels[:1])  # compiles, or reads what was compiled before

    start = time.process_time()
    with stopwatch() as watch:
        evidence = rasterize_evidence(scene, cameras, labels)
    evidence_cpu = time.process_time() - start
    peak = peak_gib() or math.nan
    with stopwatch() as lift_watch:
        features = clip_like_table(evidence.num_regions)
        lifted = lift(evidence, features)
    with stopwatch() as direction_watch:
        directions = lifted.directions()
    config = RefineConfig()
    with stopwatch() as neighbor_watch:
        neighbors = nearest_neighbors(scene.means, config.k)
    with stopwatch() as refine_watch:
        numbers = {"own": lifted.scalars.own_evidence, "neighbors": neighbors}
        source = refine(scene.means, lifted.directions, lifted.scalars.reliability, config, **numbers)

    pairs = rasterize_evidence(scene, cameras, labels, weight_power=0).rows.weight.double().sum()
    exact_evidence = rasterize_evidence(scene, cameras, labels, dtype=torch.float64)
    evidence_error = relative_difference(evidence.rows, exact_evidence.rows)
    with stopwatch() as reference_watch:
        reference = rasterize_evidence(scene, cameras[:1], labels[:1], backend="torch")
    exact = lift(evidence, features.double())
    lift_error = (
        lifted.scalars.reliability.double() - exact.scalars.reliability
    ).abs().max() / exact.scalars.reliability.max()
    turned = (directions.double() - exact.directions()).norm(dim=1)
    numbers = {"own": exact.scalars.own_evidence, "neighbors": neighbors}
    exact_source = refine(scene.means, exact.directions(), exact.scalars.reliability, config, **numbers)

    report.add("fox_evidence_s", watch.seconds, "s", evidence_error)
    report.add("fox_evidence_cpu_s", evidence_cpu, "s of CPU", evidence_error)
    milliseconds, kept = stages(scene, cameras[len(cameras) // 2], labels[len(cameras) // 2])
    for name, value in milliseconds.items():
        report.add(f"fox_{name}_cpu_ms", value, "ms of CPU, one view")
    report.add("fox_kept_pairs", kept, "of (Gaussian, tile) pairs")
    for name, seconds in warming().items():
        report.add(f"warm_{name}_cpu_s", seconds, "s of CPU")
    report.add("fox_evidence_peak_gib", peak, "GiB")
    report.add("fox_evidence_rel_error", evidence_error, "relative Frobenius norm")
    report.add("fox_evidence_pairs_per_s", pairs / watch.seconds, "pixel-Gaussian pairs/s")
    report.add("fox_evidence_nonzeros", evidence.nnz, "entries")
    report.add("fox_reference_view_s", reference_watch.seconds, "s/view", relative_difference(
        reference.rows, exact_evidence.select_views([0]).rows
    ))  # fmt: skip
    report.add("fox_lift_s", lift_watch.seconds, "s", lift_error)
    report.add("fox_directions_s", direction_watch.seconds, "s", turned.max())
    report.add("fox_neighbors_s", neighbor_watch.seconds, "s", 0)
    other = (directions[source.long()].double() - exact.directions()[exact_source.long()]).norm(dim=1) > OTHER
    report.add("fox_refine_s", neighbor_watch.seconds + refine_watch.seconds, "s", other.double().mean())
    report.add("fox_refined_share", (source != torch.arange(len(source))).float().mean(), "of Gaussians")
    report.add("fox_zero_evidence_share", (lifted.scalars.reliability == 0).float().mean(), "of Gaussians")
    report.add("fox_total_peak_gib", peak_gib() or math.nan, "GiB, float64 checks included")
    report.write(output)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="every fourth Gaussian, 4 views")
    parser.add_argument("--output", type=Path, default=RESULTS, help="folder of the JSON file")
    arguments = parser.parse_args()
    main(arguments.quick, arguments.output)
