"""ns-normlift-query --objects: a catalog of the selected objects."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rich.table import Table

from normlift_ns.asking import answer
from normlift_ns.front_door import open_run
from normlift_ns.objects.catalogue import Catalogue
from normlift_ns.question import Question
from normlift_ns.scripts.shared import CONSOLE, plain, say

_MAX_ROWS = 40
"""Largest number of objects in the table."""


def find_catalogue(config: Path, data: Path | None, question: Question, metres_per_unit: float | None) -> Catalogue:
    """Return the objects that a query selects; opens the whole run, because best views need the cameras of the scene.

    Raises:
        FileNotFoundError, ValueError: Same as in `open_run` and `LiftedRun.catalogue`.
    """
    run = open_run(config, data=data)
    result = answer(run.field, run.scene.gaussians.means, question)
    return run.catalogue(result, metres_per_unit=metres_per_unit)


def facts(question: Question) -> dict[str, Any]:
    """Return the query settings for the catalog file."""
    return {
        "texts": list(question.texts),
        "relevancy": question.rule,
        "threshold": question.threshold,
        "min_reliability": question.min_reliability,
    }


def show_catalogue(catalog: Catalogue) -> None:
    """Print a table of the largest objects, in capture coordinates."""
    table = Table(title=f"Objects, in {catalog.unit}s", padding=(0, 0 if CONSOLE.width < 100 else 1))
    table.add_column("id")
    table.add_column("text", overflow="fold")
    narrow = CONSOLE.width < 70
    vectors = ("centroid", "box", *(() if narrow else ("extent",)))
    for name in ("Gaussians", *vectors, "R", "views"):
        width = 8 if name in vectors else None  # keeps each number on one line
        table.add_column(name, justify="right", no_wrap=name not in vectors, overflow="fold", min_width=width)
    if not narrow:
        table.add_column("best views")
    largest = sorted(catalog.objects, key=lambda item: -item.gaussians)[:_MAX_ROWS]
    for item in sorted(largest, key=lambda item: item.id):
        geometry = item.capture
        rows = (geometry.centroid, geometry.box.size, geometry.extent)[: len(vectors)]
        numbers = (" ".join(f"{x:.3g}" for x in row) for row in rows)
        cells = (f"{item.gaussians:,}", *numbers, f"{item.reliability:.3f}", str(item.views))
        best = () if narrow else (plain(" ".join(Path(name).stem for name in item.best_views)),)
        table.add_row(str(item.id), plain(item.text), *cells, *best)
    CONSOLE.print(table)
    if len(catalog.objects) > _MAX_ROWS:
        say(f"{len(catalog.objects) - _MAX_ROWS:,} smaller objects are not shown; --objects-dir FOLDER writes all.")
    if catalog.in_smaller_parts > 0:
        say(f"{catalog.in_smaller_parts:,} selected Gaussians are in groups too small to be listed.")
