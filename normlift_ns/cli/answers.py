"""Tables and files that ns-normlift-query and ns-normlift-export make of an answer."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from rich.table import Table

from normlift_ns.analysis.explain import ViewVote, Why
from normlift_ns.analysis.objects import Catalogue
from normlift_ns.cli.common import CONSOLE, info, plain_text
from normlift_ns.core.device import choose_device
from normlift_ns.encoders.cache import CachedTextMasks
from normlift_ns.io.atomic import atomic_files, safe_file_name
from normlift_ns.io.run_dir import cache_folder
from normlift_ns.lifted_run import LiftedRun, open_run
from normlift_ns.query.engine import Answer, run_query
from normlift_ns.query.question import Query
from normlift_ns.query.sam3_query import MIN_MASK_FRACTION, SegmentationResult, query_sam3
from normlift_ns.rasterization.settings import RasterSettings
from normlift_ns.rendering.figures import unique_file_names
from normlift_ns.segmentation.checkpoint import TEXT_PROMPT_FAMILIES, check_sam_checkpoint

_MAX_ROWS = 40
"""Largest number of objects in the table."""


def find_catalog(config: Path, data: Path | None, question: Query, metres_per_unit: float | None) -> Catalogue:
    """Return the objects that a query selects; opens the whole run, because best views need the cameras of the scene.

    Raises:
        FileNotFoundError, ValueError: Same as in `open_run` and `LiftedRun.catalogue`.
    """
    run = open_run(config, data=data)
    result = run_query(run.field, run.scene.gaussians.means, question)
    return run.catalogue(result, metres_per_unit=metres_per_unit)


def query_metadata(question: Query) -> dict[str, Any]:
    """Return the query settings for the catalog file."""
    return {
        "texts": list(question.texts),
        "relevancy": question.rule,
        "threshold": question.threshold,
        "min_reliability": question.min_reliability,
    }


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


def explain_answer(config: Path, data: Path | None, answer: Answer) -> tuple[LiftedRun, list[Why | None]]:
    """Open the whole run, and explain the selection of every prompt by the votes of its images.

    Returns:
        The run, and one explanation per prompt; None for a prompt that selects nothing.
    Raises:
        FileNotFoundError, ValueError: Same as in `open_run` and `LiftedRun.why`.
    """
    run, refined = open_run(config, data=data), answer.question.refined
    masks = torch.as_tensor(answer.selected).T
    return run, [run.votes.explain(mask, refined=refined) if bool(mask.any()) else None for mask in masks]


def explanation_to_json(run: LiftedRun, why: Why | None) -> dict[str, Any] | None:
    """Return an explanation as plain types, with image names."""
    if why is None:
        return None
    row = why.to_json()
    views = [{"photograph": run.votes.names[view["view"]], **view} for view in row["views"]]
    return {**row, "views": views}


def _votes_to_show(why: Why) -> dict[str, tuple[ViewVote, ...]]:
    """Return the images to show: those with the largest weight, and those that disagree most."""
    return {_LARGEST_WEIGHT: why.views[:IMAGES_PER_GROUP], "disagrees most": why.most_different[:IMAGES_PER_GROUP]}


def save_vote_images(
    run: LiftedRun, texts: Sequence[str], reasons: Sequence[Why | None], folder: Path, *, overwrite: bool
) -> list[Path]:
    """Write the images of the largest weights and disagreements, all or none; return their paths.

    The files are <number>_<text>_1_<image>.png … and <number>_<text>_disagrees_1_<image>.png ….

    Raises:
        FileExistsError: A file exists, and `overwrite` is False.
        OSError: A file cannot be written.
        FileNotFoundError, ValueError: Same as in `Votes.pictures`.
    """
    names = unique_file_names(run.votes.names)
    votes: dict[Path, ViewVote] = {}
    for index, (text, why) in enumerate(zip(texts, reasons)):
        for kind, group in ({} if why is None else _votes_to_show(why)).items():
            for rank, vote in enumerate(group, 1):
                prefix = "" if kind == _LARGEST_WEIGHT else "disagrees_"
                votes[folder / f"{index}_{safe_file_name(text)}_{prefix}{rank}_{names[vote.view]}.png"] = vote
    if len(votes) == 0:
        return []
    with atomic_files(*votes, overwrite=overwrite) as drafts:
        for draft, picture in zip(drafts, run.votes.pictures(votes.values())):
            Image.fromarray(picture.image.numpy()).save(draft, format="PNG")
    return list(votes)


def print_explanations(run: LiftedRun, texts: Sequence[str], reasons: Sequence[Why | None]) -> None:
    """Print a table of images, and a sentence per prompt about their agreement."""
    result = explanation_table(run.votes.names, texts, reasons, narrow=CONSOLE.width < 120)
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


# ns-normlift-query --segment: SAM 3's masks for the same prompts, lifted and compared with the run's answer.


def segment_with_sam3(
    config: Path, data: Path | None, answer: Answer, *, model: str, views: int, device: str
) -> tuple[SegmentationResult, list[dict[str, Any]]]:
    """Segment training views with SAM 3 for the prompts of an answer, and lift the masks.

    Args:
        config: Config of the lifted run.
        data: Current path of the dataset, if it was moved.
        answer: The run's answer to the same prompts.
        model: Weights of SAM 3: a folder, or a name on the Hugging Face hub.
        views: Largest number of training views.
        device: auto, cpu or cuda.
    Returns:
        The lifted masks, and their summary for every prompt.
    Raises:
        FileNotFoundError, ValueError: as in `check_sam_checkpoint`, `open_run`, `query_sam3` and `Sam3Network.load`.
    """
    device = choose_device(device)
    check_sam_checkpoint(model, TEXT_PROMPT_FAMILIES)
    run = open_run(config, data=data)
    info(f"Running SAM 3 on {min(views, len(run.scene.train))} of {len(run.scene.train)} training views")
    settings, min_reliability = RasterSettings.recorded(run.field.manifest), answer.question.min_reliability
    cached = CachedTextMasks(model, device, cache_folder(run.folder) / "masks")
    kwargs = {"views": views, "min_reliability": min_reliability, "settings": settings, "device": device}
    segmented = query_sam3(run.scene, cached.find, answer.question.texts, **kwargs)
    rows = segmented.summarize(run.scene.gaussians.means, torch.as_tensor(answer.selected))
    return segmented, [{"model": model, **row} for row in rows]


def print_sam3_table(texts: Sequence[str], rows: Sequence[dict[str, Any]]) -> None:
    """Print the table of SAM 3's answer."""
    limit = max(row["min_reliability"] for row in rows)
    reliable = f" and reliability at least {limit:g}" if limit > 0 else ""
    table = Table(
        title=f"SAM 3: Gaussians with more than {MIN_MASK_FRACTION:.0%} of their weight in its masks{reliable}"
    )
    for name in ("text", "Gaussians", "centroid", "extent", "peak", "agreement", "reliability", "found in", "IoU"):
        table.add_column(name, justify="left" if name == "text" else "right")
    for text, row in zip(texts, rows):
        vectors = (" ".join(f"{x:.2f}" for x in row[name]) if row[name] else "-" for name in ("centroid", "extent"))
        numbers = (_format(row[name]) for name in ("peak", "agreement", "mean_reliability"))
        views = f"{len(row['found_in'])} of {len(row['views'])} views, {len(row['agree'])} agree"
        table.add_row(plain_text(text), f"{row['fraction']:.2%}", *vectors, *numbers, views, _format(row["iou"]))
    CONSOLE.print(table)


def _format(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"


def sam3_arrays(segmented: SegmentationResult) -> dict[str, np.ndarray]:
    """Return relevancy, reliability and agreement of every Gaussian, as arrays of shape [N, Q]."""
    columns = {
        "segment_relevancy": [answer.relevancy for answer in segmented.answers],
        "segment_reliability": [answer.scalars.reliability for answer in segmented.answers],
        "segment_agreement": [answer.scalars.c_inter for answer in segmented.answers],
    }
    return {name: torch.stack(tensors, dim=1).cpu().numpy() for name, tensors in columns.items()}
