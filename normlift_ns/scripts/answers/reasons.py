"""ns-normlift-query --why: the images that voted for a selection."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from PIL import Image
from rich.table import Table

from normlift_ns.core.files import file_name, new_files
from normlift_ns.front_door import open_run
from normlift_ns.insight.why import ViewVote, Why
from normlift_ns.lifted_run import LiftedRun
from normlift_ns.scripts.shared import CONSOLE, plain, say
from normlift_ns.viewer.pictures import picture_names

if TYPE_CHECKING:
    from normlift_ns.quick import QuickAnswer

IMAGES_PER_GROUP = 3
"""Number of images per prompt in each group: those with the largest weight, and those that disagree most."""
_LARGEST_WEIGHT = "weighs most"


def find_reasons(config: Path, data: Path | None, answer: QuickAnswer) -> tuple[LiftedRun, list[Why | None]]:
    """Open the whole run, and explain the selection of every prompt by the votes of its images.

    Returns:
        The run, and one explanation per prompt; None for a prompt that selects nothing.
    Raises:
        FileNotFoundError, ValueError: Same as in `open_run` and `LiftedRun.why`.
    """
    run, refined = open_run(config, data=data), answer.question.refined
    masks = torch.from_numpy(answer.selected).T
    return run, [run.votes.explain(mask, refined=refined) if bool(mask.any()) else None for mask in masks]


def to_json(run: LiftedRun, why: Why | None) -> dict[str, Any] | None:
    """Return an explanation as plain types, with image names."""
    if why is None:
        return None
    row = why.to_json()
    views = [{"photograph": run.votes.names[view["view"]], **view} for view in row["views"]]
    return {**row, "views": views}


def _votes_to_show(why: Why) -> dict[str, tuple[ViewVote, ...]]:
    """Return the images to show: those with the largest weight, and those that disagree most."""
    return {_LARGEST_WEIGHT: why.views[:IMAGES_PER_GROUP], "disagrees most": why.most_different[:IMAGES_PER_GROUP]}


def save_pictures(
    run: LiftedRun, texts: Sequence[str], reasons: Sequence[Why | None], folder: Path, *, overwrite: bool
) -> list[Path]:
    """Write the images of the largest weights and disagreements, all or none; return their paths.

    The files are <number>_<text>_1_<image>.png … and <number>_<text>_disagrees_1_<image>.png ….

    Raises:
        FileExistsError: A file exists, and `overwrite` is False.
        OSError: A file cannot be written.
        FileNotFoundError, ValueError: Same as in `Votes.pictures`.
    """
    names = picture_names(run.votes.names)
    votes: dict[Path, ViewVote] = {}
    for index, (text, why) in enumerate(zip(texts, reasons)):
        for kind, group in ({} if why is None else _votes_to_show(why)).items():
            for rank, vote in enumerate(group, 1):
                prefix = "" if kind == _LARGEST_WEIGHT else "disagrees_"
                votes[folder / f"{index}_{file_name(text)}_{prefix}{rank}_{names[vote.view]}.png"] = vote
    if len(votes) == 0:
        return []
    with new_files(*votes, overwrite=overwrite) as drafts:
        for draft, picture in zip(drafts, run.votes.pictures(votes.values())):
            Image.fromarray(picture.image.numpy()).save(draft, format="PNG")
    return list(votes)


def show_reasons(run: LiftedRun, texts: Sequence[str], reasons: Sequence[Why | None]) -> None:
    """Print a table of images, and a sentence per prompt about their agreement."""
    result = table(run.votes.names, texts, reasons, narrow=CONSOLE.width < 120)
    if result.row_count > 0:
        CONSOLE.print(result)
    for text, why in zip(texts, reasons):
        say(f"{text}: {'nothing is selected, so nothing voted for it.' if why is None else why.sentence}")


def table(names: Sequence[str], texts: Sequence[str], reasons: Sequence[Why | None], *, narrow: bool = False) -> Table:
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
                result.add_row(plain(label), kind, plain(names[vote.view]), *numbers)
                label = ""
    return result
