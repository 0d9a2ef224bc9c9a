"""Rules on binary masks: boxes, LangSplat's suppression, and label maps of masks that overlap."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Float64, Int32, Int64
from torch import Tensor
from torch.nn.functional import pad

_CHUNK = {"cuda": 2**29, "cpu": 2**26}
"""Elements of the largest temporary array."""
_FORCED = 3
"""Masks that stay, best first, where none is scored well enough."""


@dataclass(frozen=True)
class Suppression:
    """LangSplat's suppression of masks by masks; the defaults are its settings."""

    iou: float = 0.8
    """A mask goes if its IoU with one of a higher score is above this."""
    score: float = 0.7
    """A mask goes if its score is not above this; the best three stay if that would be all of them."""
    outer: float = 0.5
    """One mask lies inside another if it covers less than this share of it, ..."""
    inner: float = 0.85
    """... and at least this share of itself lies there. Such a mask goes, whatever its score."""


class Measured(NamedTuple):
    """Of each mask."""

    inner: Int32[Tensor, " m"]
    """Pixels above the offset."""
    outer: Int32[Tensor, " m"]
    """Pixels above minus the offset."""
    boxes: Int64[Tensor, "m 4"]
    """As `boxes_of` returns them."""

    @property
    def stability(self) -> Float[Tensor, " m"]:
        """IoU of the masks at both thresholds; NaN where both are empty."""
        return self.inner / self.outer


def measured(logits: Float[Tensor, "m h w"], offset: float) -> Measured:
    """How large masks are at two thresholds of the logits, 0 plus and minus the offset, and where they lie."""
    inner, outer = ((logits > bound).flatten(1).view(torch.uint8) for bound in (offset, -offset))
    return Measured(inner.sum(dim=1, dtype=torch.int32), outer.sum(dim=1, dtype=torch.int32), boxes_of(logits > 0))


def mask_nms(
    masks: Bool[Tensor, "m h w"], scores: Float[Tensor, " m"], rules: Suppression | None = None
) -> Bool[Tensor, " m"]:
    """Which masks stay: those scored well enough that neither repeat a better mask nor lie inside a larger one.

    All masks are compared with all, also with those that go. Intersections are counted exactly and their ratios
    compared in float64. Equal scores: the earlier mask is the better one.

    LangSplat also asks for 1 - (inter/area_i)(inter/area_j) > 0.5 of a mask inside another, which every pair fulfils
    that passes the two tests of shares.

    Args:
        scores: stability times predicted IoU.
        rules: LangSplat's by default.
    """
    rules = Suppression() if rules is None else rules
    if len(masks) == 0:
        return torch.zeros(0, dtype=torch.bool, device=masks.device)
    order = torch.sort(scores, descending=True, stable=True).indices
    both = _intersections(masks)[order][:, order]
    area = both.diagonal()
    iou = both / (area[:, None] + area - both)
    repeats = (iou.triu(diagonal=1) > rules.iou).any(dim=0)
    inside = ((both / area[:, None] < rules.outer) & (both / area >= rules.inner)).any(dim=0)
    confident = scores[order] > rules.score
    if not bool(confident.any()):
        confident[:_FORCED] = True
    keep = torch.empty_like(confident)
    keep[order] = confident & ~repeats & ~inside
    return keep


def stack_masks(masks: Bool[Tensor, "m h w"]) -> Int32[Tensor, "depth h w"]:
    """Masks as label maps that lie on one another: where masks overlap the later one is on top; -1 beneath the last.

    The depth is the largest number of masks that share a pixel, at least 1.
    """
    flat = masks.flatten(1)
    depth = max(1, int(flat.sum(dim=0).max()))
    labels = torch.full((depth, flat.shape[1]), -1, dtype=torch.int32, device=masks.device)
    for columns in _column_chunks(flat):
        part = flat[:, columns].flip(0)
        pixel, upward = part.T.nonzero(as_tuple=True)  # pixel by pixel, in each the last mask first
        sharing = part.sum(dim=0)
        above = torch.arange(len(pixel), device=masks.device) - (sharing.cumsum(0) - sharing)[pixel]
        labels[above, columns.start + pixel] = (len(masks) - 1 - upward).int()
    return labels.reshape(depth, *masks.shape[1:])


def boxes_of(masks: Bool[Tensor, "m h w"]) -> Int64[Tensor, "m 4"]:
    """First and last column and row of each mask, as (x0, y0, x1, y1), both ends inside; zeros for an empty mask."""
    ends = []
    for line in (masks.any(dim=1), masks.any(dim=2)):
        index = torch.arange(line.shape[1], device=masks.device)
        ends.append((torch.where(line, index, line.shape[1]).amin(dim=1), torch.where(line, index, -1).amax(dim=1)))
    (x0, x1), (y0, y1) = ends
    return torch.stack([x0, y0, x1, y1], dim=1) * (x1 >= 0)[:, None]


def _intersections(masks: Bool[Tensor, "m h w"]) -> Float64[Tensor, "m m"]:
    """Pixels that masks share, counted exactly: float32 sums of ones are exact below 2^24 pixels."""
    flat = masks.flatten(1)
    both = torch.zeros(len(flat), len(flat), dtype=torch.float64, device=masks.device)
    for columns in _column_chunks(flat):
        both += _counted(flat[:, columns])
    return both


def _counted(part: Bool[Tensor, "m p"]) -> Tensor:
    """Products of all rows; on a GPU in tensor cores, whole numbers of 8 bits added up in 32, where torch can."""
    if part.is_cuda and hasattr(torch, "_int_mm"):
        count, pixels = part.shape
        whole = pad(part.view(torch.int8), (0, -pixels % 16, 0, max(32 - count, -count % 16)))  # what tensor cores take
        return torch._int_mm(whole, whole.T)[:count, :count]  # pyright: ignore[reportPrivateImportUsage]
    exact = part.float()
    return exact @ exact.T


def _column_chunks(flat: Bool[Tensor, "m p"]) -> Iterator[slice]:
    step = min(2**24, max(1, _CHUNK[flat.device.type] // max(1, len(flat))))
    return (slice(start, start + step) for start in range(0, flat.shape[1], step))
