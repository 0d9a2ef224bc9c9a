"""Several cuts of one image: the common pieces, so that evidence is rasterized once for all of them."""

from __future__ import annotations

import torch
from jaxtyping import Int32
from torch import Tensor


def joint_partition(maps: Int32[Tensor, "levels h w"]) -> tuple[Int32[Tensor, "h w"], Int32[Tensor, "levels c"]]:
    """Cells: the sets of pixels that have the same label in every level.

    Args:
        maps: region of every pixel in every level, -1 for none.
    Returns:
        The cell of every pixel, ids 0..C-1 without gaps, -1 where no level has a label; and the region of every cell in
        every level, -1 for none. With one level without gaps in its ids, cells are its regions.
    """
    key = torch.zeros(maps.shape[1:], dtype=torch.int64)
    for labels in maps:
        key = key * (int(labels.max()) + 2) + labels + 1
        if len(maps) > 2:  # so that the product of the numbers of regions stays in 64 bits
            key = key.unique(return_inverse=True)[1]
    _, cells = key.unique(return_inverse=True)
    nothing = bool((maps == -1).all(dim=0).any())  # their key, 0, is the least
    cells = cells - int(nothing)
    regions = torch.empty(len(maps), int(cells.max()) + 1, dtype=torch.int32)
    labelled = cells >= 0
    for level, labels in enumerate(maps):
        regions[level, cells[labelled]] = labels[labelled]
    return cells.int(), regions
