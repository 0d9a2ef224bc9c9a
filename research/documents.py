"""Reader of results files, from which the tables and plots of the documentation are made."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import nan
from pathlib import Path
from typing import Any

from research.report import RESULTS, Metric

TITLES = {
    "none": "without refinement",
    "plain_knn": "plain KNN voting",
    "linear": "linear averaging",
    "norm_only": "norm only",
    "support_only": "support only",
    "paper": "the paper's vote",
    "posterior": "own evidence",
    "consensus": "consensus",
    "consensus_paper": "consensus, the paper's vote",
    "consensus_posterior": "consensus, own evidence",
}
PRESETS = {
    "exact": "float64 (--precision double)",
    "float32": "default: float32",
    "tf32": "TF32 vote",
    "half": "float16 vote",
    "low_rank": "stored in a basis, tolerance 5e-2",
    "half_resolution": "half resolution (--lift-downscale 2)",
    "every_second_view": "every second view",
}


@dataclass(frozen=True)
class Document:
    """Content of one results file."""

    command: str
    hardware: str
    metrics: tuple[Metric, ...]

    @cached_property
    def values(self) -> dict[str, float]:
        """Values by key."""
        return {metric.key: metric.value for metric in self.metrics}

    def interval(self, key: str, digits: int = 1) -> str:
        """Return the mean and half of its 95 % interval as text, or "" if the key was not measured."""
        v = self.values
        return f"{v[key]:.{digits}f} ± {v[f'{key}_ci95']:.{digits}f}" if key in v else ""


Documents = Mapping[str, Document]


def read(path: Path) -> Document:
    """Return the document of a results file, or a document without metrics if the file does not exist."""
    if not path.exists():
        return Document(f"python -m research.{path.stem.removesuffix('_gpu')}", "no machine so far", ())
    content = json.loads(path.read_text())
    rows: Iterator[dict[str, Any]] = (
        {**row, "value": nan if row["value"] is None else row["value"]} for row in content["metrics"]
    )
    return Document(content["command"], content["hardware"], tuple(Metric(**row) for row in rows))


def documents() -> Documents:
    """Return all results files that the pages use, by name."""
    names = (
        "cpu", "forms", "presets", "h100", "accuracy", "fit", "signals", "losses", "numerics", "numerics_gpu",
        "overhead", "grid", "grid_real", "geometry", "segments", "planning_gpu",
        "agreement", "worlds",
    )  # fmt: skip
    return {name: read(RESULTS / f"{name}.json") for name in names}


def steps(accuracy: Document) -> list[str]:
    """Return the names of the steps of the ladder of damage."""
    start, end = "tabletop.ladder.", ".paper.miou"
    return [k.removeprefix(start).removesuffix(end) for k in accuracy.values if k.startswith(start) and k.endswith(end)]


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table."""
    lines = ["| " + " | ".join(cells) + " |" for cells in (header, *rows)]
    return "\n".join([lines[0], "|" + "---|" * len(header), *lines[1:]]) + "\n"
