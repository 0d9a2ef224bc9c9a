"""Operations on binary masks: boxes, LangSplat's suppression, and label maps of overlapping masks."""

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
_MIN_KEPT = 3
"""Number of masks, best first, that are kept if no score is high enough."""


@dataclass(frozen=True)
class Suppression:
    """Thresholds of LangSplat's mask suppression; the defaults are its settings."""

    iou: float = 0.8
    """Drop a mask if its IoU with a mask of higher score is above this."""
    score: float = 0.7
    """Drop a mask if its score is not above this. If this would drop all masks, the best three are kept."""
    outer: float = 0.5
    """A mask lies inside another one if it covers less than this share of the other one and meets `inner`."""
    inner: float = 0.85
    """Least share of a mask that must lie in the other one. Masks inside others are dropped, whatever their score."""


class Measured(NamedTuple):
    """Areas and boxes of masks."""

    inner: Int32[Tensor, " m"]
    """Pixels with a logit above the offset."""
    outer: Int32[Tensor, " m"]
    """Pixels with a logit above minus the offset."""
    boxes: Int64[Tensor, "m 4"]
    """Boxes of the pixels with a positive logit, as `boxes_of` returns them."""

    @property
    def stability(self) -> Float[Tensor, " m"]:
        """IoU of each mask at the two thresholds; NaN if it is empty at both."""
        return self.inner / self.outer


def measured(logits: Float[Tensor, "m h w"], offset: float) -> Measured:
    """Return the areas of masks at two thresholds of the logits, 0 plus and minus the offset, and their boxes."""
    inner, outer = ((logits > bound).flatten(1).view(torch.uint8) for bound in (offset, -offset))
    return Measured(inner.sum(dim=1, dtype=torch.int32), outer.sum(dim=1, dtype=torch.int32), boxes_of(logits > 0))


def mask_nms(
    masks: Bool[Tensor, "m h w"], scores: Float[Tensor, " m"], rules: Suppression | None = None
) -> Bool[Tensor, " m"]:
    """Select the masks to keep by LangSplat's rules.

    A mask is kept if its score is high enough, and it neither repeats a better mask nor lies inside a larger one. Every
    mask is compared with all others, including dropped ones. Intersections are counted exactly and their ratios
    compared in float64. Among equal scores, the earlier mask is the better one.

    LangSplat also requires 1 - (inter/area_i)(inter/area_j) > 0.5 of a mask inside another one. Every pair that passes
    the tests of `outer` and `inner` fulfills this.

    Args:
        scores: Stability times predicted IoU.
        rules: Thresholds; LangSplat's by default.
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
        confident[:_MIN_KEPT] = True
    keep = torch.empty_like(confident)
    keep[order] = confident & ~repeats & ~inside
    return keep


def stack_masks(masks: Bool[Tensor, "m h w"]) -> Int32[Tensor, "depth h w"]:
    """Stack masks as label maps: the first map has the last mask of each pixel, the next map the one before it.

    The remaining entries are -1. The depth of the stack is the largest number of masks that share a pixel, at least 1.
    """
    flat = masks.flatten(1)
    depth = max(1, int(flat.sum(dim=0).max()))
    labels = torch.full((depth, flat.shape[1]), -1, dtype=torch.int32, device=masks.device)
    for columns in _column_chunks(flat):
        part = flat[:, columns].flip(0)
        pixel, flipped = part.T.nonzero(as_tuple=True)  # by pixel, with the last mask of each pixel first
        count = part.sum(dim=0)
        layer = torch.arange(len(pixel), device=masks.device) - (count.cumsum(0) - count)[pixel]
        labels[layer, columns.start + pixel] = (len(masks) - 1 - flipped).int()
    return labels.reshape(depth, *masks.shape[1:])


def boxes_of(masks: Bool[Tensor, "m h w"]) -> Int64[Tensor, "m 4"]:
    """Return the box (x0, y0, x1, y1) of each mask, with x1 and y1 inclusive; zeros for an empty mask."""
    ends = []
    for line in (masks.any(dim=1), masks.any(dim=2)):
        index = torch.arange(line.shape[1], device=masks.device)
        ends.append((torch.where(line, index, line.shape[1]).amin(dim=1), torch.where(line, index, -1).amax(dim=1)))
    (x0, x1), (y0, y1) = ends
    return torch.stack([x0, y0, x1, y1], dim=1) * (x1 >= 0)[:, None]


def _intersections(masks: Bool[Tensor, "m h w"]) -> Float64[Tensor, "m m"]:
    """Return the number of pixels that each pair of masks shares; float32 sums of ones are exact below 2^24 pixels."""
    flat = masks.flatten(1)
    both = torch.zeros(len(flat), len(flat), dtype=torch.float64, device=masks.device)
    for columns in _column_chunks(flat):
        both += _row_products(flat[:, columns])
    return both


def _row_products(part: Bool[Tensor, "m p"]) -> Tensor:
    """Return the products of all pairs of rows.

    On a GPU, tensor cores multiply int8 and add in int32 if torch supports this.
    """
    if part.is_cuda and hasattr(torch, "_int_mm"):
        count, pixels = part.shape
        padded = pad(part.view(torch.int8), (0, -pixels % 16, 0, max(32 - count, -count % 16)))  # tensor core sizes
        return torch._int_mm(padded, padded.T)[:count, :count]  # pyright: ignore[reportPrivateImportUsage]
    exact = part.float()
    return exact @ exact.T


def _column_chunks(flat: Bool[Tensor, "m p"]) -> Iterator[slice]:
    step = min(2**24, max(1, _CHUNK[flat.device.type] // max(1, len(flat))))
    return (slice(start, start + step) for start in range(0, flat.shape[1], step))
