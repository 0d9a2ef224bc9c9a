"""Work on the next items while the result of one is used."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import islice
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


def ahead(function: Callable[[Item], Result], items: Iterable[Item], threads: int) -> Iterator[Result]:
    """As `map`, but as many of the next items as there are threads are worked on while a result is used.

    Items are asked for in the caller's thread. What they or the function raise is raised when its turn comes. With one
    thread nothing is done ahead.

    >>> list(ahead(abs, [-1, 2, -3], 2))
    [1, 2, 3]
    """
    if threads == 1:
        yield from map(function, items)
        return
    left, waiting = iter(items), deque[Future[Result]]()

    def start(count: int) -> None:
        try:
            waiting.extend(pool.submit(function, item) for item in islice(left, count))
        except Exception as error:  # of the items
            waiting.append(Future())
            waiting[-1].set_exception(error)

    with ThreadPoolExecutor(threads) as pool:
        try:
            start(threads)
            while len(waiting) > 0:
                result = waiting.popleft().result()
                start(1)
                yield result
        finally:
            pool.shutdown(cancel_futures=True)
