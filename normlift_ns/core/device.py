"""Choice of the device, availability of the Triton kernels, batches that fit GPU memory, and a prefetching `map`."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from itertools import islice
from threading import Thread
from typing import Any, TypeVar, cast

import torch
from torch import Tensor

from normlift_ns.errors import InputError
from normlift_ns.options import check_device

MIN_TRITON_VERSION = 3
Items = TypeVar("Items", Sequence, Tensor)  # pyright: ignore[reportMissingTypeArgument]
Item = TypeVar("Item")
Result = TypeVar("Result")
Record = TypeVar("Record")


class TensorRecord:
    """Base of dataclasses whose fields are tensors, other such dataclasses, or values without a device."""

    def to(self: Record, device: torch.device | str) -> Record:
        """Return a copy on another device."""
        record = cast(Any, self)  # the subclasses are dataclasses
        values = {field.name: getattr(record, field.name) for field in fields(record)}
        return replace(record, **{name: x.to(device) for name, x in values.items() if hasattr(x, "to")})


@cache
def has_triton() -> bool:
    """Return whether Triton 3 or newer is installed, as with torch 2.4 and later on Linux.

    Without it, stock gsplat rasterizes on the GPU.
    """
    if find_spec("triton") is None:
        return False
    try:
        return int(version("triton").partition(".")[0]) >= MIN_TRITON_VERSION
    except (PackageNotFoundError, ValueError):  # from another distribution, whose version is not comparable
        return True


def can_use_triton(tensor: Tensor) -> bool:
    """Return whether the Triton kernels can process a tensor: it is on a GPU, and Triton is installed."""
    return tensor.is_cuda and has_triton()


def retry_in_halves(run: Callable[[Items], Result], items: Items, advice: str) -> list[Result]:
    """Run a function on all items; if the GPU runs out of memory, split them into halves recursively.

    Args:
        run: function of a part of the items.
        items: sequence, or tensor that is split along its first dimension.
        advice: remedy that the message of the MemoryError suggests.
    Returns:
        The results of all parts, in order.
    Raises:
        MemoryError: if a single item is too large.
    """
    try:
        return [run(items)]
    except torch.cuda.OutOfMemoryError as error:
        if len(items) <= 1:
            raise MemoryError(f"the GPU's memory is full ({error}); {advice}") from error
    torch.cuda.empty_cache()
    half = len(items) // 2
    return retry_in_halves(run, items[:half], advice) + retry_in_halves(run, items[half:], advice)


def init_cuda(device: str) -> None:
    """Initialize CUDA in the background, which takes a second.

    Errors are ignored here, because they recur and are reported when the GPU is used.
    """

    def start() -> None:
        with suppress(Exception):
            torch.empty(1, device=device)

    if device.startswith("cuda"):
        Thread(target=start, name="init-cuda", daemon=True).start()


def choose_device(device: str) -> str:
    """Return the device to use; "auto" is cuda if available, else cpu.

    Raises:
        ValueError: if the device is unknown or this machine does not have it.
    """
    device = check_device(device)
    if device.startswith("cuda"):
        count = torch.cuda.device_count()
        if count == 0:
            raise InputError(f"--device {device}: this machine has no CUDA device; use --device cpu")
        if int(device[5:] or 0) >= count:
            raise InputError(f"--device {device}: no such device; the last one is cuda:{count - 1}")
    if device != "auto":
        return device
    return "cuda" if torch.cuda.is_available() else "cpu"


# Batched computation that adapts to the available GPU memory, and prefetching `map`.


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


_ADVICE = (
    "close other programs that use the GPU, use a smaller model, downscale the images (--lift-downscale 2), or lift on "
    "the CPU: --device cpu"
)


@dataclass
class AdaptiveBatches:
    """Splits work into batches. If GPU memory cannot hold a batch, it is split, and all later batches are smaller."""

    batch_size: int
    """Number of items per batch."""

    def __call__(self, function: Callable[[Items], Result], items: Items) -> Iterator[Result]:
        """Yield the results of the function on consecutive batches of items.

        Raises:
            MemoryError: If not even one item fits.
        """
        start = 0
        while start < len(items):
            batch = items[start : start + self.batch_size]
            results = retry_in_halves(function, batch, _ADVICE)
            if len(results) > 1:
                self.batch_size = -(-len(batch) // len(results))
            start += len(batch)
            yield from results

    def map_across(
        self, function: Callable[[Sequence[Item]], Tensor], parts: Iterable[Sequence[Item]]
    ) -> Iterator[list[Tensor]]:
        """Yield the rows of each part, one per item; one batch may hold items of several parts.

        Every batch has the same shape: the last one is padded with copies of its last item. A row therefore depends on
        the rest of its batch by rounding only.

        A part is requested when the earlier parts leave room in a batch, and its rows are yielded as soon as they are
        computed.

        Raises:
            MemoryError: If not even one item fits.
        """
        counts, queue, rows = deque[int](), list[Item](), deque[Tensor]()
        for part in parts:
            counts.append(len(part))
            queue.extend(part)
            while len(queue) >= self.batch_size:
                batch, queue = queue[: self.batch_size], queue[self.batch_size :]
                rows.extend(row for result in self(function, batch) for row in result)
            while len(counts) > 0 and counts[0] <= len(rows):
                yield [rows.popleft() for _ in range(counts.popleft())]
        if len(queue) > 0:
            padded = [*queue, *[queue[-1]] * (self.batch_size - len(queue))]
            rows.extend([row for result in self(function, padded) for row in result][: len(queue)])
        for count in counts:
            yield [rows.popleft() for _ in range(count)]
