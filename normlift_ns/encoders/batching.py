"""Batches that fit into memory, prefetching, and masked crops of regions."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from itertools import groupby, islice
from operator import itemgetter
from typing import NamedTuple, TypeVar

import torch
from jaxtyping import Float, Float32, Int32, Int64, UInt8
from torch import Tensor

from normlift_ns.core.device import Items, retry_in_halves
from normlift_ns.options import CropFill

Item = TypeVar("Item")
Result = TypeVar("Result")


def prefetch_map(function: Callable[[Item], Result], items: Iterable[Item], threads: int) -> Iterator[Result]:
    """Yield `map(function, items)`, and compute up to `threads` of the next results while the caller uses one.

    Items are requested in the caller's thread. An exception of the items or the function is raised when its turn comes.
    With one thread, nothing is prefetched.

    >>> list(prefetch_map(abs, [-1, 2, -3], 2))
    [1, 2, 3]
    """
    if threads == 1:
        yield from map(function, items)
        return
    iterator, pending = iter(items), deque[Future[Result]]()

    def submit(count: int) -> None:
        try:
            pending.extend(pool.submit(function, item) for item in islice(iterator, count))
        except Exception as error:  # raised by the items
            pending.append(Future())
            pending[-1].set_exception(error)

    with ThreadPoolExecutor(threads) as pool:
        try:
            submit(threads)
            while len(pending) > 0:
                result = pending.popleft().result()
                submit(1)
                yield result
        finally:
            pool.shutdown(cancel_futures=True)


# Batched computation that adapts to the available GPU memory.


T = TypeVar("T")
Element = TypeVar("Element")
_ADVICE = (
    "close other programs that use the GPU, use a smaller model, downscale the images (--lift-downscale 2), or lift on "
    "the CPU: --device cpu"
)


@dataclass
class AdaptiveBatches:
    """Splits work into batches. If GPU memory cannot hold a batch, it is split, and all later batches are smaller."""

    size: int
    """Items per batch."""

    def __call__(self, function: Callable[[Items], T], items: Items) -> Iterator[T]:
        """Yield the results of the function on consecutive batches of items.

        Raises:
            MemoryError: If not even one item fits.
        """
        start = 0
        while start < len(items):
            batch = items[start : start + self.size]
            results = retry_in_halves(function, batch, _ADVICE)
            if len(results) > 1:
                self.size = -(-len(batch) // len(results))
            start += len(batch)
            yield from results

    def across(
        self, function: Callable[[Sequence[Element]], Tensor], parts: Iterable[Sequence[Element]]
    ) -> Iterator[list[Tensor]]:
        """Yield the rows of each part, one per item; one batch may hold items of several parts.

        Every batch has the same shape: the last one is padded with copies of its last item. A row therefore depends on
        the rest of its batch by rounding only.

        A part is requested when the earlier parts leave room in a batch, and its rows are yielded as soon as they are
        computed.

        Raises:
            MemoryError: If not even one item fits.
        """
        counts, queue, rows = deque[int](), list[Element](), deque[Tensor]()
        for part in parts:
            counts.append(len(part))
            queue.extend(part)
            while len(queue) >= self.size:
                batch, queue = queue[: self.size], queue[self.size :]
                rows.extend(row for result in self(function, batch) for row in result)
            while len(counts) > 0 and counts[0] <= len(rows):
                yield [rows.popleft() for _ in range(counts.popleft())]
        if len(queue) > 0:
            padded = [*queue, *[queue[-1]] * (self.size - len(queue))]
            rows.extend([row for result in self(function, padded) for row in result][: len(queue)])
        for count in counts:
            yield [rows.popleft() for _ in range(count)]


# Masked square crops of regions, as in LangSplat.
#
# For every region, pixels outside of it are filled, and the image is cropped to its bounding box. The crop is padded
# with black to a centered square and resized bilinearly. LangSplat fills with black; LaGa and SFS fill with white
# (and also pad with black). LangSplat's boxes, which come from SAM, omit the last row and column of a mask; the boxes
# here include them.


class CropNetwork(NamedTuple):
    """The parts of a network that encode crops. Its functions are called only if there are crops to encode."""

    size: Callable[[], tuple[int, int]]
    """Returns height and width of the crops that the network takes."""
    rows: Callable[[Float[Tensor, "b 3 y x"]], Float32[Tensor, "b d"]]
    """Maps crops, 0..255, on the device, to unit rows on the CPU."""
    width: Callable[[], int]
    """Returns the embedding dimension D."""


def encode_crops(
    views: Iterable[tuple[UInt8[Tensor, "h w 3"], Int32[Tensor, "depth h w"]]],
    network: CropNetwork,
    batches: AdaptiveBatches,
    fill: CropFill,
    device: str,
) -> Iterator[Float32[Tensor, "r d"]]:
    """Yield one unit row per region of every view, like `Encoder.encode_each`; crops of several views share batches.

    Raises:
        MemoryError: If not even one crop fits into the memory of the device.
    """
    pending: dict[int, _PendingView] = {}

    def crop_ids() -> Iterator[list[tuple[int, int]]]:
        for number, (image, labels) in enumerate(views):
            device_labels = labels.to(device)
            pending[number] = _PendingView(image.to(device), device_labels, region_boxes(device_labels))
            yield [(number, region) for region in range(len(pending[number].boxes))]

    def encode(batch: Sequence[tuple[int, int]]) -> Tensor:
        crops = []
        for number, crops_of_view in groupby(batch, itemgetter(0)):
            image, labels, boxes = pending[number]
            regions = torch.tensor([region for _, region in crops_of_view], device=device)
            crops.append(masked_crops(image, labels, regions, boxes[regions], network.size(), fill))
        return network.rows(torch.cat(crops))

    for number, rows in enumerate(batches.across(encode, crop_ids())):
        del pending[number]
        yield torch.stack(rows) if len(rows) > 0 else torch.empty(0, network.width())


class _PendingView(NamedTuple):
    """A view, on the device, with regions that wait for a batch."""

    image: UInt8[Tensor, "h w 3"]
    labels: Int32[Tensor, "depth h w"]
    boxes: Int64[Tensor, "r 4"]


def region_boxes(labels: Int32[Tensor, "depth h w"]) -> Int64[Tensor, "r 4"]:
    """Return the first and last column and row of each region as inclusive boxes (x0, y0, x1, y1)."""
    depth, y, x = (labels >= 0).nonzero(as_tuple=True)
    region = labels[depth, y, x].long()
    count = int(region.max()) + 1 if len(region) > 0 else 0
    ends = ((x, "amin"), (y, "amin"), (x, "amax"), (y, "amax"))
    columns = [x.new_zeros(count).scatter_reduce(0, region, at, reduce, include_self=False) for at, reduce in ends]
    return torch.stack(columns, dim=1)


def masked_crops(
    image: UInt8[Tensor, "h w 3"],
    labels: Int32[Tensor, "depth h w"],
    regions: Int64[Tensor, " b"],
    boxes: Int64[Tensor, "b 4"],
    size: tuple[int, int],
    fill: CropFill,
) -> Float[Tensor, "b 3 size_y size_x"]:
    """Return masked crops of regions, 0..255; see the module docstring.

    Args:
        labels: A region consists of all pixels that have its id at any depth.
        boxes: Boxes of these regions from `region_boxes`.
        size: Height and width of the result.
    """
    x0, y0, x1, y1 = boxes.T
    width, height = x1 - x0 + 1, y1 - y0 + 1
    side = torch.maximum(width, height)
    rows = _bilinear_samples(side, (side - height) // 2, height, y0, size[0])
    columns = _bilinear_samples(side, (side - width) // 2, width, x0, size[1])
    outside = 255.0 if fill == "white" else 0.0
    crops = torch.zeros(len(regions), *size, 3, device=image.device)
    for y, row_weight, row_inside in rows:
        for x, column_weight, column_inside in columns:
            at = y[:, :, None], x[:, None, :]
            inside = torch.zeros(len(regions), *size, dtype=torch.bool, device=image.device)
            for layer in labels:
                inside |= layer[at] == regions[:, None, None]
            pixels = torch.where(inside[:, :, :, None], image[at].float(), outside)
            weight = (row_weight * row_inside)[:, :, None] * (column_weight * column_inside)[:, None, :]
            crops += weight[:, :, :, None] * pixels
    return crops.permute(0, 3, 1, 2)


def _bilinear_samples(
    side: Tensor, margin: Tensor, length: Tensor, start: Tensor, size: int
) -> list[tuple[Tensor, Tensor, Tensor]]:
    """Return the bilinear samples of each square along one axis.

    The result has one entry for each of the two pixels next to a sample. It holds the position in the image, the
    weight, and whether the pixel is in the box rather than in the margin.
    """
    center = (torch.arange(size, device=side.device) + 0.5) * (side[:, None].double() / size) - 0.5
    center = center.clamp(min=0)
    low = center.long()
    high = torch.minimum(low + 1, side[:, None] - 1)
    fraction = (center - low).float()
    samples = []
    for position, weight in ((low, 1 - fraction), (high, fraction)):
        inside = position - margin[:, None]
        within = (inside >= 0) & (inside < length[:, None])
        samples.append((start[:, None] + torch.minimum(inside.clamp(min=0), length[:, None] - 1), weight, within))
    return samples
