"""Partition of the Gaussians among processes that lift one scene, and the interface for their communication."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import torch
from jaxtyping import Float, Int32, Int64
from torch import Tensor

PARTITION_BLOCK = 2**13
"""Number of consecutive Gaussians on the Morton curve that form a block. Each process has whole blocks, so that matrix
products have the same shapes, and therefore the same rounding, for any number of processes."""


class Communicator(ABC):
    """Interface for communication between processes. All processes must call the same methods in the same order."""

    rank: int
    """Rank of this process, in 0..world_size - 1."""
    world_size: int
    """Number of processes."""

    @abstractmethod
    def all_gather(self, rows: Tensor) -> Tensor:
        """Return the concatenated rows of all processes, in every process."""

    def gather(self, rows: Tensor) -> list[Tensor] | None:
        """Return the rows of every process in process 0, and None in the others."""
        parts = self.all_to_all([rows if r == 0 else rows[:0] for r in range(self.world_size)])
        return parts if self.rank == 0 else None

    @abstractmethod
    def all_to_all(self, parts: Sequence[Tensor]) -> list[Tensor]:
        """Send parts[r] to process r, and return the parts that all processes sent to this one."""

    @abstractmethod
    def all_reduce(self, values: Tensor) -> Tensor:
        """Return the elementwise sum over all processes, in every process."""

    @abstractmethod
    def broadcast(self, values: Tensor) -> Tensor:
        """Return the values of process 0 in every process. Other processes pass arrays of the same shape and type."""

    def broadcast_object(self, value: Any) -> Any:
        """Return the JSON-ready object of process 0 in every process."""
        return self.all_gather_object(value if self.rank == 0 else None)[0]

    @abstractmethod
    def all_gather_object(self, value: Any) -> list[Any]:
        """Return the JSON-ready objects of all processes in every process."""


@dataclass(frozen=True)
class Partition:
    """Partition of the Gaussians among processes, by segments of a space-filling curve.

    Neighbors in space are mostly in the same process. The arrays of a process have one row for each of its Gaussians,
    in index order.
    """

    communicator: Communicator
    order: Int64[Tensor, " n"]
    """Indices of all Gaussians in the order of the Morton curve (see `spatial_order`)."""

    @staticmethod
    def from_means(team: Communicator, means: Float[Tensor, "n 3"]) -> Partition:
        """Partition the Gaussians by their means among the processes of `team`."""
        return Partition(team, spatial_order(means))

    def __len__(self) -> int:
        return len(self.indices)

    @cached_property
    def indices_by_rank(self) -> list[Int64[Tensor, " m"]]:
        """Ascending indices of the Gaussians of every process. Each process has whole blocks of the curve."""
        n, size = len(self.order), self.communicator.world_size
        blocks = -(-n // PARTITION_BLOCK)
        bounds = [min(n, blocks * rank // size * PARTITION_BLOCK) for rank in range(size + 1)]
        return [self.order[first:last].sort().values for first, last in pairwise(bounds)]

    @property
    def indices(self) -> Int64[Tensor, " m"]:
        """Ascending indices of the Gaussians of this process."""
        return self.indices_by_rank[self.communicator.rank]

    @cached_property
    def place(self) -> tuple[Int32[Tensor, " n"], Int32[Tensor, " n"]]:
        """Rank of the process that owns each Gaussian, and row of the Gaussian in the arrays of that process."""
        owner, row = (torch.empty_like(self.order, dtype=torch.int32) for _ in range(2))
        for rank, gaussians in enumerate(self.indices_by_rank):
            owner[gaussians] = rank
            row[gaussians] = torch.arange(len(gaussians), dtype=torch.int32, device=self.order.device)
        return owner, row

    @cached_property
    def curve_rows(self) -> Int64[Tensor, " m"]:
        """Row indices of the arrays of this process, in the order of the Morton curve."""
        first = sum(map(len, self.indices_by_rank[: self.communicator.rank]))
        return self.place[1][self.order[first : first + len(self)]].long()

    def blocks(self) -> Iterator[Int64[Tensor, " b"]]:
        """Yield the row indices of `curve_rows`, one block at a time."""
        return iter(self.curve_rows.split(PARTITION_BLOCK))

    def all_gather(self, rows: Tensor) -> Tensor:
        """Return the rows of all Gaussians in index order, in every process."""
        joined = self.communicator.all_gather(rows)
        return torch.empty_like(joined).index_copy_(0, torch.cat(self.indices_by_rank), joined)


def spatial_order(means: Float[Tensor, "n 3"]) -> Int64[Tensor, " n"]:
    """Return the indices of all Gaussians along a Morton curve, which keeps neighbors in space close to each other.

    The curve has 1,024 cells per axis, from the 1st to the 99th percentile of the means; means outside this range are
    clamped to it. If the curve covered all means, distant outliers could put all other Gaussians into one cell.

    >>> spatial_order(torch.tensor([[3.0, 0, 0], [0.0, 0, 0], [2.0, 0, 0]])).tolist()
    [1, 2, 0]
    """
    sample = means[:: max(1, len(means) // 100_000)]
    sample = sample[sample.isfinite().all(dim=1)].double()
    if len(sample) == 0:
        return torch.arange(len(means), device=means.device)
    low, high = sample.quantile(sample.new_tensor([0.01, 0.99]), dim=0)
    cell = ((means - low) / (high - low).clamp(min=1e-12) * 1023).nan_to_num(0).clamp(0, 1023).long()
    for shift, mask in ((16, 0x030000FF), (8, 0x0300F00F), (4, 0x030C30C3), (2, 0x09249249)):
        cell = (cell | (cell << shift)) & mask
    return (cell[:, 0] | cell[:, 1] << 1 | cell[:, 2] << 2).int().argsort(stable=True)
