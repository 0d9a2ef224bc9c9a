"""Batches shrink until they fit, and say so when nothing fits."""

import pytest
import torch

from normlift_ns.encoders.batches import Batches


def narrow(room: int):
    asked = []

    def function(items):
        asked.append(len(items))
        if len(items) > room:
            raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2 GiB.\nmore lines")
        return items * 2

    return function, asked


def test_batches_halve_until_they_fit_and_stay_so():
    batches = Batches(16, "crop")
    function, asked = narrow(3)
    assert torch.cat(list(batches(function, torch.arange(10)))).tolist() == list(range(0, 20, 2))
    assert asked == [10, 5, 2, 2, 2, 2, 2]
    assert batches.size == 2
    assert torch.cat(list(batches(function, torch.arange(3)))).tolist() == [0, 2, 4]


def test_one_item_that_does_not_fit_ends_it():
    with pytest.raises(
        MemoryError, match=r"hold a single crop \(CUDA out of memory.*2 GiB\.\); .*--lift-downscale 2"
    ) as e:
        list(Batches(16, "crop")(narrow(0)[0], torch.arange(10)))
    assert "\n" not in str(e.value) and e.value.__suppress_context__


def test_other_errors_pass():
    def broken(items):
        raise RuntimeError("shape")

    with pytest.raises(RuntimeError, match="shape"):
        list(Batches(2, "crop")(broken, torch.arange(3)))


def test_no_items():
    assert list(Batches(2, "crop")(lambda items: items, torch.arange(0))) == []
