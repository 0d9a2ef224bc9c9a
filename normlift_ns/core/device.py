"""Choice of the device, availability of the Triton kernels, and recovery when GPU memory runs out."""

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
from normlift_ns.options import check_device

MIN_TRITON_VERSION = 3
Items = TypeVar("Items", Sequence, Tensor)  # pyright: ignore[reportMissingTypeArgument]
Result = TypeVar("Result")


@cache
def has_triton() -> bool:
    """Return whether Triton 3 or newer is installed, as with torch 2.4 and later on Linux.

    Without it, stock gsplat rasterizes on the GPU.
    """
    if find_spec("triton") is None:
        return False
    try:
        return int(version("triton").partition(".")[0]) >= MIN_TRITON_VERSION
    except (PackageNotFoundError, ValueError):  # from another distribution, whose version is not comparable
        return True


def can_use_triton(tensor: Tensor) -> bool:
    """Return whether the Triton kernels can process a tensor: it is on a GPU, and Triton is installed."""
    return tensor.is_cuda and has_triton()


def retry_in_halves(run: Callable[[Items], Result], items: Items, advice: str) -> list[Result]:
    """Run a function on all items; if the GPU runs out of memory, split them into halves recursively.

    Args:
        run: function of a part of the items.
        items: sequence, or tensor that is split along its first dimension.
        advice: remedy that the message of the MemoryError suggests.
    Returns:
        The results of all parts, in order.
    Raises:
        MemoryError: if a single item is too large.
    """
    try:
        return [run(items)]
    except torch.cuda.OutOfMemoryError as error:
        if len(items) <= 1:
            raise MemoryError(f"the GPU's memory is full ({error}); {advice}") from error
    torch.cuda.empty_cache()
    half = len(items) // 2
    return retry_in_halves(run, items[:half], advice) + retry_in_halves(run, items[half:], advice)


def init_cuda(device: str) -> None:
    """Initialize CUDA in the background, which takes a second.

    Errors are ignored here, because they recur and are reported when the GPU is used.
    """

    def start() -> None:
        with suppress(Exception):
            torch.empty(1, device=device)

    if device.startswith("cuda"):
        Thread(target=start, name="init-cuda", daemon=True).start()


def choose_device(device: str) -> str:
    """Return the device to use; "auto" is cuda if available, else cpu.

    Raises:
        ValueError: if the device is unknown or this machine does not have it.
    """
    device = check_device(device)
    if device.startswith("cuda"):
        count = torch.cuda.device_count()
        if count == 0:
            raise InputError(f"--device {device}: this machine has no CUDA device; use --device cpu")
        if int(device[5:] or 0) >= count:
            raise InputError(f"--device {device}: no such device; the last one is cuda:{count - 1}")
    if device != "auto":
        return device
    return "cuda" if torch.cuda.is_available() else "cpu"
