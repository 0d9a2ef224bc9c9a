"""Prefetching `map`, and batches that adapt to the available GPU memory."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from itertools import islice
from typing import TypeVar

from torch import Tensor

from normlift_ns.core.device import Items, retry_in_halves

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")


def prefetch_map(function: Callable[[_Item], _Result], items: Iterable[_Item], threads: int) -> Iterator[_Result]:
    """Yield `map(function, items)`, and compute up to `threads` of the next results while the caller uses one.

    Items are requested in the caller's thread. An exception of the items or the function is raised when its turn comes.
    With one thread, nothing is prefetched.

    >>> list(prefetch_map(abs, [-1, 2, -3], 2))
    [1, 2, 3]
    """
    if threads == 1:
        yield from map(function, items)
        return
    iterator, pending = iter(items), deque[Future[_Result]]()

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
    """Items per batch."""

    def __call__(self, function: Callable[[Items], _Result], items: Items) -> Iterator[_Result]:
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
        self, function: Callable[[Sequence[_Item]], Tensor], parts: Iterable[Sequence[_Item]]
    ) -> Iterator[list[Tensor]]:
        """Yield the rows of each part, one per item; one batch may hold items of several parts.

        Every batch has the same shape: the last one is padded with copies of its last item. A row therefore depends on
        the rest of its batch by rounding only.

        A part is requested when the earlier parts leave room in a batch, and its rows are yielded as soon as they are
        computed.

        Raises:
            MemoryError: If not even one item fits.
        """
        counts, queue, rows = deque[int](), list[_Item](), deque[Tensor]()
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
