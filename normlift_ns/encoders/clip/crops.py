"""Masked square crops of regions, as LangSplat cuts them.

For every region: pixels outside of it are filled, the image is cropped to its box, padded with black to a centred
square and resized bilinearly. LangSplat fills with black; LaGa and SFS fill with white (and pad with black too).
LangSplat's boxes, which come from SAM, leave out the last row and column of a mask; ours do not.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import groupby
from operator import itemgetter
from typing import NamedTuple

import torch
from jaxtyping import Float, Float32, Int32, Int64, UInt8
from torch import Tensor

from normlift_ns.encoders.batches import Batches
from normlift_ns.options import Fill


class CropNetwork(NamedTuple):
    """What a network needs to see crops. The functions are called where there is something to see."""

    size: Callable[[], tuple[int, int]]
    """Height and width of the crops that it takes."""
    rows: Callable[[Float[Tensor, "b 3 y x"]], Float32[Tensor, "b d"]]
    """Crops, 0..255, on the device, to unit rows on the CPU."""
    width: Callable[[], int]
    """D."""


def crop_features(
    views: Iterable[tuple[UInt8[Tensor, "h w 3"], Int32[Tensor, "depth h w"]]],
    network: CropNetwork,
    batches: Batches,
    fill: Fill,
    device: str,
) -> Iterator[Float32[Tensor, "r d"]]:
    """One unit row per region of every view, as `Encoder.encode_each` gives them: crops of several views fill a batch.

    Raises:
        MemoryError: the memory of the device does not hold a single crop.
    """
    seen: dict[int, _Seen] = {}

    def crops() -> Iterator[list[tuple[int, int]]]:
        for number, (image, labels) in enumerate(views):
            there = labels.to(device)
            seen[number] = _Seen(image.to(device), there, region_boxes(there))
            yield [(number, region) for region in range(len(seen[number].boxes))]

    def encode(batch: Sequence[tuple[int, int]]) -> Tensor:
        cut = []
        for number, crops_of_view in groupby(batch, itemgetter(0)):
            image, labels, boxes = seen[number]
            regions = torch.tensor([region for _, region in crops_of_view], device=device)
            cut.append(masked_crops(image, labels, regions, boxes[regions], network.size(), fill))
        return network.rows(torch.cat(cut))

    for number, rows in enumerate(batches.across(encode, crops())):
        del seen[number]
        yield torch.stack(rows) if len(rows) > 0 else torch.empty(0, network.width())


class _Seen(NamedTuple):
    """A view, on the device, whose regions wait for a batch."""

    image: UInt8[Tensor, "h w 3"]
    labels: Int32[Tensor, "depth h w"]
    boxes: Int64[Tensor, "r 4"]


def region_boxes(labels: Int32[Tensor, "depth h w"]) -> Int64[Tensor, "r 4"]:
    """First and last column and row of each region, as (x0, y0, x1, y1), both ends inside."""
    depth, y, x = (labels >= 0).nonzero(as_tuple=True)
    region = labels[depth, y, x].long()
    count = int(region.max()) + 1 if len(region) > 0 else 0
    ends = ((x, "amin"), (y, "amin"), (x, "amax"), (y, "amax"))
    columns = [x.new_zeros(count).scatter_reduce(0, region, line, how, include_self=False) for line, how in ends]
    return torch.stack(columns, dim=1)


def masked_crops(
    image: UInt8[Tensor, "h w 3"],
    labels: Int32[Tensor, "depth h w"],
    regions: Int64[Tensor, " b"],
    boxes: Int64[Tensor, "b 4"],
    size: tuple[int, int],
    fill: Fill,
) -> Float[Tensor, "b 3 size_y size_x"]:
    """Some regions, 0..255, as the top of this file describes it.

    Args:
        labels: a region is all pixels that have its id at any depth.
        boxes: of these regions, as `region_boxes` returns them.
        size: height and width of the result.
    """
    x0, y0, x1, y1 = boxes.T
    width, height = x1 - x0 + 1, y1 - y0 + 1
    side = torch.maximum(width, height)
    rows = _line(side, (side - height) // 2, height, y0, size[0])
    columns = _line(side, (side - width) // 2, width, x0, size[1])
    outside = 255.0 if fill == "white" else 0.0
    crops = torch.zeros(len(regions), *size, 3, device=image.device)
    for y, row_weight, row_inside in rows:
        for x, column_weight, column_inside in columns:
            at = y[:, :, None], x[:, None, :]
            mine = torch.zeros(len(regions), *size, dtype=torch.bool, device=image.device)
            for layer in labels:
                mine |= layer[at] == regions[:, None, None]
            pixels = torch.where(mine[:, :, :, None], image[at].float(), outside)
            weight = (row_weight * row_inside)[:, :, None] * (column_weight * column_inside)[:, None, :]
            crops += weight[:, :, :, None] * pixels
    return crops.permute(0, 3, 1, 2)


def _line(
    side: Tensor, margin: Tensor, length: Tensor, start: Tensor, size: int
) -> list[tuple[Tensor, Tensor, Tensor]]:
    """Where `size` samples of each square fall along one axis: the two pixels beside each, as position in the image,
    weight, and whether they lie in the box rather than in the margin.
    """
    centre = (torch.arange(size, device=side.device) + 0.5) * (side[:, None].double() / size) - 0.5
    centre = centre.clamp(min=0)
    low = centre.long()
    high = torch.minimum(low + 1, side[:, None] - 1)
    share = (centre - low).float()
    taps = []
    for position, weight in ((low, 1 - share), (high, share)):
        inside = position - margin[:, None]
        within = (inside >= 0) & (inside < length[:, None])
        taps.append((start[:, None] + torch.minimum(inside.clamp(min=0), length[:, None] - 1), weight, within))
    return taps
