"""Batches shrink until they fit, and say so when nothing fits; what is fetched ahead comes in order."""

from collections.abc import Iterable
from itertools import islice, product
from threading import Barrier, get_ident

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from normlift_ns.core.device import AdaptiveBatches, prefetch_map, shared_property


def narrow(room: int):
    asked = []

    def function(items):
        asked.append(len(items))
        if len(items) > room:
            raise torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 2 GiB.")
        return items * 2

    return function, asked


def test_batches_shrink_until_they_fit_and_stay_so():
    batches = AdaptiveBatches(16)
    function, asked = narrow(3)
    assert torch.cat(list(batches(function, torch.arange(10)))).tolist() == list(range(0, 20, 2))
    assert asked == [10, 5, 2, 3, 5, 2, 3]
    assert batches.batch_size == 3
    del asked[:]
    assert torch.cat(list(batches(function, torch.arange(7)))).tolist() == list(range(0, 14, 2))
    assert asked == [3, 3, 1]


@given(counts=st.lists(st.integers(0, 9), max_size=9), size=st.integers(1, 8))
def test_batches_are_filled_from_several_parts(counts, size):
    asked, sizes, first = [], [], [sum(counts[:i]) for i in range(len(counts))]

    def parts():
        for i, count in enumerate(counts):
            asked.append(i)
            yield list(range(first[i], first[i] + count))

    def double(items):
        sizes.append(len(items))
        return torch.tensor(items)[:, None] * 2

    for i, rows in enumerate(AdaptiveBatches(size).map_across(double, parts())):
        assert [int(row) for row in rows] == list(range(2 * first[i], 2 * (first[i] + counts[i]), 2))
        assert first[len(asked) - 1] < first[i] + counts[i] + size  # no part is asked for without need
    assert asked == list(range(len(counts)))
    assert sizes == [size] * -(-sum(counts) // size)
    with pytest.raises(MemoryError, match=r"CUDA out of memory.*2 GiB.*lift_downscale"):
        list(AdaptiveBatches(16)(narrow(0)[0], torch.arange(10)))
    with pytest.raises(ZeroDivisionError):
        list(AdaptiveBatches(2)(lambda items: 1 // 0, torch.arange(3)))
    assert list(AdaptiveBatches(2)(lambda items: items, torch.arange(0))) == []


def test_results_come_in_the_order_of_their_items() -> None:
    for count, threads in product((0, 1, 7, 8, 9, 30), (1, 2, 8)):
        started: list[int] = []
        items = (started.append(index) or index for index in range(100, 100 + count))
        found = prefetch_map(lambda index: index * 10, items, threads)
        assert list(islice(found, 3)) == [1000, 1010, 1020][:count], (count, threads)
        assert len(started) <= 3 + (threads if threads > 1 else 0), (count, threads)
        assert list(found) == [index * 10 for index in range(100 + min(count, 3), 100 + count)], (count, threads)
        assert sorted(started) == list(range(100, 100 + count)), (count, threads)
    started = []
    found = prefetch_map(started.append, range(1000), 2)
    next(found)
    found.close()
    assert len(started) <= 3  # who stops asking waits for nothing that has not begun


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


def test_items_are_asked_for_in_the_thread_of_the_caller() -> None:
    for threads, ours in ((1, True), (2, False)):
        asked = []
        items = (asked.append(get_ident()) for _ in range(5))
        worked = list(prefetch_map(lambda _: get_ident(), items, threads))
        assert set(asked) == {get_ident()}
        assert (set(worked) == {get_ident()}) is ours


def test_threads_that_ask_together_share_one_value() -> None:
    together, made = Barrier(4), []

    class Owner:
        @shared_property
        def network(self) -> object:
            made.append(object())
            return made[-1]

    owner = Owner()

    def ask(_: int) -> object:
        together.wait()
        return owner.network

    found = list(prefetch_map(ask, range(4), 4))
    assert len(made) == 1 and all(value is made[0] for value in found) and vars(owner) == {"network": made[0]}
