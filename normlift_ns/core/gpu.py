"""Where the Triton kernels of `normlift_ns.kernels` apply."""

from __future__ import annotations

from functools import cache
from importlib.util import find_spec

from torch import Tensor


@cache
def has_triton() -> bool:
    """Whether torch came with Triton, as it does on Linux."""
    return find_spec("triton") is not None


def kernels_apply(tensor: Tensor) -> bool:
    """Whether a tensor is where kernels run."""
    return tensor.is_cuda and has_triton()
