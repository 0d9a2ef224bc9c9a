"""ns-normlift-query --why: which photographs voted for what is selected."""

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

SHOWN = 3
"""Photographs of a text that are shown, and as many that disagree most."""
MOST = "weighs most"


def find_reasons(config: Path, data: Path | None, found: QuickAnswer) -> tuple[LiftedRun, list[Why | None]]:
    """The run, opened whole, and what its photographs say of the selection of every text; None: nothing is selected.

    Raises:
        FileNotFoundError, ValueError: as `open_run` and `LiftedRun.why`.
    """
    run, refined = open_run(config, data=data), found.question.refined
    masks = torch.from_numpy(found.selected).T
    return run, [run.votes.explain(mask, refined=refined) if bool(mask.any()) else None for mask in masks]


def to_json(run: LiftedRun, why: Why | None) -> dict[str, Any] | None:
    """The same as plain types, with the names of the photographs."""
    if why is None:
        return None
    plain = why.to_json()
    views = [{"photograph": run.votes.names[view["view"]], **view} for view in plain["views"]]
    return {**plain, "views": views}


def shown_votes(why: Why) -> dict[str, tuple[ViewVote, ...]]:
    """The photographs to look at: those that weigh most, and those that disagree most."""
    return {MOST: why.views[:SHOWN], "disagrees most": why.most_different[:SHOWN]}


def save_pictures(
    run: LiftedRun, texts: Sequence[str], reasons: Sequence[Why | None], folder: Path, *, overwrite: bool
) -> list[Path]:
    """Writes <number>_<text>_1_<photograph>.png … of those that weigh most, <number>_<text>_disagrees_1_… of those that
    disagree most, all or none; returns their paths.

    Raises:
        FileExistsError: one is there, and `overwrite` is False.
        OSError: it cannot be written.
        FileNotFoundError, ValueError: as `Votes.pictures`.
    """
    called = picture_names(run.votes.names)
    votes: dict[Path, ViewVote] = {}
    for index, (text, why) in enumerate(zip(texts, reasons)):
        for word, some in ({} if why is None else shown_votes(why)).items():
            for place, vote in enumerate(some, 1):
                kind = "" if word == MOST else "disagrees_"
                votes[folder / f"{index}_{file_name(text)}_{kind}{place}_{called[vote.view]}.png"] = vote
    if len(votes) == 0:
        return []
    with new_files(*votes, overwrite=overwrite) as drafts:
        for draft, picture in zip(drafts, run.votes.pictures(votes.values())):
            Image.fromarray(picture.image.numpy()).save(draft, format="PNG")
    return list(votes)


def show_reasons(run: LiftedRun, texts: Sequence[str], reasons: Sequence[Why | None]) -> None:
    """Prints a table of photographs, and how far they agree in words."""
    shown = table(run.votes.names, texts, reasons, narrow=CONSOLE.width < 120)
    if shown.row_count > 0:
        CONSOLE.print(shown)
    for text, why in zip(texts, reasons):
        say(f"{text}: {'nothing is selected, so that nothing has voted for it.' if why is None else why.sentence}")


def table(names: Sequence[str], texts: Sequence[str], reasons: Sequence[Why | None], *, narrow: bool = False) -> Table:
    """The photographs of every text; a narrow table has no weights and no numbers of regions."""
    made = Table(title="Why", padding=(0, 0 if narrow else 1))
    for name in ("text", "", "photo" if narrow else "photograph"):
        made.add_column(name, overflow="fold")
    for name in (*(() if narrow else ("weight in pixels",)), "share", "agreement", "disagreement"):
        made.add_column(name, justify="right", no_wrap=True)
    if not narrow:
        made.add_column("regions", justify="right", no_wrap=True)
    for text, why in zip(texts, reasons):
        first = text
        for kind, votes in ({} if why is None else shown_votes(why)).items():
            for vote in votes:
                shares = (f"{vote.share:.1%}", f"{vote.agreement:.3f}", f"{vote.disagreement:.0%}")
                numbers = shares if narrow else (f"{vote.weight:,.0f}", *shares, str(len(vote.regions)))
                made.add_row(plain(first), kind, plain(names[vote.view]), *numbers)
                first = ""
    return made
