"""Results files and Markdown tables, for the pages that are made of them."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from benchmarks.report import RESULTS

TITLES = {
    "none": "without refinement",
    "plain_knn": "plain KNN voting",
    "linear": "linear averaging",
    "norm_only": "norm only",
    "support_only": "support only",
    "full": "full",
}


class Document:
    """One results file; values by key."""

    def __init__(self, path: Path) -> None:
        self.path, self.found = path, path.exists()
        self.content: dict[str, Any] = json.loads(path.read_text()) if self.found else {"metrics": []}
        self.values = {m["key"]: m["value"] for m in self.content["metrics"]}

    @property
    def origin(self) -> str:
        """Where the figures come from."""
        if not self.found:
            return f"*`results/{self.path.name}` is absent: run its benchmark first.*"
        return f"`{self.content['command']}` on {self.content['hardware']}."

    def interval(self, key: str, digits: int = 1) -> str:
        """Mean and half of its 95 % interval; empty where it was not measured."""
        v = self.values
        return f"{v[key]:.{digits}f} ± {v[f'{key}_ci95']:.{digits}f}" if key in v else ""


def documents() -> dict[str, Document]:
    """All results files that the pages speak of."""
    names = ("cpu", "forms", "presets", "h100", "accuracy", "fit", "signals", "losses")
    return {name: Document(RESULTS / f"{name}.json") for name in names}


def table(header: tuple[str, ...], rows: list[tuple[str, ...]]) -> Iterator[str]:
    """A Markdown table."""
    yield "| " + " | ".join(header) + " |"
    yield "|" + "---|" * len(header)
    yield from ("| " + " | ".join(row) + " |" for row in rows)
    yield ""
