"""Decorators that compile the CPU rasterizer with numba, and the exponential function that its kernels share.

numba caches a compiled function until its own file changes, and ignores changes to functions that it calls in other
files. After a change here or to `numba_lists.extent`, delete the .nbi files in the `__pycache__` of this folder.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numba
import numpy as np
from numba import types
from numba.extending import overload

_F = np.float32
_MAGIC32, _MAGIC64 = _F(1.5 * 2**23), 1.5 * 2**52
"""Adding a number near 0 rounds it to an integer, which then occupies the last bits of the sum."""
_LOG2_E32, _LN2_HIGH32, _LN2_LOW32, _LEAST32 = _F(1.44269504088896341), _F(0.693359375), _F(-2.12194440e-4), _F(-87)
_LOG2_E64, _LN2_HIGH64, _LN2_LOW64 = 1.44269504088896341, 6.93147180369123816490e-01, 1.90821492927058770002e-10
_P0, _P1, _P2 = _F(1.9875691500e-4), _F(1.3981999507e-3), _F(8.3334519073e-3)
_P3, _P4, _P5, _ONE = _F(4.1665795894e-2), _F(1.6666665459e-1), _F(5.0000001201e-1), _F(1)


def cached_njit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Return `numba.njit` with a cache on disk, if a cache folder is writable."""

    def decorate(function: Callable[..., Any]) -> Any:
        try:
            return numba.njit(cache=True, error_model="numpy", **options)(function)
        except RuntimeError:  # neither next to the code nor in the user's cache folder
            return numba.njit(error_model="numpy", **options)(function)

    return decorate


kernel = cached_njit()
fused_kernel = cached_njit(fastmath={"contract"})
"""Decorator that allows fused multiply-add, which rounds once, as on a GPU."""
parallel_kernel = cached_njit(parallel=True)


def exp(x: float) -> float:
    """Return e ** x for x <= 0 in the precision of x, within 1e-7 (float32) or 4e-16 (float64).

    Results are at least e ** -87 (float32) or e ** -700 (float64).
    """
    return math.exp(x)


@overload(exp, jit_options={"error_model": "numpy", "fastmath": {"contract"}})
def _compiled_exp(x):  # pragma: no cover (compiled)
    """Compute e ** x = 2 ** n e ** r with |r| <= ln(2) / 2, by the polynomials of Cephes' expf and of Taylor."""

    def single(x):
        x = x if x > _LEAST32 else _LEAST32
        shifted = x * _LOG2_E32 + _MAGIC32
        n = shifted - _MAGIC32
        r = (x - n * _LN2_HIGH32) - n * _LN2_LOW32
        p = ((((_P0 * r + _P1) * r + _P2) * r + _P3) * r + _P4) * r + _P5
        power = np.int32((np.float32(shifted).view(np.int32) << 23) + 0x3F800000).view(np.float32)
        return (p * (r * r) + r + _ONE) * power

    def double(x):
        x = x if x > -700.0 else -700.0
        shifted = x * _LOG2_E64 + _MAGIC64
        n = shifted - _MAGIC64
        r = (x - n * _LN2_HIGH64) - n * _LN2_LOW64
        p = ((r / 6227020800 + 1 / 479001600) * r + 1 / 39916800) * r + 1 / 3628800
        p = (((p * r + 1 / 362880) * r + 1 / 40320) * r + 1 / 5040) * r + 1 / 720
        p = (((p * r + 1 / 120) * r + 1 / 24) * r + 1 / 6) * r + 0.5
        power = np.int64((np.float64(shifted).view(np.int64) << 52) + 0x3FF0000000000000).view(np.float64)
        return (p * (r * r) + r + 1.0) * power

    return single if x == types.float32 else double


@kernel
def interleaved(position, count, threads):  # pragma: no cover (compiled)
    """Return the work item at a position of a static schedule, so that each thread gets every n-th item.

    Skip items that are not below `count`.
    """
    per_thread = (count + threads - 1) // threads
    return position % per_thread * threads + position // per_thread
