"""Exchange between processes: evidence from view owners to Gaussian owners, and neighbors for the vote."""

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

_RENUMBER_BLOCK = 2**20
"""Number of rows of neighbors that are renumbered at a time."""


class Coordinates(NamedTuple):
    """Entries of a sparse matrix as coordinates, sorted by row; each takes 12 bytes, and empty rows take none."""

    row: Int32[Tensor, " nnz"]
    column: Int32[Tensor, " nnz"]
    weight: Float[Tensor, " nnz"]


@dataclass(frozen=True)
class Piece:
    """Evidence of a few views, split by the process that owns the Gaussians; rows are those of the owner's portion."""

    rows: list[Coordinates]
    """Labeled entries for every process."""
    unlabeled: list[Coordinates]
    """Unlabeled entries for every process."""
    facts: tuple[list[int], int, int, int]
    """Number of regions of every view, `weight_power`, `num_excluded`, and bytes per weight."""

    @staticmethod
    def of(evidence: Evidence, portion: Portion) -> Piece:
        """Split the evidence of all Gaussians by owner."""
        regions = torch.bincount(evidence.region_view, minlength=evidence.num_views).tolist()
        facts = (regions, evidence.weight_power, evidence.num_excluded, evidence.rows.weight.element_size())
        return Piece(_split_by_owner(evidence.rows, portion), _split_by_owner(evidence.unlabeled, portion), facts)


def _split_by_owner(rows: SparseRows, portion: Portion) -> list[Coordinates]:
    owner, row = portion.place
    gaussian = rows.row_index()
    owner_of, row_of, parts = owner[gaussian], row[gaussian], []
    for rank in range(portion.team.size):
        entries = (owner_of == rank).nonzero().squeeze(1)
        parts.append(Coordinates(row_of[entries], rows.column[entries], rows.weight[entries]))
    return parts


def share_evidence(pieces: Mapping[int, Piece], portion: Portion, chunks: int) -> Evidence:
    """Redistribute evidence: return that of all views for the Gaussians of this process.

    Args:
        pieces: evidence collected by this process, by chunk index; together, the processes have all chunks.
        chunks: number of chunks of all processes.
    """
    device, local_chunks = portion.order.device, sorted(pieces)
    matrices = ([pieces[chunk].rows for chunk in local_chunks], [pieces[chunk].unlabeled for chunk in local_chunks])
    counts = [[[len(parts[rank].row) for parts in matrix] for matrix in matrices] for rank in range(portion.team.size)]
    gathered = portion.team.tell_all([local_chunks, [pieces[chunk].facts for chunk in local_chunks], counts])
    metadata = {chunk: item for rank_chunks, items, _ in gathered for chunk, item in zip(rank_chunks, items)}
    regions = [count for chunk in range(chunks) for count in metadata[chunk][0]]
    widths = [(sum(metadata[chunk][0]), len(metadata[chunk][0])) for chunk in range(chunks)]  # columns of both matrices
    _, weight_power, num_excluded, weight_bytes = metadata[0]
    dtype = torch.float64 if weight_bytes == 8 else torch.float32
    chunks_by_rank = [rank_chunks for rank_chunks, _, _ in gathered]
    result = []
    for i, matrix in enumerate(matrices):
        first_column = [0, *accumulate(width[i] for width in widths)]
        received = [counts[portion.team.rank][i] for _, _, counts in gathered]
        result.append(_exchange_rows(matrix, chunks_by_rank, received, first_column, portion, dtype))
    region_view = torch.repeat_interleave(torch.arange(len(regions), dtype=torch.int32), torch.tensor(regions))
    return Evidence(result[0], region_view.to(device), result[1], len(regions), weight_power, num_excluded)


def _exchange_rows(
    entries: Sequence[Sequence[Coordinates]],
    chunks_by_rank: Sequence[Sequence[int]],
    counts: Sequence[Sequence[int]],
    first_column: Sequence[int],
    portion: Portion,
    dtype: torch.dtype,
) -> SparseRows:
    """Exchange the entries of a matrix, and return the rows of this process's Gaussians.

    Args:
        entries: entries of this process, by chunk and receiving process.
        chunks_by_rank: chunks of every process.
        counts: number of entries that every process sends to this one, by chunk.
        first_column: first column of every chunk in the whole matrix.
        dtype: type of the weights.
    """
    team, device = portion.team, portion.order.device
    empty = Coordinates(*(torch.zeros(0, dtype=x, device=device) for x in (torch.int32, torch.int32, dtype)))
    arrays = []
    for name in Coordinates._fields:
        sent = [[getattr(empty, name), *(getattr(chunk[rank], name) for chunk in entries)] for rank in range(team.size)]
        arrays.append(team.exchange([torch.cat(parts) for parts in sent]))
    received: dict[int, tuple[Tensor, Tensor, Tensor]] = {}
    for rank, chunks in enumerate(chunks_by_rank):
        parts = [array[rank].split(list(counts[rank])) for array in arrays]
        for chunk, row, column, weight in zip(chunks, *parts):
            received[chunk] = row.long(), column + first_column[chunk], weight
    return SparseRows.stack([received[chunk] for chunk in sorted(received)], len(portion), device)


class Around(NamedTuple):
    """Gaussians of a portion, followed by their neighbors in other processes."""

    lifted: Lifted
    """Directions of all these Gaussians; of the scalars, only the norm is valid."""
    neighbors: Neighbors
    """Neighbors of the portion's Gaussians, as rows of this object."""
    gaussians: Int64[Tensor, " all"]
    """Index of each of these Gaussians in the scene."""


def with_neighbors(lifted: Lifted, neighbors: Neighbors, portion: Portion) -> Around:
    """Gather the directions and neighbors that a vote of the portion's Gaussians reads.

    Args:
        lifted: lift of the portion.
        neighbors: neighbors of the portion's Gaussians, as indices in the scene.
    """
    team, local, device = portion.team, portion.gaussians, portion.order.device
    _, row = portion.place
    wanted = torch.zeros(len(portion.order) + 1, dtype=torch.bool, device=device)  # the last element is for -1
    for index in neighbors.index.split(_RENUMBER_BLOCK):
        wanted[index.long()] = True
    wanted[local] = False
    halo = [gaussians[wanted[gaussians]] for gaussians in portion.by_owner]
    requested = team.exchange([row[gaussians] for gaussians in halo])
    evidence, norm = lifted.evidence, lifted.scalars.norm
    sent = [evidence.rows.select_rows(rows.long()) for rows in requested]
    lengths, column, weight, halo_norm = (
        torch.cat(team.exchange(parts))
        for parts in (
            [x.offsets.diff() for x in sent],
            [x.column for x in sent],
            [x.weight for x in sent],
            [norm[rows.long()] for rows in requested],
        )
    )
    lengths = torch.cat([evidence.rows.offsets.diff(), lengths])
    offsets = torch.cat([lengths.new_zeros(1), lengths.cumsum(0)])
    rows = SparseRows(offsets, torch.cat([evidence.rows.column, column]), torch.cat([evidence.rows.weight, weight]))
    blank = SparseRows(torch.zeros_like(offsets), evidence.unlabeled.column[:0], evidence.unlabeled.weight[:0])
    scalars = lifted.scalars.map(lambda x: torch.cat([x, x.new_zeros(len(halo_norm))]))
    scalars = replace(scalars, norm=torch.cat([norm, halo_norm]))
    extended = Lifted(scalars, replace(evidence, rows=rows, unlabeled=blank), lifted.features)
    gaussians = torch.cat([local, *halo])
    row_of = torch.full((len(portion.order) + 1,), -1, dtype=torch.int32, device=device)
    row_of[gaussians] = torch.arange(len(gaussians), dtype=torch.int32, device=device)
    index = torch.cat([row_of[block.long()] for block in neighbors.index.split(_RENUMBER_BLOCK)])
    return Around(extended, neighbors._replace(index=index), gaussians)
