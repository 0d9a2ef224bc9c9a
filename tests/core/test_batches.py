"""Batches shrink until they fit, and say so when nothing fits."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from normlift_ns.core.device import AdaptiveBatches


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


def test_what_never_fits_other_errors_and_no_items():
    with pytest.raises(MemoryError, match=r"CUDA out of memory.*2 GiB.*--lift-downscale 2"):
        list(AdaptiveBatches(16)(narrow(0)[0], torch.arange(10)))
    with pytest.raises(ZeroDivisionError):
        list(AdaptiveBatches(2)(lambda items: 1 // 0, torch.arange(3)))
    assert list(AdaptiveBatches(2)(lambda items: items, torch.arange(0))) == []
