"""Which Gaussians are whose, where several processes lift one scene together; and what such processes can ask of each
other.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float, Int32, Int64
from torch import Tensor

from normlift_ns.core.sparse import SparseRows

Report = Callable[[str, int, int], None]
"""Called with (stage, steps done, steps in all)."""
PER_VIEW = ("features", "evidence")
"""Stages of a lift whose steps are views."""
GRAIN = 2**13
"""Gaussians, neighbours on the curve, that are worked on together. Portions are whole numbers of them, so that every
product has the same shape however many processes there are: its rounding may depend on that."""


class Team:
    """A process that lifts alone; `normlift_ns.team` has those of several. All of a team call the same methods in the
    same order."""

    rank: int = 0
    """Number of this process, in 0..size-1."""
    size: int = 1
    """How many there are."""

    def join(self, rows: Tensor) -> Tensor:
        """The rows of all processes, one behind the other, at every process."""
        return rows

    def deliver(self, rows: Tensor) -> list[Tensor] | None:
        """The rows of every process, at process 0 alone."""
        return [rows]

    def exchange(self, parts: Sequence[Tensor]) -> list[Tensor]:
        """Gives parts[r] to process r; what every process has given to this one."""
        return list(parts)

    def add(self, values: Tensor) -> Tensor:
        """The sum over all processes, at every process."""
        return values

    def spread(self, values: Tensor) -> Tensor:
        """The numbers that process 0 has, at every process; the others give arrays of that shape and type."""
        return values

    def tell(self, facts: Any) -> Any:
        """What process 0 says, ready for JSON, at every process."""
        return facts

    def tell_all(self, facts: Any) -> list[Any]:
        """What every process says, ready for JSON, at every process."""
        return [facts]

    def counted(self, report: Report) -> Report:
        """What tells how far the whole team is in stages that count views, and process 0 in all others."""
        return report

    @contextmanager
    def shares(self, folder: Path) -> Iterator[None]:
        """While it lasts, `chunks` can be asked for.

        Args:
            folder: which all processes share.
        """
        yield

    def chunks(self, count: int) -> Iterator[int]:
        """The pieces of work, of so many, that are for this process: every one is for one process alone."""
        return iter(range(count))


ALONE = Team()


@dataclass(frozen=True)
class Portion:
    """The Gaussians of one process: a piece of a curve through space, so that most neighbours are of the same process.
    Arrays of a portion have one row for each of them, in the order of their numbers.

    >>> import torch
    >>> means = torch.tensor([[3.0, 0, 0], [0.0, 0, 0], [2.0, 0, 0]])
    >>> portion = Portion.of(ALONE, means)
    >>> portion.gaussians.tolist(), portion.along.tolist()
    ([0, 1, 2], [1, 2, 0])
    """

    team: Team
    order: Int64[Tensor, " n"]
    """All Gaussians along the curve."""

    @staticmethod
    def of(team: Team, means: Float[Tensor, "n 3"]) -> Portion:
        """The portion of this process."""
        return Portion(team, spatial_order(means))

    def __len__(self) -> int:
        return len(self.gaussians)

    @cached_property
    def by_owner(self) -> list[Int64[Tensor, " m"]]:
        """The Gaussians of every process, by their numbers: whole grains of the curve."""
        n, size = len(self.order), self.team.size
        grains = -(-n // GRAIN)
        bounds = [min(n, grains * rank // size * GRAIN) for rank in range(size + 1)]
        if size == 1:
            return [torch.arange(n, device=self.order.device)]
        return [self.order[first:last].sort().values for first, last in pairwise(bounds)]

    @property
    def gaussians(self) -> Int64[Tensor, " m"]:
        """Those of this process, by their numbers."""
        return self.by_owner[self.team.rank]

    @cached_property
    def place(self) -> tuple[Int32[Tensor, " n"], Int32[Tensor, " n"]]:
        """Of every Gaussian, whose it is and which row it is there."""
        owner, row = (torch.empty_like(self.order, dtype=torch.int32) for _ in range(2))
        for rank, gaussians in enumerate(self.by_owner):
            owner[gaussians] = rank
            row[gaussians] = torch.arange(len(gaussians), dtype=torch.int32, device=self.order.device)
        return owner, row

    @cached_property
    def along(self) -> Int64[Tensor, " m"]:
        """The rows of the portion along the curve."""
        if self.team.size == 1:
            return self.order
        first = sum(map(len, self.by_owner[: self.team.rank]))
        return self.place[1][self.order[first : first + len(self)]].long()

    def blocks(self) -> Iterator[Int64[Tensor, " b"]]:
        """Rows of the portion, a grain at a time along the curve."""
        return iter(self.along.split(GRAIN))

    def join(self, rows: Tensor) -> Tensor:
        """Arrays of all portions as one, in the order of the Gaussians' numbers, at every process."""
        if self.team.size == 1:
            return rows
        joined = self.team.join(rows)
        return torch.empty_like(joined).index_copy_(0, torch.cat(self.by_owner), joined)

    def deliver_sparse(self, rows: SparseRows) -> SparseRows | None:
        """`join`, of a sparse matrix with one row per Gaussian, at process 0 alone."""
        if self.team.size == 1:
            return rows
        parts = [self.team.deliver(x) for x in (rows.offsets.diff(), rows.column, rows.weight)]
        if any(part is None for part in parts):
            return None
        lengths, column, weight = (torch.cat(part) for part in parts if part is not None)
        joined = SparseRows(torch.cat([lengths.new_zeros(1), lengths.cumsum(0)]), column, weight)
        count = torch.arange(len(self.order), device=self.order.device)
        return joined.select_rows(torch.empty_like(self.order).index_copy_(0, torch.cat(self.by_owner), count))


def join_sparse(team: Team, rows: SparseRows) -> SparseRows:
    """The rows of all processes, one behind the other, at every process."""
    lengths = team.join(rows.offsets.diff())
    offsets = torch.cat([lengths.new_zeros(1), lengths.cumsum(0)])
    return SparseRows(offsets, team.join(rows.column), team.join(rows.weight))


def spatial_order(means: Float[Tensor, "n 3"]) -> Int64[Tensor, " n"]:
    """All Gaussians along a Morton curve of 1,024 steps a side: neighbours in space come near each other.

    A scene's far outliers would leave the rest in one cell, so that sides end at the 1st and 99th percentile.
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
