"""Table of the rasterization backends, and the choice of one for a job."""

from __future__ import annotations

from collections.abc import Callable
from typing import get_args

import torch

from normlift_ns.core.gpu import has_triton
from normlift_ns.errors import InputError
from normlift_ns.options import BackendName
from normlift_ns.raster.backend import Backend, Job, TileBackend


def _torch() -> Backend:
    from normlift_ns.raster import reference  # noqa: PLC0415 (load each backend at its first use)

    return TileBackend(reference)


def _numba() -> Backend:
    from normlift_ns.raster import numba  # noqa: PLC0415 (importing numba takes a second)

    return numba


def _gsplat() -> Backend:
    from normlift_ns.raster import gsplat  # noqa: PLC0415

    return gsplat


def _triton() -> Backend:
    if not has_triton():
        raise InputError(
            'backend "triton" needs Triton 3, which comes with PyTorch 2.4 on Linux; omit the backend to use another'
        )
    from normlift_ns.raster import triton  # noqa: PLC0415

    return triton


BACKENDS: dict[str, Callable[[], Backend]] = {"torch": _torch, "numba": _numba, "gsplat": _gsplat, "triton": _triton}
"""Backends by name, from the most general to the fastest."""


def choose_backend(name: str, job: Job, *, pictures: bool) -> tuple[str, Backend]:
    """Return a backend and its name; "auto" selects the fastest backend that can do the job.

    Args:
        name: Name of the backend, or "auto".
        job: Inputs of the call.
        pictures: Whether to composite values; False: sum evidence.

    Raises:
        ValueError: If the name is unknown or the backend cannot do the job.
    """
    if name == "auto":
        name = _fastest(job)
    if name not in BACKENDS:
        raise InputError(f"unknown backend {name!r}, expected one of {', '.join(get_args(BackendName))}")
    backend = BACKENDS[name]()
    backend.check(job, pictures=pictures)
    return name, backend


def _fastest(job: Job) -> str:
    means = job.scene.means
    if means.device.type == "cpu":
        return "numba"
    if not means.is_cuda or job.dtype != torch.float32 or means.dtype != torch.float32:
        return "torch"
    return "triton" if has_triton() else "gsplat"
