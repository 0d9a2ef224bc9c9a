"""Results come in the order of their items, and what fails is told when its turn comes."""

from itertools import islice
from threading import get_ident

import pytest

from normlift_ns.encoders.ahead import ahead


@pytest.mark.parametrize("threads", [1, 2, 8])
@pytest.mark.parametrize("count", [0, 1, 7, 8, 9, 30])
def test_results_come_in_the_order_of_their_items(count: int, threads: int) -> None:
    started: list[int] = []

    def read(index: int) -> int:
        started.append(index)
        return index * 10

    found = ahead(read, range(100, 100 + count), threads)
    assert list(islice(found, 3)) == [1000, 1010, 1020][:count]
    assert len(started) <= 3 + (threads if threads > 1 else 0)
    assert list(found) == [index * 10 for index in range(100 + min(count, 3), 100 + count)]
    assert sorted(started) == list(range(100, 100 + count))


@pytest.mark.parametrize("threads", [1, 2, 8])
def test_what_fails_is_told_when_its_turn_comes(threads: int) -> None:
    def read(index: int) -> int:
        if index == 4:
            raise FileNotFoundError("photograph 4")
        return index

    seen = []
    with pytest.raises(FileNotFoundError, match="photograph 4"):
        for found in ahead(read, range(20), threads):
            seen.append(found)
    assert seen == [0, 1, 2, 3]


@pytest.mark.parametrize("threads", [1, 2, 8])
def test_an_item_that_cannot_be_had_is_told_when_its_turn_comes(threads: int) -> None:
    def items():
        yield from range(4)
        raise FileNotFoundError("photograph 4")

    seen = []
    with pytest.raises(FileNotFoundError, match="photograph 4"):
        for found in ahead(lambda index: index, items(), threads):
            seen.append(found)
    assert seen == [0, 1, 2, 3]


def test_who_stops_asking_waits_for_nothing_that_has_not_begun() -> None:
    started: list[int] = []
    found = ahead(started.append, range(1000), 2)
    next(found)
    found.close()
    assert len(started) <= 3


@pytest.mark.parametrize(("threads", "ours"), [(1, True), (2, False)])
def test_items_are_asked_for_in_the_thread_of_the_caller(threads: int, ours: bool) -> None:
    asked = []

    def items():
        for index in range(5):
            asked.append(get_ident())
            yield index

    worked = list(ahead(lambda _: get_ident(), items(), threads))
    assert set(asked) == {get_ident()}
    assert (set(worked) == {get_ident()}) is ours
