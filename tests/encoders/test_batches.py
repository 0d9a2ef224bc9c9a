"""Batches shrink until they fit, and say so when nothing fits."""

import pytest
import torch

from normlift_ns.encoders.batches import Batches


def narrow(room: int):
    asked = []

    def function(items):
        asked.append(len(items))
        if len(items) > room:
            raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2 GiB.")
        return items * 2

    return function, asked


def test_batches_shrink_until_they_fit_and_stay_so():
    batches = Batches(16)
    function, asked = narrow(3)
    assert torch.cat(list(batches(function, torch.arange(10)))).tolist() == list(range(0, 20, 2))
    assert asked == [10, 5, 2, 3, 5, 2, 3]
    assert batches.size == 3
    del asked[:]
    assert torch.cat(list(batches(function, torch.arange(7)))).tolist() == list(range(0, 14, 2))
    assert asked == [3, 3, 1]


def test_one_item_that_does_not_fit_ends_it():
    with pytest.raises(MemoryError, match=r"memory is full \(CUDA out of memory.*2 GiB\.\); .*--lift-downscale 2"):
        list(Batches(16)(narrow(0)[0], torch.arange(10)))


def test_other_errors_pass():
    def broken(items):
        raise RuntimeError("shape")

    with pytest.raises(RuntimeError, match="shape"):
        list(Batches(2)(broken, torch.arange(3)))


def test_no_items():
    assert list(Batches(2)(lambda items: items, torch.arange(0))) == []
