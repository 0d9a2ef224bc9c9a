"""Where the Triton kernels of `normlift_ns.kernels` apply, and what to do when a GPU's memory is full."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from threading import Thread
from typing import TypeVar

import torch
from torch import Tensor

from normlift_ns.errors import InputError
from normlift_ns.ranges import check_device

OLDEST_TRITON = 3
Items = TypeVar("Items", Sequence, Tensor)  # pyright: ignore[reportMissingTypeArgument]
Result = TypeVar("Result")


@cache
def has_triton() -> bool:
    """Whether torch came with a Triton that the kernels are written for: 3 or newer, as from torch 2.4 on Linux on.

    Elsewhere stock gsplat rasterizes on the GPU.
    """
    if find_spec("triton") is None:
        return False
    try:
        return int(version("triton").partition(".")[0]) >= OLDEST_TRITON
    except (PackageNotFoundError, ValueError):  # of another distribution, which says nothing
        return True


def kernels_apply(tensor: Tensor) -> bool:
    """Whether a tensor is where kernels run."""
    return tensor.is_cuda and has_triton()


def in_parts(run: Callable[[Items], Result], items: Items, advice: str) -> list[Result]:
    """[run(items)]; where the GPU's memory does not hold that, the results of both halves, and so on.

    Raises:
        MemoryError: one item alone is too large; says so, and what to do: `advice`.
    """
    try:
        return [run(items)]
    except torch.cuda.OutOfMemoryError as error:
        if len(items) <= 1:
            raise MemoryError(f"the GPU's memory is full ({error}); {advice}") from error
    torch.cuda.empty_cache()
    half = len(items) // 2
    return in_parts(run, items[:half], advice) + in_parts(run, items[half:], advice)


def wake(device: str) -> None:
    """Lets a GPU start, which takes a second, while other work goes on.

    What fails then fails again where the GPU is wanted, and is told there.
    """

    def start() -> None:
        with suppress(Exception):  # as the docstring says
            torch.empty(1, device=device)

    if device.startswith("cuda"):
        Thread(target=start, name="wake", daemon=True).start()


def choose_device(device: str) -> str:
    """The device to work on; auto: cuda if there is one.

    Raises:
        ValueError: an unknown device, or one that this machine lacks.
    """
    device = check_device(device)
    if device.startswith("cuda"):
        count = torch.cuda.device_count()
        if count == 0:
            raise InputError(f"--device {device}: this machine has no CUDA device; use --device cpu")
        if int(device[5:] or 0) >= count:
            raise InputError(f"--device {device}: this machine has {count}, of which the last is cuda:{count - 1}")
    if device != "auto":
        return device
    return "cuda" if torch.cuda.is_available() else "cpu"
