"""numpy's numbers in checkpoints are read by every version of torch, and nothing else is."""

from __future__ import annotations

import pickle
from collections import OrderedDict
from pathlib import Path

import numpy as np
import pytest
import torch

from normlift_ns.scenes.unpickling import numbers_allowed

STATE = {"step": 7, "lr": np.float64(0.1), "many": [np.float32(1), np.int64(3)], "w": torch.arange(3.0)}


class Stranger:
    """Of no kind that a checkpoint holds."""


def test_numbers_are_read_and_objects_are_not(tmp_path: Path) -> None:
    torch.save({**STATE, "more": OrderedDict(a=1)}, tmp_path / "plain.pt")
    torch.save({**STATE, "stranger": Stranger()}, tmp_path / "stranger.pt")
    with numbers_allowed():
        found = torch.load(tmp_path / "plain.pt", weights_only=True)
        with pytest.raises(pickle.UnpicklingError, match="Stranger"):
            torch.load(tmp_path / "stranger.pt", weights_only=True)
    assert found["step"] == 7
    assert torch.equal(found["w"], STATE["w"])
    if hasattr(torch.serialization, "add_safe_globals"):
        assert found["lr"] == 0.1 and found["many"] == [1, 3]
    else:
        assert found["lr"] is None and found["many"] == [None, None]


@pytest.mark.skipif(
    not hasattr(torch.serialization, "safe_globals") and hasattr(torch.serialization, "add_safe_globals"),
    reason="torch 2.4 keeps what was once allowed",
)
def test_what_is_allowed_is_allowed_no_longer_than_needed(tmp_path: Path) -> None:
    torch.save(STATE, tmp_path / "plain.pt")
    with numbers_allowed():
        torch.load(tmp_path / "plain.pt", weights_only=True)
    with pytest.raises(pickle.UnpicklingError, match="numpy"):
        torch.load(tmp_path / "plain.pt", weights_only=True)
