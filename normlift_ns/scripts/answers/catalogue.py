"""ns-normlift-query --objects: a catalogue of what is selected."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rich.table import Table

from normlift_ns.asking import answer
from normlift_ns.front_door import open_run
from normlift_ns.objects.catalogue import Catalogue
from normlift_ns.question import Question
from normlift_ns.scripts.shared import CONSOLE, plain, say

_SHOWN = 40
"""Objects in the table, at most."""


def find_catalogue(config: Path, data: Path | None, question: Question, metres_per_unit: float | None) -> Catalogue:
    """The objects of the answer to a question, of the run opened whole: only its scene knows cameras.

    Raises:
        FileNotFoundError, ValueError: as `open_run` and `LiftedRun.catalogue`.
    """
    run = open_run(config, data=data)
    found = answer(run.field, run.scene.gaussians.means, question)
    return run.catalogue(found, metres_per_unit=metres_per_unit)


def facts(question: Question) -> dict[str, Any]:
    """How objects were found, for the file."""
    return {
        "texts": list(question.texts),
        "relevancy": question.rule,
        "threshold": question.threshold,
        "min_reliability": question.min_reliability,
    }


def show_catalogue(catalogue: Catalogue) -> None:
    """Prints the table of objects, the largest of many, with places in the coordinates of the capture."""
    table = Table(title=f"Objects, in {catalogue.unit}s", padding=(0, 0 if CONSOLE.width < 100 else 1))
    table.add_column("id")
    table.add_column("text", overflow="fold")
    tiny = CONSOLE.width < 70
    vectors = ("centroid", "box", *(() if tiny else ("extent",)))
    for name in ("Gaussians", *vectors, "R", "views"):
        width = 8 if name in vectors else None  # a number is not broken in two
        table.add_column(name, justify="right", no_wrap=name not in vectors, overflow="fold", min_width=width)
    if not tiny:
        table.add_column("best views")
    largest = sorted(catalogue.objects, key=lambda found: -found.gaussians)[:_SHOWN]
    for found in sorted(largest, key=lambda found: found.id):
        place = found.capture
        rows = (place.centroid, place.box.size, place.extent)[: len(vectors)]
        places = (" ".join(f"{x:.3g}" for x in row) for row in rows)
        numbers = (f"{found.gaussians:,}", *places, f"{found.reliability:.3f}", str(found.views))
        best = () if tiny else (plain(" ".join(Path(name).stem for name in found.best_views)),)
        table.add_row(str(found.id), plain(found.text), *numbers, *best)
    CONSOLE.print(table)
    if len(catalogue.objects) > _SHOWN:
        say(f"{len(catalogue.objects) - _SHOWN:,} smaller objects are not shown; --objects-dir FOLDER writes all.")
    if catalogue.in_smaller_parts > 0:
        say(f"{catalogue.in_smaller_parts:,} selected Gaussians are in parts too small to be listed.")
