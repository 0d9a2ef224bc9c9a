"""Evidence changes hands: from whoever rasterized a view to whoever lifts a Gaussian; and what Gaussians of others
are needed for the vote.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate
from typing import NamedTuple

import torch
from jaxtyping import Float, Int32, Int64
from torch import Tensor

from normlift_ns.core.evidence import Evidence
from normlift_ns.core.lift import Lifted
from normlift_ns.core.neighbors import Neighbors
from normlift_ns.core.portions import Portion
from normlift_ns.core.sparse import SparseRows

_BLOCK = 2**20
"""Rows of neighbours that are renumbered at a time."""


class Coordinates(NamedTuple):
    """Entries of a sparse matrix, sorted by row: 12 bytes each, and nothing for a row without any."""

    row: Int32[Tensor, " nnz"]
    column: Int32[Tensor, " nnz"]
    weight: Float[Tensor, " nnz"]


@dataclass(frozen=True)
class Piece:
    """The evidence of a few views, sorted out by whose Gaussians it is of; rows are those of their portions."""

    rows: list[Coordinates]
    """For every process."""
    unlabeled: list[Coordinates]
    facts: tuple[list[int], int, int, int]
    """Number of regions of every view, `weight_power`, `num_excluded`, and bytes of a weight."""

    @staticmethod
    def of(evidence: Evidence, portion: Portion) -> Piece:
        """The evidence of all Gaussians."""
        regions = torch.bincount(evidence.region_view, minlength=evidence.num_views).tolist()
        facts = (regions, evidence.weight_power, evidence.num_excluded, evidence.rows.weight.element_size())
        return Piece(_sorted_out(evidence.rows, portion), _sorted_out(evidence.unlabeled, portion), facts)


def _sorted_out(rows: SparseRows, portion: Portion) -> list[Coordinates]:
    owner, row = portion.place
    gaussian = rows.row_index()
    owner_of, row_of, found = owner[gaussian], row[gaussian], []
    for rank in range(portion.team.size):
        entries = (owner_of == rank).nonzero().squeeze(1)
        found.append(Coordinates(row_of[entries], rows.column[entries], rows.weight[entries]))
    return found


def share_evidence(pieces: Mapping[int, Piece], portion: Portion, chunks: int) -> Evidence:
    """The evidence of all views for the Gaussians of a portion.

    Args:
        pieces: those of this process, by the numbers of their chunks; the pieces of all processes are all chunks.
        chunks: how many there are.
    """
    device, mine = portion.order.device, sorted(pieces)
    kinds = ([pieces[number].rows for number in mine], [pieces[number].unlabeled for number in mine])
    counts = [[[len(entries[rank].row) for entries in kind] for kind in kinds] for rank in range(portion.team.size)]
    said = portion.team.tell_all([mine, [pieces[number].facts for number in mine], counts])
    facts = {number: fact for numbers, all_facts, _ in said for number, fact in zip(numbers, all_facts)}
    regions = [count for number in range(chunks) for count in facts[number][0]]
    width = [(sum(facts[number][0]), len(facts[number][0])) for number in range(chunks)]  # columns of both kinds
    _, weight_power, num_excluded, weight_bytes = facts[0]
    kind_of_weight = torch.float64 if weight_bytes == 8 else torch.float32
    owners = [numbers for numbers, _, _ in said]
    found = []
    for i, kind in enumerate(kinds):
        first = [0, *accumulate(columns[i] for columns in width)]
        theirs = [counts[portion.team.rank][i] for _, _, counts in said]
        found.append(_exchange(kind, owners, theirs, first, portion, kind_of_weight))
    region_view = torch.repeat_interleave(torch.arange(len(regions), dtype=torch.int32), torch.tensor(regions))
    return Evidence(found[0], region_view.to(device), found[1], len(regions), weight_power, num_excluded)


def _exchange(
    mine: Sequence[Sequence[Coordinates]],
    owners: Sequence[Sequence[int]],
    counts: Sequence[Sequence[int]],
    first_column: Sequence[int],
    portion: Portion,
    kind_of_weight: torch.dtype,
) -> SparseRows:
    """The rows of this process's Gaussians.

    Args:
        mine: entries by chunk and process.
        owners: the chunks of every process.
        counts: of the entries that every process has for this one, by chunk.
        first_column: of every chunk, among all.
    """
    team, device = portion.team, portion.order.device
    empty = Coordinates(*(torch.zeros(0, dtype=x, device=device) for x in (torch.int32, torch.int32, kind_of_weight)))
    arrays = []
    for name in Coordinates._fields:
        chosen = [[getattr(empty, name), *(getattr(chunk[rank], name) for chunk in mine)] for rank in range(team.size)]
        arrays.append(team.exchange([torch.cat(parts) for parts in chosen]))
    found: dict[int, tuple[Tensor, Tensor, Tensor]] = {}
    for rank, numbers in enumerate(owners):
        pieces = [array[rank].split(list(counts[rank])) for array in arrays]
        for number, row, column, weight in zip(numbers, *pieces):
            found[number] = row.long(), column + first_column[number], weight
    lists = [found[number] for number in sorted(found)]
    return SparseRows.stack(lists, len(portion), device)


class Around(NamedTuple):
    """The Gaussians of a portion, and behind them those of others that are among their neighbours."""

    lifted: Lifted
    """Directions of all of them; no other numbers than the norm hold."""
    neighbors: Neighbors
    """Of those of the portion, by their places here."""
    gaussians: Int64[Tensor, " all"]
    """The number of each."""


def with_neighbors(lifted: Lifted, neighbors: Neighbors, portion: Portion) -> Around:
    """What a vote of the portion's Gaussians reads.

    Args:
        lifted: of the portion.
        neighbors: of the portion's Gaussians, by their numbers.
    """
    team, mine, device = portion.team, portion.gaussians, portion.order.device
    _, row = portion.place
    wanted = torch.zeros(len(portion.order) + 1, dtype=torch.bool, device=device)  # the last for -1
    for index in neighbors.index.split(_BLOCK):
        wanted[index.long()] = True
    wanted[mine] = False
    halo = [gaussians[wanted[gaussians]] for gaussians in portion.by_owner]
    asked = team.exchange([row[gaussians] for gaussians in halo])
    evidence, norm = lifted.evidence, lifted.scalars.norm
    given = [evidence.rows.select_rows(rows.long()) for rows in asked]
    lengths, column, weight, length_of_f = (
        torch.cat(team.exchange(parts))
        for parts in (
            [x.offsets.diff() for x in given],
            [x.column for x in given],
            [x.weight for x in given],
            [norm[rows.long()] for rows in asked],
        )
    )
    lengths = torch.cat([evidence.rows.offsets.diff(), lengths])
    offsets = torch.cat([lengths.new_zeros(1), lengths.cumsum(0)])
    rows = SparseRows(offsets, torch.cat([evidence.rows.column, column]), torch.cat([evidence.rows.weight, weight]))
    blank = SparseRows(torch.zeros_like(offsets), evidence.unlabeled.column[:0], evidence.unlabeled.weight[:0])
    scalars = lifted.scalars.map(lambda x: torch.cat([x, x.new_zeros(len(length_of_f))]))
    scalars = replace(scalars, norm=torch.cat([norm, length_of_f]))
    around = Lifted(scalars, replace(evidence, rows=rows, unlabeled=blank), lifted.features)
    gaussians = torch.cat([mine, *halo])
    here = torch.full((len(portion.order) + 1,), -1, dtype=torch.int32, device=device)
    here[gaussians] = torch.arange(len(gaussians), dtype=torch.int32, device=device)
    index = torch.cat([here[some.long()] for some in neighbors.index.split(_BLOCK)])
    return Around(around, neighbors._replace(index=index), gaussians)
