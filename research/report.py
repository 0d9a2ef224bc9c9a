"""One JSON file and one table per benchmark: every number with its unit, and times with their error against float64."""

from __future__ import annotations

import json
import math
import os
import platform
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.table import Table

RESULTS = Path(__file__).parent / "results"
NAMED = ("--quick", "--statistic", "real", "--clip")
"""Arguments that a report includes."""
PACKAGES = ("torch", "triton", "numpy", "scipy", "numba", "gsplat", "transformers")


@dataclass(frozen=True)
class Metric:
    key: str
    value: float
    unit: str
    error: float | None = None
    """Relative error against float64 of the timed result, or None if it was not measured."""


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
                ["python -m", f"research.{Path(sys.argv[0]).stem}", *(a for a in sys.argv[1:] if a in NAMED)]
            ),
            "metrics": [_row(metric) for metric in self.metrics],
        }
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / f"{self.name}.json"
        path.write_text(as_text(document))
        table = Table("key", "value", "unit", "error against float64", title=f"{self.name}: {document['hardware']}")
        for m in self.metrics:
            table.add_row(m.key, f"{m.value:.4g}", m.unit, "" if m.error is None else f"{m.error:.2e}")
        Console(width=120).print(table)
        return path


def as_text(document: Mapping[str, Any]) -> str:
    """Return the document as JSON with one line per entry of the header and per metric."""
    header = [f" {json.dumps(key)}: {json.dumps(value)}," for key, value in document.items() if key != "metrics"]
    metrics = ",\n".join(f"  {json.dumps(metric, allow_nan=False)}" for metric in document["metrics"])
    return "\n".join(["{", *header, ' "metrics": [', metrics, " ]", "}"]) + "\n"


def _row(metric: Metric) -> dict[str, Any]:
    """Return the metric for JSON, with null for numbers that are not finite."""
    numbers = {"value": metric.value, "error": metric.error}
    return asdict(metric) | {key: x if x is not None and math.isfinite(x) else None for key, x in numbers.items()}


def hardware() -> str:
    """Return the CPU and its cores, and the GPU if there is one."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    cpu = next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), platform.machine())
    cores = f"{len(os.sched_getaffinity(0))} cores of {cpu}"
    return f"{torch.cuda.get_device_name()}, {cores}" if torch.cuda.is_available() else cores


class Stopwatch:
    seconds: float


@contextmanager
def stopwatch() -> Iterator[Stopwatch]:
    watch, start = Stopwatch(), time.perf_counter()
    yield watch
    watch.seconds = time.perf_counter() - start
