"""numpy's numbers in checkpoints: learning rates in the state of nerfstudio's schedulers are such."""

from __future__ import annotations

import codecs
import pickle
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch

_MODULES = ("numpy.core.multiarray", "numpy._core.multiarray")  # the names in numpy 1 and in numpy 2


@contextmanager
def numbers_allowed() -> Iterator[None]:
    """Lets `torch.load(weights_only=True)` read numpy's numbers besides tensors and plain containers.

    torch before 2.4 cannot build them at all: there each of them is read as None.
    """
    if hasattr(torch.serialization, "safe_globals"):
        with torch.serialization.safe_globals(numpy_numbers()):
            yield
        return
    if hasattr(torch.serialization, "add_safe_globals"):
        torch.serialization.add_safe_globals(numpy_numbers())  # torch 2.4, which takes nothing away again
        yield
        return
    allowed: dict[str, Any] = torch._weights_only_unpickler._get_allowed_globals()  # pyright: ignore
    before = dict(allowed)
    allowed |= {"numpy.dtype": _unread_dtype, "_codecs.encode": _latin1}
    allowed |= {f"{module}.scalar": _unread for module in _MODULES}
    try:
        yield
    finally:
        allowed.clear()
        allowed.update(before)


def numpy_numbers() -> list[Any]:
    """What unpickling numpy's scalars needs, for torch's list of what may be unpickled."""
    rebuild: Any = np.float64(0).__reduce__()[0]
    dtypes = {type(np.dtype(code)) for code in "?bBhHiIlLqQefd"}
    return [
        np.dtype,
        *dtypes,
        _named(_latin1, "_codecs", "encode"),
        *(_named(rebuild, module, "scalar") for module in _MODULES),
    ]


def _latin1(text: str, encoding: str) -> bytes:
    """How pickle writes bytes; other encodings than this one could make gigabytes of nothing."""
    if encoding != "latin1":
        raise pickle.UnpicklingError(f"bytes in the encoding {encoding}")
    return codecs.latin_1_encode(text)[0]


def _unread(*_: object) -> None:
    """In place of a number."""


def _unread_dtype(*_: object) -> torch.nn.Parameter:
    """In place of its type: an object of the one kind with a state of its own that old versions of torch build."""
    stand_in: Any = torch.nn.Parameter(torch.empty(0))
    stand_in.__setstate__ = _unread
    return stand_in


def _named(function: Callable[..., Any], module: str, name: str) -> Callable[..., Any]:
    """The function under another name: torch's allow-list goes by names."""

    def alias(*args: Any) -> Any:
        return function(*args)

    alias.__module__, alias.__name__, alias.__qualname__ = module, name, name
    return alias
