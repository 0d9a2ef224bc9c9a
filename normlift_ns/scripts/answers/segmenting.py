"""ns-normlift-query --segment: what SAM 3 answers, beside the answer of the lifted run."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from rich.table import Table

from normlift_ns.core.gpu import choose_device
from normlift_ns.encoders.cache import KeptTextMasks
from normlift_ns.encoders.sam.folders import TEXT_KINDS
from normlift_ns.encoders.sam.weights import check_sam
from normlift_ns.front_door import open_run
from normlift_ns.raster.settings import RasterSettings
from normlift_ns.runs.files import cache_folder
from normlift_ns.scripts.shared import CONSOLE, plain, say
from normlift_ns.segmenting import SHARE, Segmented, segment

if TYPE_CHECKING:
    from normlift_ns.quick import QuickAnswer


def ask_sam3(
    config: Path, data: Path | None, found: QuickAnswer, *, model: str, views: int, device: str
) -> tuple[Segmented, list[dict[str, Any]]]:
    """What SAM 3 answers to the same texts, and its numbers for every text.

    Args:
        model: a folder, or a name on the hub.
        views: training views to ask in, at most.
    Raises:
        FileNotFoundError, ValueError: as `check_sam`, `open_run`, `segment` and `Sam3Network.load`.
    """
    device = choose_device(device)
    check_sam(model, TEXT_KINDS)
    run = open_run(config, data=data)
    say(f"Asking SAM 3 in {min(views, len(run.scene.train))} of {len(run.scene.train)} training views")
    settings = RasterSettings.recorded(run.field.manifest)
    kept, sure = KeptTextMasks(model, device, cache_folder(run.folder) / "masks"), found.question.min_reliability
    how = {"views": views, "min_reliability": sure, "settings": settings, "device": device}
    answered = segment(run.scene, kept.find, found.question.texts, **how)
    rows = answered.summarize(run.scene.gaussians.means, torch.from_numpy(found.selected))
    return answered, [{"model": model, **row} for row in rows]


def show_segments(texts: Sequence[str], rows: Sequence[dict[str, Any]]) -> None:
    """Prints the table of SAM 3's answer."""
    least = max(row["min_reliability"] for row in rows)
    sure = f", and whose reliability is {least:g} or more" if least > 0 else ""
    made = Table(title=f"SAM 3: Gaussians of which more than {SHARE:.0%} lies in its masks{sure}")
    for name in ("text", "Gaussians", "centroid", "extent", "peak", "agreement", "reliability", "found in", "IoU"):
        made.add_column(name, justify="left" if name == "text" else "right")
    for text, row in zip(texts, rows):
        places = (" ".join(f"{x:.2f}" for x in row[name]) if row[name] else "-" for name in ("centroid", "extent"))
        numbers = (_number(row[name]) for name in ("peak", "agreement", "mean_reliability"))
        views = f"{len(row['found_in'])} of {len(row['views'])} views, {len(row['agree'])} agree"
        made.add_row(plain(text), f"{row['fraction']:.2%}", *places, *numbers, views, _number(row["iou"]))
    CONSOLE.print(made)


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"


def segment_arrays(answered: Segmented) -> dict[str, np.ndarray]:
    """Relevancy, reliability and agreement of every Gaussian, [N, Q] each."""
    parts = {
        "segment_relevancy": [answer.relevancy for answer in answered.answers],
        "segment_reliability": [answer.scalars.reliability for answer in answered.answers],
        "segment_agreement": [answer.scalars.c_inter for answer in answered.answers],
    }
    return {name: torch.stack(columns, dim=1).cpu().numpy() for name, columns in parts.items()}
