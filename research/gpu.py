"""Times, errors and memory of the whole lift on one GPU by stages, compared with stock gsplat.

    python -m research.gpu            fox, tabletop, rooms of 0.48, 1.93 and 10 million Gaussians, growth
    python -m research.gpu --quick    fox and tabletop only
    python -m research.gpu --rooms    evidence, lift and RGB of rooms of 1.93 and 10 million Gaussians, by stages

Each time is the median of three runs after a warm-up run, with synchronization of the GPU before and after. Comparisons
with stock gsplat's RGB render are measured in turns with it, in seven rounds.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch

from normlift_ns import Lifted, RefineConfig, SemanticField, lift, nearest_neighbors, rasterize_evidence, refine
from normlift_ns.core.lowrank import StoredEvidence
from normlift_ns.evaluation.baselines import dense_sums
from normlift_ns.rasterization.gsplat import project_views
from normlift_ns.rasterization.rasterize import RasterJob
from normlift_ns.rasterization.settings import RasterSettings
from research.cpu import relative_difference
from research.gpu_cases import DIMENSION, Case, capture_case, features, once, room_case, timed
from research.gpu_errors import evidence_error, lift_errors, vote_errors
from research.gpu_stages import kernel_milliseconds, stage_seconds
from research.report import RESULTS, Report

GSPLAT_VIEWS = 6


def stock_renders(case: Case) -> tuple[Callable[[], None], Callable[[], None]]:
    """Return functions for the RGB render of all views by stock gsplat, and for its backward pass with 512 channels.

    The backward pass uses only the first views.
    """
    from gsplat.cuda._wrapper import (  # noqa: PLC0415
        fully_fused_projection,
        isect_offset_encode,
        isect_tiles,
        rasterize_to_pixels,
    )

    scene, n = case.scene, len(case.scene)
    poses = torch.stack([camera.world_to_camera.float() for camera in case.cameras]).cuda()
    intrinsics = torch.stack([camera.K.float() for camera in case.cameras]).cuda()
    colors = torch.rand(1, n, 3, device="cuda")

    def prepared(v: int) -> tuple[Any, ...]:
        width, height = case.cameras[v].width, case.cameras[v].height
        radii, means2d, depths, conics, _ = fully_fused_projection(
            scene.means, None, scene.quats, scene.scales, poses[v : v + 1], intrinsics[v : v + 1], width, height
        )
        across, down = -(-width // 16), -(-height // 16)
        _, keys, members = isect_tiles(means2d, radii, depths, 16, across, down)
        return means2d, conics, width, height, isect_offset_encode(keys, 1, across, down), members

    def rgb() -> None:
        for v in range(len(case.cameras)):
            means2d, conics, width, height, offsets, members = prepared(v)
            opacities = scene.opacities[None]
            rasterize_to_pixels(means2d, conics, colors, opacities, width, height, 16, offsets, members)

    def backward() -> None:
        some = case.cameras[:GSPLAT_VIEWS]
        gradient = torch.rand(some[0].height, some[0].width, DIMENSION, device="cuda")  # as large for every view
        dense_sums(RasterJob(scene, False, RasterSettings(), torch.float32), some, [gradient] * len(some), DIMENSION)

    return rgb, backward


def compare_with_rgb(report: Report, case: Case, rounds: int = 7) -> None:
    """Add the time of evidence and lift relative to stock gsplat's RGB render, measured in turns.

    Metrics are medians, the smallest and largest ratio, and the error.
    """

    def add(key: str, value: Any, unit: str, error: Any = None) -> None:
        report.add(f"{case.name}.{key}", value, unit, error)

    with torch.no_grad():
        rgb, evidence = stock_renders(case)[0], case.evidence()
        table = features(evidence.num_regions)
        lifted = lift(evidence, table)
        worst = max(evidence_error(case, evidence), *lift_errors(case, evidence, table, lifted))
        steps = {
            "rgb_s": rgb,
            "evidence_s": case.evidence,
            "reliability_s": lambda: lift(evidence, table),
            "directions_s": lambda: lifted.directions(dtype=torch.float16),
        }
        seconds: dict[str, list[float]] = {name: [] for name in steps}
        for turn in range(rounds + 1):
            for name, step in steps.items():
                spent = once(step)
                if turn > 0:  # the first one warms up
                    seconds[name].append(spent)
        ratios = sorted((e + r + d) / rgb for rgb, e, r, d in zip(*seconds.values()))
        for name, spent in seconds.items():
            add(f"turns.{name}", sorted(spent)[rounds // 2], f"s, median of {rounds} turns, {min(spent):.4g} to "
                f"{max(spent):.4g}")  # fmt: skip
        add("evidence_lift_over_rgb", ratios[rounds // 2], "times the RGB render of the same turn, median", worst)
        add("evidence_lift_over_rgb_low", ratios[0], "the least of all turns")
        add("evidence_lift_over_rgb_high", ratios[-1], "the largest of all turns")
        for stage, spent in stage_seconds(case.evidence).items():
            add(f"stage.{stage}_ms", 1e3 * spent, "ms, the GPU waited for around every stage")
        lifting = {
            "evidence": case.evidence,
            "reliability": steps["reliability_s"],
            "directions": steps["directions_s"],
        }
        for part, run in lifting.items():
            for name, spent in kernel_milliseconds(run).items():
                print(f"{case.name}, {part[:-2]}: {spent:9.2f} ms  {name}", flush=True)


def measure(report: Report, case: Case) -> None:
    """Add the metrics NAME.* of a case."""

    def add(key: str, value: Any, unit: str, error: Any = None) -> None:
        report.add(f"{case.name}.{key}", value, unit, error)

    views, n = len(case.cameras), len(case.scene)
    rgb, backward = stock_renders(case)
    with torch.no_grad():
        rgb_s, _ = timed(rgb)
        gsplat512_s = timed(backward)[0] * views / min(GSPLAT_VIEWS, views)
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats()
        job = RasterJob(case.scene, False, RasterSettings(), torch.float32)
        intersections = len(project_views(job, case.cameras[:1]).indices)
        evidence_s, evidence = timed(case.evidence)
        evidence_gib = torch.cuda.max_memory_allocated() / 2**30
        table = features(evidence.num_regions)
        reliability_s, lifted = timed(lambda: lift(evidence, table))
        directions_s = timed(lambda: lifted.directions(dtype=torch.float16))[0]
        config = RefineConfig()
        neighbors_s, neighbors = timed(lambda: nearest_neighbors(case.scene.means, config.k))
        vote_s, source = timed(
            lambda: refine(
                case.scene.means,
                lifted.directions,
                lifted.scalars.reliability,
                config,
                own=lifted.scalars.own_evidence,
                neighbors=neighbors,
            )
        )
        peak_gib = torch.cuda.max_memory_allocated() / 2**30
        field = query_field(lifted, source)
        query_s, _ = timed(lambda: field.query(table[:1]))

        lift_s = reliability_s + directions_s
        norm_error, direction_error = lift_errors(case, evidence, table, lifted)
        vote_error = vote_errors(case, lifted, config, neighbors, source)
        add("gaussians", n, "")
        add("views", views, "")
        add("rgb_s", rgb_s, "s, stock gsplat")
        add("rgb_ms_per_view", rgb_s / views * 1e3, "ms")
        add("evidence_s", evidence_s, "s", evidence_error(case, evidence))
        add("reliability_s", reliability_s, "s", norm_error)
        add("lift_s", lift_s, "s, reliability and directions", direction_error)
        add("evidence_lift_s", evidence_s + lift_s, "s")
        if not case.name.startswith("rooms"):  # those are measured in turns
            add("evidence_lift_over_rgb", (evidence_s + lift_s) / rgb_s, "times the RGB render")
        add("neighbors_s", neighbors_s, "s", 0)
        add("vote_s", vote_s, "s", vote_error)
        add("total_s", evidence_s + lift_s + neighbors_s + vote_s, "s")
        add("query_ms", query_s * 1e3, "ms")
        add("gsplat512_s", gsplat512_s, f"s, stock gsplat's backward, {min(GSPLAT_VIEWS, views)} views scaled up")
        add("gsplat512_over_evidence_lift", gsplat512_s / (evidence_s + lift_s), "times evidence and lift")
        add("evidence_peak_gib", evidence_gib, "GiB on the GPU")
        add("peak_gib", peak_gib, "GiB on the GPU")
        add("intersections_per_view", intersections, "of the first view")
        add("nonzeros", evidence.nnz, "entries")
        pixels = sum(camera.width * camera.height for camera in case.cameras[:4])
        pairs = rasterize_evidence(case.scene, case.cameras[:4], case.labels[:4], weight_power=0)
        add("contributors_per_pixel", pairs.rows.weight.double().sum() / pixels, "Gaussians")


def query_field(lifted: Lifted, source: torch.Tensor) -> SemanticField:
    """Return a field of the exact form without its bytes and bounds of the other forms, which take time."""
    return SemanticField(
        lifted.scalars, source, StoredEvidence(lifted.evidence, lifted.features), {"dimension": DIMENSION}
    )


def agreement(report: Report, cases: Sequence[Case]) -> None:
    """Add the differences between the kernel and gsplat's backward pass, and whether two runs agree bit for bit."""
    from gsplat.cuda._wrapper import rasterize_to_pixels  # noqa: PLC0415

    worst, alpha_worst, repeatable = 0.0, 0.0, True
    for case in cases:
        some = Case(case.name, case.scene, case.cameras[::9], case.labels[::9])
        for mode in ("classic", "antialiased"):
            ours, again, stock = (some.evidence(backend=b, rasterize_mode=mode) for b in ("triton", "triton", "gsplat"))
            worst = max(worst, relative_difference(ours.rows, stock.rows))
            weight = ours.rows.weight.double().sum() + ours.unlabeled.weight.double().sum()
            alpha = 0.0
            for camera in some.cameras:
                job = RasterJob(case.scene, mode == "antialiased", RasterSettings(), torch.float32)
                seen = project_views(job, [camera])
                drawing = (seen.means2d, seen.conics, torch.zeros(1, len(case.scene), 1, device="cuda"), seen.opacities)
                _, alphas = rasterize_to_pixels(*drawing, camera.width, camera.height, 16, seen.offsets, seen.indices)
                alpha += float(alphas.double().sum())
            alpha_worst = max(alpha_worst, abs(float(weight) / alpha - 1))
            repeatable &= all(torch.equal(getattr(ours.rows, x), getattr(again.rows, x)) for x in ("weight", "column"))
    report.add("triton_vs_gsplat_rel", worst, "relative Frobenius norm, worst of fox and tabletop in both modes")
    report.add("weight_vs_alpha_rel", alpha_worst, "relative difference of the sums of E and of gsplat's alpha")
    report.add("bitwise_repeatable", float(repeatable), "1: yes")


def growth(report: Report) -> None:
    """Add the seconds of evidence as one quantity grows, from 0.48 M Gaussians, 32 views and 128 regions."""
    base = {"n": 480_000, "views": 32, "regions": 128, "scale": 1.0}
    for key, values in (
        ("views", (16, 32, 64, 128)),
        ("scale", (0.5, 1.0, 2.0)),
        ("n", (240_000, 480_000, 960_000, 1_920_000)),
        ("regions", (1, 16, 128, 1024, 5000)),
    ):
        for value in values:
            case = room_case("growth", **{**base, key: value})  # type: ignore[arg-type]
            seconds, evidence = timed(case.evidence)
            report.add(f"growth.{key}_{value}.evidence_s", seconds, f"s, {evidence.nnz} entries")


ROOMS = (("rooms_480k", 480_000, 131), ("rooms_1930k", 1_930_000, 177), ("rooms_10m", 10**7, 20))


def compare_rooms(report: Report, names: Sequence[str]) -> None:
    for name, n, views in ROOMS:
        if name in names:
            compare_with_rgb(report, room_case(name, n, views))
            torch.cuda.empty_cache()


def main(quick: bool, rooms_only: bool, output: Path) -> None:
    report = Report("gpu_rooms" if rooms_only else "h100")
    if rooms_only:
        compare_rooms(report, ("rooms_1930k", "rooms_10m"))
        report.write(output)
        return
    captures = [capture_case(name) for name in ("fox", "tabletop")]
    agreement(report, captures)
    while captures:
        measure(report, captures.pop(0))
    if not quick:
        for name, n, views in ROOMS:
            measure(report, room_case(name, n, views))
            torch.cuda.empty_cache()
        compare_rooms(report, [name for name, _, _ in ROOMS])
        growth(report)
    report.write(output)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="captures only")
    parser.add_argument("--rooms", action="store_true", help="evidence, lift and RGB of two rooms, with all stages")
    parser.add_argument("--output", type=Path, default=RESULTS, help="folder of the JSON file")
    arguments = parser.parse_args()
    main(arguments.quick, arguments.rooms, arguments.output)
