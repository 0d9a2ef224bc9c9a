"""Compilation of functions with numba, with a cache on disk."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba


def cached_njit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Return a decorator like `numba.njit`, with a cache on disk if a cache folder is writable."""

    def decorate(function: Callable[..., Any]) -> Any:
        try:
            return numba.njit(cache=True, error_model="numpy", **options)(function)
        except RuntimeError:  # numba cannot write to this folder or the user's cache folder
            return numba.njit(error_model="numpy", **options)(function)

    return decorate
