"""Where the time of the evidence goes on a GPU: seconds of every stage, the longest kernels, and variants of the lists.

    python -m benchmarks.gpu_stages            rooms of 1.93 and 10 million Gaussians
    python -m benchmarks.gpu_stages --quick    a room of 0.48 million

Stages are timed one after the other, the GPU waited for between them, so that they add up to more than the whole.
"""

from __future__ import annotations

import argparse
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch._C._autograd import DeviceType
from torch.profiler import ProfilerActivity, profile

from benchmarks.cpu import relative_difference
from benchmarks.gpu import Case, features, room_case, stock_renders, timed
from benchmarks.report import Report
from normlift_ns import Evidence, lift
from normlift_ns.kernels import regions
from normlift_ns.raster import rasterize, triton

STAGES = (
    ("projection", triton, "project"),
    ("lists", triton, "list_cells"),
    ("sums", triton, "region_sums"),
    ("merging", triton, "sum_equal_keys"),
    ("assembly", Evidence, "from_entries"),
)
VARIANTS = [((16, 16), 8, 4), ((16, 16), 11, 4), ((16, 8), 8, 4), ((16, 8), 5, 4), ((16, 8), 5, 8), ((8, 8), 2, 4)]
"""Cell, views in flight, splats between two looks."""


@contextmanager
def watched(seconds: dict[str, float]) -> Iterator[None]:
    """Adds up the time of every stage, the GPU waited for."""
    kept = [(owner, name, owner.__dict__[name]) for _, owner, name in STAGES]

    def timer(stage: str, run: Callable[..., Any]) -> Callable[..., Any]:
        def timed_run(*arguments: Any, **options: Any) -> Any:
            torch.cuda.synchronize()
            start = time.perf_counter()
            result = run(*arguments, **options)
            torch.cuda.synchronize()
            seconds[stage] += time.perf_counter() - start
            return result

        return timed_run

    try:
        for (stage, owner, name), (_, _, original) in zip(STAGES, kept):
            run = getattr(owner, name)
            setattr(
                owner,
                name,
                staticmethod(timer(stage, run)) if isinstance(original, staticmethod) else timer(stage, run),
            )
        yield
    finally:
        for owner, name, original in kept:
            setattr(owner, name, original)


@contextmanager
def variant(cell: tuple[int, int], views: int, unroll: int) -> Iterator[None]:
    kept = triton.CELL, rasterize._IN_FLIGHT, regions.UNROLL
    triton.CELL, rasterize._IN_FLIGHT, regions.UNROLL = cell, views, unroll
    try:
        yield
    finally:
        triton.CELL, rasterize._IN_FLIGHT, regions.UNROLL = kept


def kernels(run: Callable[[], Any], most: int = 14) -> dict[str, float]:
    """Device milliseconds of the longest kernels of a run, and of all."""
    with profile(activities=[ProfilerActivity.CUDA, ProfilerActivity.CPU]) as found:
        run()
        torch.cuda.synchronize()
    total: dict[str, float] = defaultdict(float)
    for event in found.events() or ():
        if event.device_type == DeviceType.CUDA:
            total[event.name[:70]] += event.self_device_time_total / 1e3
    longest = dict(sorted(total.items(), key=lambda x: -x[1])[:most])
    return {"all kernels": sum(total.values()), **longest}


def measure(report: Report, case: Case, variants: bool, gsplat: bool) -> None:
    def add(key: str, value: Any, unit: str, error: Any = None) -> None:
        report.add(f"{case.name}.{key}", value, unit, error)

    with torch.no_grad():
        rgb_s = timed(stock_renders(case)[0])[0] if gsplat else float("nan")
        evidence_s, evidence = timed(case.evidence)
        table = features(evidence.num_regions)
        reliability_s, lifted = timed(lambda: lift(evidence, table))
        directions_s = timed(lambda: lifted.directions(dtype=torch.float16))[0]
        add("rgb_s", rgb_s, "s")
        add("evidence_s", evidence_s, "s")
        add("reliability_s", reliability_s, "s")
        add("directions_s", directions_s, "s")
        add("evidence_lift_over_rgb", (evidence_s + reliability_s + directions_s) / rgb_s, "times the RGB render")
        seconds: dict[str, float] = defaultdict(float)
        with watched(seconds):
            case.evidence()
        for stage, spent in seconds.items():
            add(f"stage.{stage}_ms", 1e3 * spent, "ms")
        for name, spent in kernels(case.evidence).items():
            print(f"{case.name}: {spent:9.2f} ms  {name}")
        for name, spent in kernels(lambda: (lift(evidence, table), lifted.directions(dtype=torch.float16)), 6).items():
            print(f"{case.name}, lift: {spent:9.2f} ms  {name}")
        for choice in VARIANTS if variants else []:
            with variant(*choice):
                spent, other = timed(case.evidence)
            (wide, high), views, unroll = choice
            difference = relative_difference(other.rows, evidence.rows)
            add(
                f"cells_{wide}x{high}.views_{views}.unroll_{unroll}.evidence_s",
                spent,
                "s, error is the difference",
                difference,
            )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a small room only")
    parser.add_argument("--variants", action="store_true", help="other cells and flights too")
    parser.add_argument("--without-gsplat", action="store_true", help="no RGB render to compare with")
    arguments = parser.parse_args()
    report = Report("gpu_stages")
    rooms = (
        [("rooms_480k", 480_000, 131)]
        if arguments.quick
        else [("rooms_1930k", 1_930_000, 177), ("rooms_10m", 10**7, 20)]
    )
    for name, n, views in rooms:
        measure(report, room_case(name, n, views), arguments.variants, not arguments.without_gsplat)
        torch.cuda.empty_cache()
    report.write()
