"""Communication between processes with torch.distributed: NCCL for GPUs, gloo for CPUs."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from math import prod
from pathlib import Path
from typing import Any
from uuid import uuid4

import torch
import torch.distributed as dist
from torch import Tensor

from normlift_ns.core.disk.claims import claim
from normlift_ns.core.portions import PER_VIEW, Report, Team
from normlift_ns.errors import InputError

_STALE_SECONDS = 7 * 86400
"""Age at which a shared directory of killed processes is deleted."""


@dataclass(kw_only=True)
class Processes(Team):
    """Communication of this process with the others.

    Arrays can have any type and device; results are on the same device.
    """

    rank: int
    size: int
    device: torch.device
    """Device on which arrays are exchanged."""
    store: Any
    """Shared store for progress counters."""
    _folder: Path = field(default_factory=Path)
    """Directory shared by all processes, in which they claim work items."""
    _num_divisions: int = 0
    """Number of calls of `chunks` so far."""

    def join(self, rows: Tensor) -> Tensor:
        """See the base class."""
        counts = self._counts(len(rows))
        data = self._bytes(rows)
        width = data.shape[1:]
        parts = [data if r == self.rank else data.new_empty(count, *width) for r, count in enumerate(counts)]
        for r, part in enumerate(parts):
            if part.numel() > 0:
                dist.broadcast(part, r)
        return _like(torch.cat(parts), rows)

    def deliver(self, rows: Tensor) -> list[Tensor] | None:
        """See the base class."""
        counts, data = self._counts(len(rows)), self._bytes(rows)
        if self.rank > 0:
            if data.numel() > 0:
                dist.send(data, 0)
            return None
        parts = [rows]
        for r in range(1, self.size):
            part = data.new_empty(counts[r], *data.shape[1:])
            if part.numel() > 0:
                dist.recv(part, r)
            parts.append(_like(part, rows))
        return parts

    def exchange(self, parts: Sequence[Tensor]) -> list[Tensor]:
        """See the base class."""
        sent_counts = torch.tensor([len(part) for part in parts], device=self.device)
        counts = torch.empty_like(sent_counts)
        dist.all_to_all_single(counts, sent_counts)
        sent = self._bytes(torch.cat(list(parts)))
        received = sent.new_empty(int(counts.sum()), *sent.shape[1:])
        dist.all_to_all_single(received, sent, counts.tolist(), sent_counts.tolist())
        return list(_like(received, parts[0]).split(counts.tolist()))

    def add(self, values: Tensor) -> Tensor:
        """See the base class."""
        total = values.to(self.device, copy=True)
        dist.all_reduce(total)
        return total.to(values.device)

    def spread(self, values: Tensor) -> Tensor:
        """See the base class."""
        data = self._bytes(values)
        if data.numel() > 0:
            dist.broadcast(data, 0)
        return _like(data, values).reshape(values.shape)

    def tell(self, value: Any) -> Any:
        """See the base class."""
        return self.tell_all(value if self.rank == 0 else None)[0]

    def tell_all(self, value: Any) -> list[Any]:
        """See the base class."""
        encoded = torch.frombuffer(bytearray(json.dumps(value).encode()), dtype=torch.uint8)
        text = bytes(self.join(encoded).numpy())
        result = []
        for count in self._counts(len(encoded)):
            result.append(json.loads(text[:count]))
            text = text[count:]
        return result

    def chunks(self, count: int) -> Iterator[int]:
        """Yield the items of this process's part, then those of others that nobody has claimed in the directory."""
        key, self._num_divisions = f"{self._num_divisions}-", self._num_divisions + 1
        first = count * self.rank // self.size
        for index in [*range(first, count), *range(first)]:
            if claim(self._folder, f"{key}{index}", after=0) is not None:
                yield index

    def counted(self, report: Report) -> Report:
        """See the base class."""
        previous: dict[str, int] = {}

        def report_total(stage: str, done: int, total: int) -> None:
            if stage in PER_VIEW:
                new, previous[stage] = done - previous.get(stage, 0), done
                done = min(total, self.store.add(stage, new))
            if self.rank == 0:
                report(stage, done, total)

        return report_total

    @contextmanager
    def shares(self, folder: Path) -> Iterator[None]:
        """Provide a context in which `chunks` can be called.

        Args:
            folder: directory that all processes share.
        Raises:
            InputError: if the processes do not share it, or two of them can create the same file in it.
        """
        if self.rank == 0:
            for leftover in folder.glob("team-*"):  # from processes that were killed
                if time.time() - leftover.stat().st_mtime > _STALE_SECONDS:
                    shutil.rmtree(leftover, ignore_errors=True)
        self._folder = folder / f"team-{self.tell(uuid4().hex)}"
        creators = sum(self.tell_all(claim(self._folder, "start", after=0) is not None))
        if creators != 1:
            raise InputError(
                f"{creators} of {self.size} processes created the same file in {folder}, expected 1. Either they do "
                "not share that folder, or its file system does not support exclusive creation. Give all of them the "
                "same --output-dir, on a disk that they share"
            )
        try:
            yield
        finally:
            if self.rank == 0:
                shutil.rmtree(self._folder, ignore_errors=True)

    def _counts(self, count: int) -> list[int]:
        counts = [torch.zeros(1, dtype=torch.int64, device=self.device) for _ in range(self.size)]
        dist.all_gather(counts, torch.tensor([count], device=self.device))
        return torch.cat(counts).tolist()

    def _bytes(self, rows: Tensor) -> Tensor:
        flat = rows.to(self.device).reshape(len(rows), prod(rows.shape[1:]))
        return flat.contiguous().view(torch.uint8)


def _like(data: Tensor, rows: Tensor) -> Tensor:
    """Convert bytes to rows with the shape, type and device of others."""
    return data.flatten().view(rows.dtype).reshape(-1, *rows.shape[1:]).to(rows.device)
