"""Batches that fit into memory."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TypeVar

from torch import Tensor

from normlift_ns.core.gpu import Items, in_parts

T = TypeVar("T")
Item = TypeVar("Item")
_ADVICE = (
    "close other programs that use the GPU, take a smaller model, or images of a fraction of the size "
    "(--lift-downscale 2), or lift on the CPU: --device cpu"
)


@dataclass
class Batches:
    """Cuts work into batches. Where a GPU's memory does not hold one, it goes on with smaller ones, for all that
    follows."""

    size: int
    """Items per batch."""

    def __call__(self, function: Callable[[Items], T], items: Items) -> Iterator[T]:
        """The function's results on consecutive items.

        Raises:
            MemoryError: not even one item fits.
        """
        start = 0
        while start < len(items):
            batch = items[start : start + self.size]
            results = in_parts(function, batch, _ADVICE)
            if len(results) > 1:
                self.size = -(-len(batch) // len(results))
            start += len(batch)
            yield from results

    def across(
        self, function: Callable[[Sequence[Item]], Tensor], parts: Iterable[Sequence[Item]]
    ) -> Iterator[list[Tensor]]:
        """The function's rows, one per item, of each part, where one batch may hold items of several parts.

        The last batch is filled up with its last item, so that all have the same shape and a row does not depend on
        what else is asked for: its rounding may.

        A part is asked for when those before it leave room in a batch; its rows are given as soon as they are known.

        Raises:
            MemoryError: not even one item fits.
        """
        counts, waiting, rows = deque[int](), list[Item](), deque[Tensor]()
        for part in parts:
            counts.append(len(part))
            waiting.extend(part)
            while len(waiting) >= self.size:
                batch, waiting = waiting[: self.size], waiting[self.size :]
                rows.extend(row for result in self(function, batch) for row in result)
            while len(counts) > 0 and counts[0] <= len(rows):
                yield [rows.popleft() for _ in range(counts.popleft())]
        if len(waiting) > 0:
            filled = [*waiting, *[waiting[-1]] * (self.size - len(waiting))]
            rows.extend([row for result in self(function, filled) for row in result][: len(waiting)])
        for count in counts:
            yield [rows.popleft() for _ in range(count)]
