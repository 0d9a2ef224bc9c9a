"""One JSON file and one table per benchmark: every number with its unit, and times with their error against float64."""

from __future__ import annotations

import json
import os
import platform
import resource
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path

import torch
from rich.console import Console
from rich.table import Table

RESULTS = Path(__file__).parent / "results"
PACKAGES = ("torch", "triton", "numpy", "scipy", "numba", "gsplat", "transformers")


@dataclass(frozen=True)
class Metric:
    key: str
    value: float
    unit: str
    error: float | None = None
    """Relative error against float64 of the result that took this time, where there is one."""


@dataclass
class Report:
    """Collects metrics; `write` saves them as results/NAME.json and prints the table."""

    name: str
    metrics: list[Metric] = field(default_factory=list)

    def add(self, key: str, value: float | torch.Tensor, unit: str, error: float | torch.Tensor | None = None) -> None:
        self.metrics.append(Metric(key, float(value), unit, None if error is None else float(error)))

    def write(self, folder: Path = RESULTS) -> Path:
        document = {
            "hardware": hardware(),
            "versions": {"python": platform.python_version(), **{x: version(x) for x in PACKAGES if find_spec(x)}},
            "command": " ".join(
                ["python -m", f"benchmarks.{Path(sys.argv[0]).stem}", *(a for a in sys.argv[1:] if a == "--quick")]
            ),
            "metrics": [asdict(metric) for metric in self.metrics],
        }
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / f"{self.name}.json"
        path.write_text(json.dumps(document, indent=1) + "\n")
        table = Table("key", "value", "unit", "error against float64", title=f"{self.name}: {document['hardware']}")
        for m in self.metrics:
            table.add_row(m.key, f"{m.value:.4g}", m.unit, "" if m.error is None else f"{m.error:.2e}")
        Console(width=120).print(table)
        return path


def hardware() -> str:
    """CPU and cores, and the GPU if there is one."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    cpu = next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), platform.machine())
    cores = f"{len(os.sched_getaffinity(0))} cores of {cpu}"
    return f"{torch.cuda.get_device_name()}, {cores}" if torch.cuda.is_available() else cores


def peak_gib() -> float:
    """Largest resident memory of this process so far, the libraries included."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


class Stopwatch:
    seconds: float


@contextmanager
def stopwatch() -> Iterator[Stopwatch]:
    watch, start = Stopwatch(), time.perf_counter()
    yield watch
    watch.seconds = time.perf_counter() - start
