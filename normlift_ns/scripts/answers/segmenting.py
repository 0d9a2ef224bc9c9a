"""ns-normlift-query --segment: SAM 3's masks for the same prompts, lifted and compared with the run's answer."""

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
    config: Path, data: Path | None, answer: QuickAnswer, *, model: str, views: int, device: str
) -> tuple[Segmented, list[dict[str, Any]]]:
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
        FileNotFoundError, ValueError: Same as in `check_sam`, `open_run`, `segment` and `Sam3Network.load`.
    """
    device = choose_device(device)
    check_sam(model, TEXT_KINDS)
    run = open_run(config, data=data)
    say(f"Running SAM 3 on {min(views, len(run.scene.train))} of {len(run.scene.train)} training views")
    settings, min_reliability = RasterSettings.recorded(run.field.manifest), answer.question.min_reliability
    cached = KeptTextMasks(model, device, cache_folder(run.folder) / "masks")
    kwargs = {"views": views, "min_reliability": min_reliability, "settings": settings, "device": device}
    segmented = segment(run.scene, cached.find, answer.question.texts, **kwargs)
    rows = segmented.summarize(run.scene.gaussians.means, torch.from_numpy(answer.selected))
    return segmented, [{"model": model, **row} for row in rows]


def show_segments(texts: Sequence[str], rows: Sequence[dict[str, Any]]) -> None:
    """Print the table of SAM 3's answer."""
    limit = max(row["min_reliability"] for row in rows)
    reliable = f" and reliability at least {limit:g}" if limit > 0 else ""
    table = Table(title=f"SAM 3: Gaussians with more than {SHARE:.0%} of their weight in its masks{reliable}")
    for name in ("text", "Gaussians", "centroid", "extent", "peak", "agreement", "reliability", "found in", "IoU"):
        table.add_column(name, justify="left" if name == "text" else "right")
    for text, row in zip(texts, rows):
        vectors = (" ".join(f"{x:.2f}" for x in row[name]) if row[name] else "-" for name in ("centroid", "extent"))
        numbers = (_format(row[name]) for name in ("peak", "agreement", "mean_reliability"))
        views = f"{len(row['found_in'])} of {len(row['views'])} views, {len(row['agree'])} agree"
        table.add_row(plain(text), f"{row['fraction']:.2%}", *vectors, *numbers, views, _format(row["iou"]))
    CONSOLE.print(table)


def _format(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"


def segment_arrays(segmented: Segmented) -> dict[str, np.ndarray]:
    """Return relevancy, reliability and agreement of every Gaussian, as arrays of shape [N, Q]."""
    columns = {
        "segment_relevancy": [answer.relevancy for answer in segmented.answers],
        "segment_reliability": [answer.scalars.reliability for answer in segmented.answers],
        "segment_agreement": [answer.scalars.c_inter for answer in segmented.answers],
    }
    return {name: torch.stack(tensors, dim=1).cpu().numpy() for name, tensors in columns.items()}
