"""Batches that fit into memory."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TypeVar

from torch import Tensor

from normlift_ns.core.gpu import in_parts

T = TypeVar("T")
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

    def __call__(self, function: Callable[[Tensor], T], items: Tensor) -> Iterator[T]:
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
