"""Results come in the order of their items, and what fails is told when its turn comes."""

from collections.abc import Iterable
from itertools import islice, product
from threading import get_ident

import pytest

from normlift_ns.core.device import prefetch_map


def test_results_come_in_the_order_of_their_items() -> None:
    for count, threads in product((0, 1, 7, 8, 9, 30), (1, 2, 8)):
        started: list[int] = []
        items = (started.append(index) or index for index in range(100, 100 + count))
        found = prefetch_map(lambda index: index * 10, items, threads)
        assert list(islice(found, 3)) == [1000, 1010, 1020][:count], (count, threads)
        assert len(started) <= 3 + (threads if threads > 1 else 0), (count, threads)
        assert list(found) == [index * 10 for index in range(100 + min(count, 3), 100 + count)], (count, threads)
        assert sorted(started) == list(range(100, 100 + count)), (count, threads)


def failing(items: Iterable[int]) -> Iterable[int]:
    for index in items:
        if index == 4:
            raise FileNotFoundError("photograph 4")
        yield index


@pytest.mark.parametrize("threads", [1, 2, 8])
def test_what_fails_is_told_when_its_turn_comes(threads: int) -> None:
    """Whether an item cannot be read or not even be had."""
    for read, items in ((lambda i: next(iter(failing([i]))), range(20)), (lambda i: i, failing(range(20)))):
        seen = []
        with pytest.raises(FileNotFoundError, match="photograph 4"):
            for found in prefetch_map(read, items, threads):
                seen.append(found)
        assert seen == [0, 1, 2, 3]


def test_who_stops_asking_waits_for_nothing_that_has_not_begun() -> None:
    started: list[int] = []
    found = prefetch_map(started.append, range(1000), 2)
    next(found)
    found.close()
    assert len(started) <= 3


def test_items_are_asked_for_in_the_thread_of_the_caller() -> None:
    for threads, ours in ((1, True), (2, False)):
        asked = []
        items = (asked.append(get_ident()) for _ in range(5))
        worked = list(prefetch_map(lambda _: get_ident(), items, threads))
        assert set(asked) == {get_ident()}
        assert (set(worked) == {get_ident()}) is ours
