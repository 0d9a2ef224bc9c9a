"""Progress and cost of a lift: steps and seconds of each stage, and peak memory."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path

import torch

from normlift_ns.options import option_setting

ProgressCallback = Callable[[str, int, int], None]
"""Progress callback, called with (stage, steps done, total steps)."""


class StageTimer:
    """Timer of the stages of a lift, which also reports progress."""

    def __init__(self, report: ProgressCallback, clock: Callable[[], float] = time.perf_counter) -> None:
        self.seconds: dict[str, float] = {}
        self.report = report
        """Progress callback. Stages that count their own steps call it directly."""
        self._clock = clock
        self._done: dict[str, int] = {}

    @contextmanager
    def __call__(self, stage: str, total: int = 1) -> Iterator[Callable[[], None]]:
        """Time a stage, or a part of it; yield a function to call after every step.

        Args:
            stage: Name of the stage.
            total: Number of steps of the whole stage.
        Raises:
            MemoryError: The GPU is out of memory. The message names the stage.
        """

        def step() -> None:
            self._done[stage] = self._done.get(stage, 0) + 1
            self.report(stage, self._done[stage], total)

        start = self._clock()
        self.report(stage, self._done.get(stage, 0), total)
        try:
            yield step
        except torch.cuda.OutOfMemoryError as error:
            advice = f"lift on the CPU: {option_setting('device', 'cpu')}"
            raise MemoryError(f"the GPU's memory is full in stage {stage} ({error}); {advice}") from error
        if torch.cuda.is_available():
            torch.cuda.synchronize()
        self.seconds[stage] = self.seconds.get(stage, 0.0) + self._clock() - start


def lift_cost(seconds: Mapping[str, float], device: str) -> dict[str, float]:
    """Return the seconds of each stage, their total, and the peak memory of this process and of the GPU in GiB.

    The process memory is left out if the system does not report it. The GPU memory is left out for a lift on the CPU.
    """
    peak = peak_gib()
    memory = {} if peak is None else {"memory_gib": peak}
    if torch.device(device).type == "cuda":
        memory["gpu_memory_gib"] = torch.cuda.max_memory_allocated() / 2**30
    return {**{f"{stage}_s": value for stage, value in seconds.items()}, "total_s": sum(seconds.values()), **memory}


def peak_gib() -> float | None:
    """Return the peak resident memory of this process in GiB, including libraries; None if it is unknown.

    On Linux, this is `VmHWM` from /proc, because `ru_maxrss` starts from the value of the parent process.
    """
    status = Path("/proc/self/status")
    if status.exists():
        lines = dict(line.split(":", 1) for line in status.read_text().splitlines() if ":" in line)
        if "VmHWM" in lines:
            return int(lines["VmHWM"].split()[0]) / 2**20  # from kB
    if find_spec("resource") is None:
        return None
    import resource  # noqa: PLC0415 (not on Windows)

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (2**30 if sys.platform == "darwin" else 2**20)
