"""What a lift tells while it works: how far each stage is, and at its end what it took."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path

import torch

from normlift_ns.core.portions import Report


class Stages:
    """Adds up the seconds of each stage and passes on how far it is."""

    def __init__(self, report: Report) -> None:
        self.seconds: dict[str, float] = {}
        self._report = report
        self._done: dict[str, int] = {}

    @contextmanager
    def __call__(self, stage: str, total: int = 1) -> Iterator[Callable[[], None]]:
        """Times a stage, or a part of it; yields what to call after every step.

        Raises:
            MemoryError: the GPU's memory is full; says in which stage.
        """

        def step() -> None:
            self._done[stage] = self._done.get(stage, 0) + 1
            self._report(stage, self._done[stage], total)

        start = time.perf_counter()
        self._report(stage, self._done.get(stage, 0), total)
        try:
            yield step
        except torch.cuda.OutOfMemoryError as error:
            raise MemoryError(
                f"the GPU's memory is full in stage {stage} ({error}); lift on the CPU: --device cpu"
            ) from error
        if torch.cuda.is_available():
            torch.cuda.synchronize()
        self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - start

    def tell(self, stage: str, done: int, total: int) -> None:
        """Passes on how far a stage is that counts its steps itself."""
        self._report(stage, done, total)


def cost(seconds: Mapping[str, float], device: str) -> dict[str, float]:
    """Seconds of the stages so far and in all, and the most memory of this process, where the system tells that, and
    of the GPU, GiB."""
    peak = peak_gib()
    memory = {} if peak is None else {"memory_gib": peak}
    if torch.device(device).type == "cuda":
        memory["gpu_memory_gib"] = torch.cuda.max_memory_allocated() / 2**30
    return {**{f"{stage}_s": value for stage, value in seconds.items()}, "total_s": sum(seconds.values()), **memory}


def peak_gib() -> float | None:
    """Largest resident memory of this process so far, the libraries included, GiB; None where the system does not say.

    Linux: `VmHWM` of /proc, since `ru_maxrss` starts from that of the process by which this one was started.
    """
    status = Path("/proc/self/status")
    if status.exists():
        lines = dict(line.split(":", 1) for line in status.read_text().splitlines() if ":" in line)
        if "VmHWM" in lines:
            return int(lines["VmHWM"].split()[0]) / 2**20  # of kB
    if find_spec("resource") is None:
        return None
    import resource  # noqa: PLC0415 (Windows has none)

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (2**30 if sys.platform == "darwin" else 2**20)
