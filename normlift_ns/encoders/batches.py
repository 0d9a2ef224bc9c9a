"""Batches that fit into memory."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TypeVar

import torch
from torch import Tensor

T = TypeVar("T")


@dataclass
class Batches:
    """Cuts work into batches. Where the memory of the device does not suffice, it goes on with half of the batch, for
    all that follows."""

    size: int
    """Items per batch."""
    what: str
    """What an item is called in a message, such as "crop"."""

    def __call__(self, function: Callable[[Tensor], T], items: Tensor) -> Iterator[T]:
        """The function's results on consecutive items.

        Raises:
            MemoryError: not even one item fits.
        """
        start = 0
        while start < len(items):
            batch = items[start : start + self.size]
            try:
                result = function(batch)
            except torch.OutOfMemoryError as error:
                if len(batch) == 1:
                    raise MemoryError(
                        f"the memory of the device does not hold a single {self.what} ({str(error).splitlines()[0]}); "
                        "close other programs that use it, take a smaller model, images of a fraction of the size "
                        "(--lift-downscale 2), or --device cpu"
                    ) from None
                self.size = len(batch) // 2
            else:
                start += len(batch)
                yield result
                continue
            torch.cuda.empty_cache()  # outside of the except block, whose traceback holds tensors
