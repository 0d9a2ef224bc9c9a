"""A team of processes, over torch.distributed: NCCL between GPUs, gloo between CPUs."""

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

_OLD = 7 * 86400
"""Seconds after which nobody works in a folder any more."""


@dataclass(kw_only=True)
class Processes(Team):
    """This process and the others of its team. Arrays may be of any type and on any device; they come back there."""

    rank: int
    size: int
    device: torch.device
    """Where arrays are exchanged."""
    store: Any
    """In which the team counts."""
    _folder: Path = field(default_factory=Path)
    """Shared by all processes, where they divide the work."""
    _divided: int = 0
    """Counts the works that have been divided."""

    def join(self, rows: Tensor) -> Tensor:
        """As in `Team`."""
        counts = self._counts(len(rows))
        mine = self._bytes(rows)
        width = mine.shape[1:]
        parts = [mine if r == self.rank else mine.new_empty(count, *width) for r, count in enumerate(counts)]
        for r, part in enumerate(parts):
            if part.numel() > 0:
                dist.broadcast(part, r)
        return _like(torch.cat(parts), rows)

    def deliver(self, rows: Tensor) -> list[Tensor] | None:
        """As in `Team`."""
        counts, mine = self._counts(len(rows)), self._bytes(rows)
        if self.rank > 0:
            if mine.numel() > 0:
                dist.send(mine, 0)
            return None
        parts = [rows]
        for r in range(1, self.size):
            part = mine.new_empty(counts[r], *mine.shape[1:])
            if part.numel() > 0:
                dist.recv(part, r)
            parts.append(_like(part, rows))
        return parts

    def exchange(self, parts: Sequence[Tensor]) -> list[Tensor]:
        """As in `Team`."""
        sent = torch.tensor([len(part) for part in parts], device=self.device)
        received = torch.empty_like(sent)
        dist.all_to_all_single(received, sent)
        mine = self._bytes(torch.cat(list(parts)))
        found = mine.new_empty(int(received.sum()), *mine.shape[1:])
        dist.all_to_all_single(found, mine, received.tolist(), sent.tolist())
        return list(_like(found, parts[0]).split(received.tolist()))

    def add(self, values: Tensor) -> Tensor:
        """As in `Team`."""
        there = values.to(self.device, copy=True)
        dist.all_reduce(there)
        return there.to(values.device)

    def spread(self, values: Tensor) -> Tensor:
        """As in `Team`."""
        there = self._bytes(values)
        if there.numel() > 0:
            dist.broadcast(there, 0)
        return _like(there, values).reshape(values.shape)

    def tell(self, facts: Any) -> Any:
        """As in `Team`."""
        said = self.tell_all(facts if self.rank == 0 else None)
        return said[0]

    def tell_all(self, facts: Any) -> list[Any]:
        """As in `Team`."""
        words = torch.frombuffer(bytearray(json.dumps(facts).encode()), dtype=torch.uint8)
        said = bytes(self.join(words).numpy())
        found = []
        for count in self._counts(len(words)):
            found.append(json.loads(said[:count]))
            said = said[count:]
        return found

    def chunks(self, count: int) -> Iterator[int]:
        """As in `Team`: first those of its own part, then what others have not begun, which shows in the folder."""
        key, self._divided = f"{self._divided}-", self._divided + 1
        first = count * self.rank // self.size
        for number in [*range(first, count), *range(first)]:
            if claim(self._folder, f"{key}{number}", after=0) is not None:
                yield number

    def counted(self, report: Report) -> Report:
        """As in `Team`."""
        known: dict[str, int] = {}

        def told(stage: str, done: int, total: int) -> None:
            if stage in PER_VIEW:
                more, known[stage] = done - known.get(stage, 0), done
                done = min(total, self.store.add(stage, more))
            if self.rank == 0:
                report(stage, done, total)

        return told

    @contextmanager
    def shares(self, folder: Path) -> Iterator[None]:
        """As in `Team`.

        Raises:
            InputError: they do not share it, or two processes can create the same file in it.
        """
        if self.rank == 0:
            for left in folder.glob("team-*"):  # of processes that were killed
                if time.time() - left.stat().st_mtime > _OLD:
                    shutil.rmtree(left, ignore_errors=True)
        self._folder = folder / f"team-{self.tell(uuid4().hex)}"
        winners = sum(self.tell_all(claim(self._folder, "start", after=0) is not None))
        if winners != 1:
            raise InputError(
                f"{winners} of {self.size} processes could create the same file in {folder}: they do not share that "
                "folder, or its file system does not keep two processes from creating one file. Give all of them the "
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
        there = rows.to(self.device)
        return there.reshape(len(rows), prod(rows.shape[1:])).contiguous().view(torch.uint8)


def _like(found: Tensor, rows: Tensor) -> Tensor:
    """Bytes as rows of the type and on the device of others."""
    return found.flatten().view(rows.dtype).reshape(-1, *rows.shape[1:]).to(rows.device)
