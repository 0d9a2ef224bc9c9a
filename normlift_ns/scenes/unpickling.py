"""Safe unpickling of NumPy scalars, such as the learning rates in nerfstudio's scheduler states."""

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
    """Allow `torch.load(weights_only=True)` to read NumPy scalars in addition to tensors and plain containers.

    torch before 2.4 cannot build NumPy scalars, so it reads each of them as None.
    """
    if hasattr(torch.serialization, "safe_globals"):
        with torch.serialization.safe_globals(numpy_numbers()):
            yield
        return
    if hasattr(torch.serialization, "add_safe_globals"):
        torch.serialization.add_safe_globals(numpy_numbers())  # torch 2.4 cannot remove them again
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
    """Return the types and functions that unpickle NumPy scalars, for torch's allow-list."""
    rebuild: Any = np.float64(0).__reduce__()[0]
    dtypes = {type(np.dtype(code)) for code in "?bBhHiIlLqQefd"}
    return [
        np.dtype,
        *dtypes,
        _renamed(_latin1, "_codecs", "encode"),
        *(_renamed(rebuild, module, "scalar") for module in _MODULES),
    ]


def _latin1(text: str, encoding: str) -> bytes:
    """Encode text as pickle encodes bytes. Other encodings could expand a small file to gigabytes."""
    if encoding != "latin1":
        raise pickle.UnpicklingError(f"bytes in the encoding {encoding}")
    return codecs.latin_1_encode(text)[0]


def _unread(*_: object) -> None:
    """Stand-in for a NumPy scalar."""


def _unread_dtype(*_: object) -> torch.nn.Parameter:
    """Stand-in for a NumPy dtype: the only kind of object with a custom state that old torch versions build."""
    stand_in: Any = torch.nn.Parameter(torch.empty(0))
    stand_in.__setstate__ = _unread
    return stand_in


def _renamed(function: Callable[..., Any], module: str, name: str) -> Callable[..., Any]:
    """Return the function under another name, because torch's allow-list compares names."""

    def alias(*args: Any) -> Any:
        return function(*args)

    alias.__module__, alias.__name__, alias.__qualname__ = module, name, name
    return alias
