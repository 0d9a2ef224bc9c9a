"""A parallel `map` that prefetches the next results."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import islice
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


def ahead(function: Callable[[Item], Result], items: Iterable[Item], threads: int) -> Iterator[Result]:
    """Yield `map(function, items)`, and compute up to `threads` of the next results while the caller uses one.

    Items are requested in the caller's thread. An exception of the items or the function is raised when its turn comes.
    With one thread, nothing is prefetched.

    >>> list(ahead(abs, [-1, 2, -3], 2))
    [1, 2, 3]
    """
    if threads == 1:
        yield from map(function, items)
        return
    iterator, pending = iter(items), deque[Future[Result]]()

    def submit(count: int) -> None:
        try:
            pending.extend(pool.submit(function, item) for item in islice(iterator, count))
        except Exception as error:  # raised by the items
            pending.append(Future())
            pending[-1].set_exception(error)

    with ThreadPoolExecutor(threads) as pool:
        try:
            submit(threads)
            while len(pending) > 0:
                result = pending.popleft().result()
                submit(1)
                yield result
        finally:
            pool.shutdown(cancel_futures=True)
