"""A team of threads: what processes exchange, without any processes."""

import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, TypeVar

import torch
from torch import Tensor

from normlift_ns.core.partition import Communicator

T = TypeVar("T")


class Threads(Communicator):
    """One of some threads."""

    def __init__(self, rank: int, size: int, board: list[Any], barrier: threading.Barrier) -> None:
        self.rank, self.world_size, self._board, self._barrier = rank, size, board, barrier
        self.taken: list[int] = []

    def _all(self, value: Any) -> list[Any]:
        self._board[self.rank] = value
        self._barrier.wait(60)
        found = list(self._board)
        self._barrier.wait(60)
        return found

    def all_gather(self, rows: Tensor) -> Tensor:
        return torch.cat(self._all(rows))

    def all_to_all(self, parts: Sequence[Tensor]) -> list[Tensor]:
        return [given[self.rank] for given in self._all(list(parts))]

    def all_reduce(self, values: Tensor) -> Tensor:
        return torch.stack(self._all(values)).sum(dim=0)

    def broadcast(self, values: Tensor) -> Tensor:
        return self._all(values)[0]

    def all_gather_object(self, value: Any) -> list[Any]:
        return self._all(value)

    @contextmanager
    def shared_folder(self, folder: Any) -> Iterator[None]:
        yield

    def claim_chunks(self, count: int) -> Iterator[int]:
        return iter(range(count)[::-1][self.rank :: self.world_size])  # in an order that nobody expects


def together(size: int, work: Callable[[Threads], T]) -> list[T]:
    """What every thread of a team makes of the same work."""
    board, barrier, found = [None] * size, threading.Barrier(size), [None] * size
    errors: list[BaseException] = []

    def run(rank: int) -> None:
        try:
            found[rank] = work(Threads(rank, size, board, barrier))  # type: ignore[call-overload]
        except BaseException as error:
            errors.append(error)
            barrier.abort()

    threads = [threading.Thread(target=run, args=(rank,)) for rank in range(size)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    if len(errors) > 0:
        raise errors[0]
    return found  # type: ignore[return-value]
