"""Communication between processes, and redistribution of evidence among them."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import accumulate, chain
from math import prod
from pathlib import Path
from typing import Any, NamedTuple
from uuid import uuid4

import torch
import torch.distributed as dist
from jaxtyping import Float, Int32, Int64
from torch import Tensor

from normlift_ns.core.evidence import Evidence
from normlift_ns.core.lift import Lifted
from normlift_ns.core.neighbors import Neighbors
from normlift_ns.core.partition import Communicator, Partition
from normlift_ns.core.sparse import SparseRows
from normlift_ns.errors import InputError
from normlift_ns.io.file_lock import try_claim
from normlift_ns.progress import ProgressCallback

VIEW_STAGES = ("features", "evidence")
"""Names of the stages of a lift whose progress is counted in views."""
_STALE_SECONDS = 7 * 86400
"""Age in seconds after which a shared directory of killed processes is deleted."""


@dataclass(kw_only=True)
class TorchCommunicator(Communicator):
    """A communicator that uses torch.distributed.

    Arrays can have any type and device. Results are on the device of the arguments.
    """

    rank: int
    world_size: int
    device: torch.device
    """Device on which arrays are exchanged."""
    store: Any
    """Shared store for progress counters."""
    _folder: Path = field(default_factory=Path)
    """Directory that all processes share, and in which they claim chunks."""
    _num_divisions: int = 0
    """Number of previous calls of `claim_chunks`."""

    def all_gather(self, rows: Tensor) -> Tensor:
        """Implement `Communicator.all_gather`."""
        counts = self._counts(len(rows))
        data = self._bytes(rows)
        width = data.shape[1:]
        parts = [data if r == self.rank else data.new_empty(count, *width) for r, count in enumerate(counts)]
        for r, part in enumerate(parts):
            if part.numel() > 0:
                dist.broadcast(part, r)
        return _like(torch.cat(parts), rows)

    def all_to_all(self, parts: Sequence[Tensor]) -> list[Tensor]:
        """Implement `Communicator.all_to_all`."""
        sent_counts = torch.tensor([len(part) for part in parts], device=self.device)
        counts = torch.empty_like(sent_counts)
        dist.all_to_all_single(counts, sent_counts)
        sent = self._bytes(torch.cat(list(parts)))
        received = sent.new_empty(int(counts.sum()), *sent.shape[1:])
        dist.all_to_all_single(received, sent, counts.tolist(), sent_counts.tolist())
        return list(_like(received, parts[0]).split(counts.tolist()))

    def all_reduce(self, values: Tensor) -> Tensor:
        """Implement `Communicator.all_reduce`."""
        total = values.to(self.device, copy=True)
        dist.all_reduce(total)
        return total.to(values.device)

    def broadcast(self, values: Tensor) -> Tensor:
        """Implement `Communicator.broadcast`."""
        data = self._bytes(values)
        if data.numel() > 0:
            dist.broadcast(data, 0)
        return _like(data, values).reshape(values.shape)

    def all_gather_object(self, value: Any) -> list[Any]:
        """Implement `Communicator.all_gather_object`."""
        encoded = torch.frombuffer(bytearray(json.dumps(value).encode()), dtype=torch.uint8)
        text = bytes(self.all_gather(encoded).numpy())
        result = []
        for count in self._counts(len(encoded)):
            result.append(json.loads(text[:count]))
            text = text[count:]
        return result

    def claim_chunks(self, count: int) -> Iterator[int]:
        """Claim free chunks, starting with the share of this process, and yield their indices."""
        key, self._num_divisions = f"{self._num_divisions}-", self._num_divisions + 1
        first = count * self.rank // self.world_size
        for index in [*range(first, count), *range(first)]:
            if try_claim(self._folder, f"{key}{index}", after=0) is not None:
                yield index

    def aggregate_progress(self, report: ProgressCallback) -> ProgressCallback:
        """Wrap a callback so that only process 0 reports progress.

        In stages that count views, it reports the total of all processes.
        """
        previous: dict[str, int] = {}

        def report_total(stage: str, done: int, total: int) -> None:
            if stage in VIEW_STAGES:
                new, previous[stage] = done - previous.get(stage, 0), done
                done = min(total, self.store.add(stage, new))
            if self.rank == 0:
                report(stage, done, total)

        return report_total

    @contextmanager
    def shared_folder(self, folder: Path) -> Iterator[None]:
        """Provide a context in which `claim_chunks` can be called.

        Args:
            folder: Directory that all processes share.
        Raises:
            InputError: If the processes do not share the directory, or several of them can create the same file in it.
        """
        if self.rank == 0:
            for leftover in folder.glob("team-*"):  # from processes that were killed
                if time.time() - leftover.stat().st_mtime > _STALE_SECONDS:
                    shutil.rmtree(leftover, ignore_errors=True)
        self._folder = folder / f"team-{self.broadcast_object(uuid4().hex)}"
        creators = sum(self.all_gather_object(try_claim(self._folder, "start", after=0) is not None))
        if creators != 1:
            raise InputError(
                f"{creators} of {self.world_size} processes created the same file in {folder}, expected 1. The "
                "processes do not share that folder, or its file system does not support exclusive creation. Start all "
                "processes with the same --output-dir, on a shared file system that supports exclusive creation"
            )
        try:
            yield
        finally:
            if self.rank == 0:
                shutil.rmtree(self._folder, ignore_errors=True)

    def _counts(self, count: int) -> list[int]:
        counts = [torch.zeros(1, dtype=torch.int64, device=self.device) for _ in range(self.world_size)]
        dist.all_gather(counts, torch.tensor([count], device=self.device))
        return torch.cat(counts).tolist()

    def _bytes(self, rows: Tensor) -> Tensor:
        flat = rows.to(self.device).reshape(len(rows), prod(rows.shape[1:]))
        return flat.contiguous().view(torch.uint8)


def all_gather_sparse(team: Communicator, rows: SparseRows) -> SparseRows:
    """Return the concatenated rows of all processes, in each process."""
    lengths = team.all_gather(rows.offsets.diff())
    return SparseRows(_offsets(lengths), team.all_gather(rows.column), team.all_gather(rows.weight))


def gather_sparse(portion: Partition, rows: SparseRows) -> SparseRows | None:
    """Combine the rows of all Gaussians, in index order, in process 0; return None in all other processes."""
    parts = [portion.communicator.gather(x) for x in (rows.offsets.diff(), rows.column, rows.weight)]
    if any(part is None for part in parts):
        return None
    lengths, column, weight = (torch.cat(part) for part in parts if part is not None)
    count = torch.arange(len(portion.order), device=portion.order.device)
    row_of = torch.empty_like(portion.order).index_copy_(0, torch.cat(portion.indices_by_rank), count)
    return SparseRows(_offsets(lengths), column, weight).select_rows(row_of)


def _offsets(lengths: Int64[Tensor, " n"]) -> Int64[Tensor, " n_plus_1"]:
    return torch.cat([lengths.new_zeros(1), lengths.cumsum(0)])


def _like(data: Tensor, rows: Tensor) -> Tensor:
    """Convert bytes to an array whose rows have the shape, type and device of those of `rows`."""
    return data.flatten().view(rows.dtype).reshape(-1, *rows.shape[1:]).to(rows.device)


# Exchange of evidence between the owners of views and of Gaussians, and of neighbors for the vote.


_WEIGHT_DTYPES = {4: torch.float32, 8: torch.float64}
"""Types of evidence weights, by size in bytes."""
_RENUMBER_BLOCK = 2**20
"""Number of rows of neighbors to renumber at a time."""


class CooEntries(NamedTuple):
    """Entries of a sparse matrix in coordinate format, sorted by row. An entry takes 12 bytes with float32 weights."""

    row: Int32[Tensor, " nnz"]
    column: Int32[Tensor, " nnz"]
    weight: Float[Tensor, " nnz"]


@dataclass(frozen=True)
class EvidenceShard:
    """Evidence of one chunk of views, split by the process that owns the Gaussians.

    Row indices are those of the arrays of the owner; see `Partition.place`.
    """

    rows: list[CooEntries]
    """Entries of labeled pixels, with regions as columns, by the process that owns the Gaussians."""
    unlabeled: list[CooEntries]
    """Entries of unlabeled pixels, with views as columns, by the process that owns the Gaussians."""
    metadata: tuple[list[int], int, int, int]
    """Number of regions of each view, `weight_power`, `num_excluded`, and bytes per weight."""

    @staticmethod
    def split(evidence: Evidence, portion: Partition) -> EvidenceShard:
        """Split the evidence of all Gaussians by the process that owns them."""
        regions = torch.bincount(evidence.region_view, minlength=evidence.num_views).tolist()
        facts = (regions, evidence.weight_power, evidence.num_excluded, evidence.rows.weight.element_size())
        return EvidenceShard(
            _split_by_owner(evidence.rows, portion), _split_by_owner(evidence.unlabeled, portion), facts
        )


def _split_by_owner(rows: SparseRows, portion: Partition) -> list[CooEntries]:
    owner, row = portion.place
    gaussian = rows.row_index()
    owner_of, row_of, parts = owner[gaussian], row[gaussian], []
    for rank in range(portion.communicator.world_size):
        entries = (owner_of == rank).nonzero().squeeze(1)
        parts.append(CooEntries(row_of[entries], rows.column[entries], rows.weight[entries]))
    return parts


def redistribute_evidence(pieces: Mapping[int, EvidenceShard], portion: Partition, chunks: int) -> Evidence:
    """Exchange evidence between processes, and return the evidence of all views for the Gaussians of this process.

    Args:
        pieces: Evidence that this process collected, by chunk index. All processes together have all chunks.
        chunks: Number of chunks of all processes.
    """
    local_chunks = sorted(pieces)
    matrices = ([pieces[chunk].rows for chunk in local_chunks], [pieces[chunk].unlabeled for chunk in local_chunks])
    counts = [
        [[len(parts[rank].row) for parts in matrix] for matrix in matrices]
        for rank in range(portion.communicator.world_size)
    ]
    gathered = portion.communicator.all_gather_object(
        [local_chunks, [pieces[chunk].metadata for chunk in local_chunks], counts]
    )
    facts = {chunk: item for rank_chunks, items, _ in gathered for chunk, item in zip(rank_chunks, items)}
    regions_of = [facts[chunk][0] for chunk in range(chunks)]
    widths = [(sum(counts), len(counts)) for counts in regions_of]  # numbers of columns of both matrices
    _, weight_power, num_excluded, weight_bytes = facts[0]
    result = []
    for i, matrix in enumerate(matrices):
        first_column = [0, *accumulate(width[i] for width in widths)]
        received = [(owned, counts[portion.communicator.rank][i]) for owned, _, counts in gathered]
        result.append(_exchange_rows(matrix, received, first_column, portion, _WEIGHT_DTYPES[weight_bytes]))
    regions = torch.tensor(list(chain.from_iterable(regions_of)))
    region_view = torch.repeat_interleave(torch.arange(len(regions), dtype=torch.int32), regions)
    region_view = region_view.to(portion.order.device)
    return Evidence(result[0], region_view, result[1], len(regions), weight_power, num_excluded)


def _exchange_rows(
    entries: Sequence[Sequence[CooEntries]],
    sent_counts: Sequence[tuple[Sequence[int], Sequence[int]]],
    first_column: Sequence[int],
    portion: Partition,
    dtype: torch.dtype,
) -> SparseRows:
    """Exchange the entries of a matrix between processes, and return the rows of this process's Gaussians.

    Args:
        entries: Entries of this process, by chunk and receiving process.
        sent_counts: Chunks of each process, and the number of entries per chunk that it sends to this process.
        first_column: First column of each chunk in the whole matrix.
        dtype: Type of the weights.
    """
    team, device = portion.communicator, portion.order.device
    empty = CooEntries(*(torch.zeros(0, dtype=x, device=device) for x in (torch.int32, torch.int32, dtype)))
    arrays = []
    for name in CooEntries._fields:
        sent = ([empty, *(chunk[rank] for chunk in entries)] for rank in range(team.world_size))
        arrays.append(team.all_to_all([torch.cat([getattr(part, name) for part in parts]) for parts in sent]))
    received: dict[int, tuple[Tensor, Tensor, Tensor]] = {}
    for rank, (chunks, counts) in enumerate(sent_counts):
        parts = [array[rank].split(list(counts)) for array in arrays]
        for chunk, row, column, weight in zip(chunks, *parts):
            received[chunk] = row.long(), column + first_column[chunk], weight
    return SparseRows.stack([received[chunk] for chunk in sorted(received)], len(portion), device)


class Halo(NamedTuple):
    """Gaussians of this process, followed by their neighbors in other processes."""

    lifted: Lifted
    """Lift with the directions of all Gaussians of the halo. Neighbors in other processes have a norm, but all their
    other scalars are 0."""
    neighbors: Neighbors
    """Neighbors of this process's Gaussians, as row indices in `lifted`."""
    gaussians: Int64[Tensor, " all"]
    """Index in the scene of each Gaussian of the halo."""


def gather_halo(lifted: Lifted, neighbors: Neighbors, portion: Partition) -> Halo:
    """Gather the directions and neighbors that the vote needs for the Gaussians of this process.

    Args:
        lifted: Lift of this process's Gaussians.
        neighbors: Neighbors of this process's Gaussians, as indices in the scene.
    """
    team, local, device = portion.communicator, portion.indices, portion.order.device
    _, row = portion.place
    wanted = torch.zeros(len(portion.order) + 1, dtype=torch.bool, device=device)  # the last element is for -1
    for index in neighbors.index.split(_RENUMBER_BLOCK):
        wanted[index.long()] = True
    wanted[local] = False
    halo = [gaussians[wanted[gaussians]] for gaussians in portion.indices_by_rank]
    requested = team.all_to_all([row[gaussians] for gaussians in halo])
    evidence, norm = lifted.evidence, lifted.scalars.norm
    sent = [evidence.rows.select_rows(rows.long()) for rows in requested]
    norms = (norm[rows.long()] for rows in requested)
    parts = zip(*((x.offsets.diff(), x.column, x.weight, length) for x, length in zip(sent, norms)))
    lengths, column, weight, halo_norm = (torch.cat(team.all_to_all(part)) for part in parts)
    offsets = _offsets(torch.cat([evidence.rows.offsets.diff(), lengths]))
    rows = SparseRows(offsets, torch.cat([evidence.rows.column, column]), torch.cat([evidence.rows.weight, weight]))
    blank = SparseRows(torch.zeros_like(offsets), evidence.unlabeled.column[:0], evidence.unlabeled.weight[:0])
    scalars = lifted.scalars.map(lambda x: torch.cat([x, x.new_zeros(len(halo_norm))]))
    scalars = replace(scalars, norm=torch.cat([norm, halo_norm]))
    extended = Lifted(scalars, replace(evidence, rows=rows, unlabeled=blank), lifted.features)
    gaussians = torch.cat([local, *halo])
    row_of = torch.full((len(portion.order) + 1,), -1, dtype=torch.int32, device=device)
    row_of[gaussians] = torch.arange(len(gaussians), dtype=torch.int32, device=device)
    index = torch.cat([row_of[block.long()] for block in neighbors.index.split(_RENUMBER_BLOCK)])
    return Halo(extended, neighbors._replace(index=index), gaussians)
