"""Tables that ns-normlift-query prints of an answer, and images of the votes for it. Only the images need torch."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.table import Table

from normlift_ns.cli.common import CONSOLE, format_number, info, plain_text
from normlift_ns.io.atomic import atomic_files, safe_file_name
from normlift_ns.query.histogram import draw_histogram
from normlift_ns.query.question import Query

if TYPE_CHECKING:
    from normlift_ns.analysis.catalogue import Catalogue
    from normlift_ns.analysis.explain import ViewVote, Why
    from normlift_ns.analysis.vote_records import RecordedVotes


def print_answer(rows: list[dict[str, Any]], question: Query) -> None:
    """Print the table of an answer, and a note for each prompt that is probably not in the scene."""
    rule = f"{question.rule} > {question.threshold:.4g}"
    CONSOLE.print(answer_table(rows, rule, question.threshold, narrow=CONSOLE.width < 100))
    for row in rows:
        if row["stands_out"] is False:
            top, limit = row["histogram"]["top"], row["histogram"]["limit"]
            position = "" if row["nearest"] is None else f" at {format_number(row['nearest'])}"
            info(
                f"{row['text']}: probably not in this scene. The nearest match{position} has relevancy {top:.3f}; "
                f"objects in a scene usually reach at least {limit:.3g}."
            )


def answer_table(rows: list[dict[str, Any]], rule: str, threshold: float, *, narrow: bool = False) -> Table:
    """Return a table with one row per prompt.

    Args:
        rows: Rows of `Answer.to_json`.
        rule: Selection rule for the title, such as lerf > 0.5.
        threshold: Threshold that each histogram marks with a bar |.
        narrow: Leave out the histograms.
    """
    result = Table(title=f"Selected: {rule}; centroid and extent in scene units", padding=(0, 0 if narrow else 1))
    wrapped = ("text", "centroid", "extent")
    for name in ("text", "Gaussians", "centroid", "extent", "peak", "reliability"):
        justify = "left" if name == "text" else "right"
        result.add_column(name, justify=justify, no_wrap=name not in wrapped, overflow="fold")
    if not narrow:
        result.add_column("histogram", no_wrap=True)
    result.add_column("suggested", justify="right", no_wrap=True)
    for row in rows:
        names = ("centroid", "extent", "peak", "mean_reliability", "suggested_threshold")
        *cells, suggested = (format_number(row[name]) for name in names)
        bins = row["histogram"]
        bars = "-" if bins is None else draw_histogram(bins["counts"], bins["low"], bins["high"], threshold)
        histogram = () if narrow else (plain_text(bars),)
        result.add_row(plain_text(row["text"]), f"{row['fraction']:.2%}", *cells, *histogram, suggested)
    return result


# ns-normlift-query --objects: the objects in a selection.


_MAX_ROWS = 40
"""Largest number of objects in the table."""


def print_catalog(catalog: Catalogue) -> None:
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
        best = () if narrow else (plain_text(" ".join(Path(name).stem for name in item.best_views)),)
        table.add_row(str(item.id), plain_text(item.text), *cells, *best)
    CONSOLE.print(table)
    if len(catalog.objects) > _MAX_ROWS:
        info(f"{len(catalog.objects) - _MAX_ROWS:,} smaller objects are not shown; --objects-dir FOLDER writes all.")
    if catalog.num_in_small_components > 0:
        info(f"{catalog.num_in_small_components:,} selected Gaussians are in groups too small to be listed.")


# ns-normlift-query --why: the images that voted for a selection.


IMAGES_PER_GROUP = 3
"""Number of images per prompt in each group: those with the largest weight, and those that disagree most."""
_LARGEST_WEIGHT = "weighs most"


def explanation_to_json(names: Sequence[str], why: Why) -> dict[str, Any]:
    """Return an explanation as plain types, with the names of the images."""
    row = why.to_json()
    return {**row, "views": [{"photograph": names[view["view"]], **view} for view in row["views"]]}


def _votes_to_show(why: Why) -> dict[str, tuple[ViewVote, ...]]:
    """Return the images to show: those with the largest weight, and those that disagree most."""
    return {_LARGEST_WEIGHT: why.views[:IMAGES_PER_GROUP], "disagrees most": why.most_different[:IMAGES_PER_GROUP]}


def save_vote_images(
    recorded: RecordedVotes, texts: Sequence[str], reasons: Sequence[Why | None], folder: Path, *, overwrite: bool
) -> None:
    """Write the images of the largest weights and disagreements, all or none.

    The files are <number>_<text>_1_<image>.png … and <number>_<text>_disagrees_1_<image>.png ….

    Raises:
        FileExistsError: A file exists, and `overwrite` is False.
        OSError: A file cannot be written.
        FileNotFoundError, ValueError: Same as in `Votes.pictures`.
    """
    from PIL import Image  # noqa: PLC0415 (the tables do not need it)

    from normlift_ns.rendering.figures import unique_file_names  # noqa: PLC0415

    names = unique_file_names(recorded.names)
    votes: dict[Path, ViewVote] = {}
    for index, (text, why) in enumerate(zip(texts, reasons)):
        for kind, group in ({} if why is None else _votes_to_show(why)).items():
            for rank, vote in enumerate(group, 1):
                prefix = "" if kind == _LARGEST_WEIGHT else "disagrees_"
                votes[folder / f"{index}_{safe_file_name(text)}_{prefix}{rank}_{names[vote.view]}.png"] = vote
    with atomic_files(*votes, overwrite=overwrite) if len(votes) > 0 else nullcontext(()) as drafts:
        for draft, picture in zip(drafts, recorded.pictures(votes.values())):
            Image.fromarray(picture.image.numpy()).save(draft, format="PNG")


def print_explanations(names: Sequence[str], texts: Sequence[str], reasons: Sequence[Why | None]) -> None:
    """Print a table of images, and a sentence per prompt about their agreement."""
    result = explanation_table(names, texts, reasons, narrow=CONSOLE.width < 120)
    if result.row_count > 0:
        CONSOLE.print(result)
    for text, why in zip(texts, reasons):
        info(f"{text}: {'nothing is selected, so nothing voted for it.' if why is None else why.sentence}")


def explanation_table(
    names: Sequence[str], texts: Sequence[str], reasons: Sequence[Why | None], *, narrow: bool = False
) -> Table:
    """Return a table of the images of every prompt; a narrow table leaves out weights and region counts."""
    result = Table(title="Why", padding=(0, 0 if narrow else 1))
    for name in ("text", "", "image"):
        result.add_column(name, overflow="fold")
    for name in (*(() if narrow else ("weight in pixels",)), "share", "agreement", "disagreement"):
        result.add_column(name, justify="right", no_wrap=True)
    if not narrow:
        result.add_column("regions", justify="right", no_wrap=True)
    for text, why in zip(texts, reasons):
        label = text
        for kind, votes in ({} if why is None else _votes_to_show(why)).items():
            for vote in votes:
                shares = (f"{vote.share:.1%}", f"{vote.agreement:.3f}", f"{vote.disagreement:.0%}")
                numbers = shares if narrow else (f"{vote.weight:,.0f}", *shares, str(len(vote.regions)))
                result.add_row(plain_text(label), kind, plain_text(names[vote.view]), *numbers)
                label = ""
    return result


# ns-normlift-query --segment: SAM 3's masks for the same prompts.


def print_sam3_table(texts: Sequence[str], rows: Sequence[dict[str, Any]]) -> None:
    """Print the table of SAM 3's answer."""
    from normlift_ns.query.sam3_query import MIN_MASK_FRACTION  # noqa: PLC0415 (loads torch)

    limit = max(row["min_reliability"] for row in rows)
    reliable = f" and reliability at least {limit:g}" if limit > 0 else ""
    table = Table(
        title=f"SAM 3: Gaussians with more than {MIN_MASK_FRACTION:.0%} of their weight in its masks{reliable}"
    )
    for name in ("text", "Gaussians", "centroid", "extent", "peak", "agreement", "reliability", "found in", "IoU"):
        table.add_column(name, justify="left" if name == "text" else "right")
    for text, row in zip(texts, rows):
        names = ("centroid", "extent", "peak", "agreement", "mean_reliability")
        numbers = (format_number(row[name]) for name in names)
        views = f"{len(row['found_in'])} of {len(row['views'])} views, {len(row['agree'])} agree"
        table.add_row(plain_text(text), f"{row['fraction']:.2%}", *numbers, views, format_number(row["iou"]))
    CONSOLE.print(table)
