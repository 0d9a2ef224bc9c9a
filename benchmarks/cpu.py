"""The core on the fox capture on the CPU: evidence, lift, neighbours and vote; time, memory, error against float64.

python -m benchmarks.cpu            all 45 views at full resolution
python -m benchmarks.cpu --quick    4 views
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import numpy as np
import torch

from benchmarks.captures import SHARED, trained_scene, training_cameras
from benchmarks.report import RESULTS, Report, stopwatch
from normlift_ns import Camera, RefineConfig, lift, nearest_neighbors, rasterize_evidence, refine
from normlift_ns.core.sparse import sum_duplicates
from normlift_ns.stages import peak_gib

CELL = 60
"""Side of the square regions in pixels: 9 x 16 = 144 regions per view."""
OTHER = 1e-3
"""Length of the difference above which a refined direction is another one."""


def grid_labels(camera: Camera) -> torch.Tensor:
    across = -(-camera.width // CELL)
    y, x = torch.meshgrid(torch.arange(camera.height), torch.arange(camera.width), indexing="ij")
    return (y // CELL * across + x // CELL).int()


def clip_like_table(rows: int) -> torch.Tensor:
    """[rows, 512] unit rows: CLIP text vectors of random names, disturbed by noise of length 0.5."""
    g = torch.Generator().manual_seed(0)
    names = torch.from_numpy(np.load(SHARED / "clip_vectors" / "lvis_v1_text.npy").astype(np.float32))
    table = torch.nn.functional.normalize(names, dim=1)[torch.randint(0, len(names), (rows,), generator=g)]
    return torch.nn.functional.normalize(table + 0.5 * torch.randn(table.shape, generator=g) / 512**0.5, dim=1)


def relative_difference(a, b) -> float:
    """Frobenius norm of the difference of two sparse matrices over that of the second."""
    joined = [
        torch.cat(pair)
        for pair in ((a.row_index(), b.row_index()), (a.column, b.column), (a.weight.double(), -b.weight))
    ]
    return float(sum_duplicates(*joined)[2].norm() / b.weight.norm())


def main(quick: bool, output: Path) -> None:
    report = Report("cpu")
    scene, cameras = trained_scene("fox"), training_cameras("fox")
    cameras = cameras[:4] if quick else cameras
    labels = [grid_labels(camera) for camera in cameras]
    rasterize_evidence(scene, cameras[:1], labels[:1])  # compiles, or reads what was compiled before

    with stopwatch() as watch:
        evidence = rasterize_evidence(scene, cameras, labels)
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
        source = refine(scene.means, lifted.directions, lifted.scalars.reliability, config, neighbors=neighbors)

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
    exact_source = refine(scene.means, exact.directions(), exact.scalars.reliability, config, neighbors=neighbors)

    report.add("fox_evidence_s", watch.seconds, "s", evidence_error)
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
    parser.add_argument("--quick", action="store_true", help="4 views")
    parser.add_argument("--output", type=Path, default=RESULTS, help="folder of the JSON file")
    arguments = parser.parse_args()
    main(arguments.quick, arguments.output)
