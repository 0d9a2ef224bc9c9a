"""Adapters for encoders and mask sources of other packages.

An adapter checks the results of its plugin. Unexpected exceptions become errors that name the plugin. InputError,
FileNotFoundError, MemoryError and torch.OutOfMemoryError pass unchanged.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import torch
from jaxtyping import Float32, Int32, UInt8
from torch import Tensor

from normlift_ns.encoders.base import Encoder
from normlift_ns.encoders.text_files import UNIT_TOLERANCE, check_prompts
from normlift_ns.errors import InputError, summarize_error

_Result = TypeVar("_Result")


@dataclass(frozen=True)
class PluginEncoder(Encoder):
    """An adapter for an encoder of another package.

    The wrapped object needs only `identity`, `encode` and `text`. If it also has `patches`, so does the adapter that
    `made` returns.

    Raises (from all methods):
        InputError: If the encoder fails, or returns a result that violates the `Encoder` protocol.
        FileNotFoundError, MemoryError: If the encoder raises them.
    """

    name: str
    encoder: Encoder

    @classmethod
    def made(cls, name: str, make: Callable[[], Encoder]) -> PluginEncoder:
        """Make an encoder, check that it has the required attributes, and return its adapter."""
        encoder = _make("encoder", name, make, ("identity", "encode", "text"))
        return DensePluginEncoder(name, encoder) if hasattr(encoder, "patches") else cls(name, encoder)

    @property
    def identity(self) -> dict[str, Any]:
        return _call("encoder", self.name, lambda: {"kind": self.name, **self.encoder.identity})

    def encode(self, image: UInt8[Tensor, "h w 3"], labels: Int32[Tensor, "depth h w"]) -> Float32[Tensor, "r d"]:
        rows = _call("encoder", self.name, lambda: self.encoder.encode(image, labels))
        return self._check_rows(rows, int(labels.max()) + 1, "region")

    def text(self, prompts: Sequence[str]) -> Float32[Tensor, "q d"]:
        check_prompts(prompts)
        rows = _call("encoder", self.name, lambda: self.encoder.text(prompts))
        return self._check_rows(rows, len(prompts), "prompt")

    def _check_rows(self, rows: object, count: int, unit: str) -> Float32[Tensor, "n d"]:
        """Return the rows as float32 on the CPU; raise InputError unless there are `count` rows of unit length.

        Rows of regions and patches may also be zero.
        """
        if not isinstance(rows, Tensor) or rows.ndim != 2 or len(rows) != count or not rows.is_floating_point():
            received = f"{rows.dtype} {tuple(rows.shape)}" if isinstance(rows, Tensor) else type(rows).__name__
            raise InputError(
                f"encoder {self.name!r} of another package returned {received}, expected a float tensor [{count}, D] "
                f"with one row per {unit}; fix that package"
            )
        rows = rows.detach().float().cpu()
        length = torch.linalg.vector_norm(rows, dim=1)
        length = length if unit == "prompt" else length.where(length != 0, 1.0)
        if not bool(((length - 1).abs() < UNIT_TOLERANCE).all()):
            raise InputError(
                f"encoder {self.name!r} of another package returned a vector of length "
                f"{float(length[(length - 1).abs().argmax()]):.3g} for a {unit}, expected 1; normalize the "
                "vectors in that package"
            )
        return rows


@dataclass(frozen=True)
class DensePluginEncoder(PluginEncoder):
    """An adapter for an encoder of another package that can also embed patches."""

    @property
    def why_not_dense(self) -> str | None:
        return getattr(self.encoder, "why_not_dense", None)

    def patches(self, image: UInt8[Tensor, "h w 3"], rows: int, columns: int) -> Float32[Tensor, "r d"]:
        encoder: Any = self.encoder
        features = _call("encoder", self.name, lambda: encoder.patches(image, rows, columns))
        return self._check_rows(features, rows * columns, "patch")


@dataclass(frozen=True)
class PluginRegions:
    """An adapter for a mask source of another package.

    The wrapped object needs only `identity` and `labels(image, name)`. `labels` returns integers, either [H, W] or as
    in `Regions.labels`.

    Raises (from all methods):
        InputError: If the mask source fails, or returns a result that violates the `Regions` protocol.
        FileNotFoundError, MemoryError: If the mask source raises them.
    """

    name: str
    regions: Any

    @classmethod
    def made(cls, name: str, make: Callable[[], object]) -> PluginRegions:
        """Make a mask source, check that it has the required attributes, and return its adapter."""
        return cls(name, _make("mask source", name, make, ("identity", "labels")))

    @property
    def identity(self) -> dict[str, Any]:
        return _call("mask source", self.name, lambda: {"kind": self.name, **self.regions.identity})

    @property
    def chosen(self) -> tuple[int, ...]:
        return tuple(getattr(self.regions, "chosen", ()))

    @property
    def at_once(self) -> int:
        return getattr(self.regions, "at_once", 1)

    def files(self, name: str) -> tuple[Path, ...]:
        find = getattr(self.regions, "files", lambda name: ())
        return _call("mask source", self.name, lambda: tuple(find(name)))

    def labels(self, image: UInt8[Tensor, "h w 3"], name: str) -> Int32[Tensor, "levels depth h w"]:
        returned = _call("mask source", self.name, lambda: torch.as_tensor(self.regions.labels(image, name)))
        labels = returned[None, None] if returned.ndim == 2 else returned
        fits = labels.ndim == 4 and labels.shape[2:] == image.shape[:2] and labels.numel() > 0
        if not fits or labels.is_floating_point() or labels.is_complex():
            raise InputError(
                f"mask source {self.name!r} of another package returned {returned.dtype} {tuple(returned.shape)} for "
                f"an image of size {tuple(image.shape[:2])}, expected integers [H, W] or [levels, depth, H, W]; fix "
                "that package"
            )
        for level in labels:
            ids = level.unique()
            ids = ids[ids != -1]
            if not torch.equal(ids, torch.arange(len(ids), device=ids.device).to(ids.dtype)):
                raise InputError(
                    f"mask source {self.name!r} of another package returned ids in {int(level.min())}.."
                    f"{int(level.max())}, expected ids from 0 without gaps, and -1 for none; fix that package"
                )
        return labels.int()


def _make(noun: str, name: str, make: Callable[[], Any], needed: Sequence[str]) -> Any:
    """Make an object of another package; raise InputError if it lacks a required attribute."""
    plugin = _call(noun, name, make)
    missing = [x for x in needed if not hasattr(plugin, x)]
    if len(missing) > 0:
        raise InputError(f"{noun} {name!r} of another package lacks {' and '.join(missing)}; fix that package")
    return plugin


def _call(noun: str, name: str, function: Callable[[], _Result]) -> _Result:
    """Call a function of another package, and convert its unexpected exceptions to errors that name the plugin."""
    try:
        return function()
    except (InputError, FileNotFoundError, MemoryError, torch.OutOfMemoryError):
        raise
    except Exception as error:  # other packages can raise any exception
        raise InputError(
            f"{noun} {name!r} of another package failed ({summarize_error(error)}); fix that package"
        ) from error
