"""Time of the evidence on a GPU: seconds of every stage, and the longest kernels."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable
from typing import Any

import torch
from torch._C._autograd import DeviceType
from torch.profiler import ProfilerActivity, profile

from normlift_ns import Evidence
from normlift_ns.rasterization import triton

STAGES = (
    ("projection", triton, "_project"),
    ("lists", triton, "build_cell_lists"),
    ("sums", triton, "sum_regions"),
    ("merging", triton, "sum_equal_keys"),
    ("places", triton, "decode_keys"),
    ("assembly", Evidence, "join"),
)


def stage_seconds(run: Callable[[], Any]) -> dict[str, float]:
    """Return the seconds of every stage of a run.

    The GPU is synchronized between stages, so the sum exceeds the time of the whole run.
    """
    seconds: dict[str, float] = defaultdict(float)

    def timer(stage: str, step: Callable[..., Any]) -> Callable[..., Any]:
        def timed_step(*arguments: Any, **options: Any) -> Any:
            torch.cuda.synchronize()
            start = time.perf_counter()
            result = step(*arguments, **options)
            torch.cuda.synchronize()
            seconds[stage] += time.perf_counter() - start
            return result

        return timed_step

    kept = [owner.__dict__[name] for _, owner, name in STAGES]
    try:
        for stage, owner, name in STAGES:
            step = timer(stage, getattr(owner, name))
            setattr(owner, name, staticmethod(step) if isinstance(owner, type) else step)
        run()
    finally:
        for (_, owner, name), original in zip(STAGES, kept):
            setattr(owner, name, original)
    return dict(seconds)


def kernel_milliseconds(run: Callable[[], Any], most: int = 12) -> dict[str, float]:
    """Return the device milliseconds of the longest kernels of a run, and of all kernels."""
    with profile(activities=[ProfilerActivity.CUDA, ProfilerActivity.CPU]) as found:
        run()
        torch.cuda.synchronize()
    total: dict[str, float] = defaultdict(float)
    for event in found.events() or ():
        if event.device_type == DeviceType.CUDA:
            total[event.name[:70]] += event.self_device_time_total / 1e3
    longest = dict(sorted(total.items(), key=lambda x: -x[1])[:most])
    return {"all kernels": sum(total.values()), **longest}
