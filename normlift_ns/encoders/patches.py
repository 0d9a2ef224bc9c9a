"""Dense features without masks: every patch of a vision transformer is a region with its own feature."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np
import torch
from jaxtyping import Float32, Int32, UInt8
from torch import Tensor

from normlift_ns.encoders.batches import Batches
from normlift_ns.encoders.regions import resample_nearest
from normlift_ns.encoders.source import Encoder, ViewFeatures, check_image
from normlift_ns.errors import InputError


class DenseEncoder(Encoder, Protocol):
    """An encoder that also has features of patches."""

    @property
    def why_not_dense(self) -> str | None:
        """The reason that this network has no features of patches, and what to do; None if it has them."""
        ...

    def patches(self, image: UInt8[Tensor, "h w 3"], rows: int, columns: int) -> Float32[Tensor, "r d"]:
        """Return one unit row per patch of a grid over the image, row by row, on the CPU.

        Raises:
            FileNotFoundError, ValueError: As `Encoder.encode`.
        """
        ...


@dataclass(frozen=True)
class PatchFeatures:
    """A `FeatureSource` of patches.

    Raises:
        ValueError: If the network has no features of patches, or the count is below 1.
    """

    encoder: DenseEncoder
    """Encodes the patches and the prompts."""
    count: int = 1024
    """Approximate number of patches per image, at least 1."""

    def __post_init__(self) -> None:
        if self.count < 1:
            raise InputError(f"number of regions per image must be at least 1, got {self.count}")
        reason = self.encoder.why_not_dense
        if reason is not None:
            raise InputError(reason)

    @property
    def identity(self) -> dict[str, Any]:
        return {"kind": "patches", "count": self.count, "encoder": self.encoder.identity}

    def available(self, names: Sequence[str]) -> list[str]:
        return list(names)

    def view(self, image: UInt8[Tensor, "h w 3"], name: str) -> ViewFeatures:
        """Return the regions and features of one image; raises as `features`."""
        return ViewFeatures(self.labels(image), self.features(image, name))

    def labels(self, image: UInt8[Tensor, "h w 3"]) -> Int32[Tensor, "h w"]:
        """Return the nearest patch of every pixel, numbered row by row."""
        height, width = image.shape[:2]
        rows, columns = patch_grid(height, width, self.count)
        patches = np.arange(rows * columns, dtype=np.int32).reshape(1, rows, columns)
        return torch.from_numpy(resample_nearest(patches, height, width)[0])

    def features(self, image: UInt8[Tensor, "h w 3"], name: str) -> Float32[Tensor, "r d"]:
        """Return one unit row per patch.

        Raises:
            FileNotFoundError: If the weights cannot be downloaded.
            ValueError: If the image is invalid, or the weight file is damaged or of another architecture.
            MemoryError: If the image does not fit into the memory of the device.
        """
        check_image(image, name)
        rows, columns = patch_grid(image.shape[0], image.shape[1], self.count)
        return next(self._batches(lambda batch: self.encoder.patches(batch[0], rows, columns), image[None]))

    def text(self, prompts: Sequence[str]) -> Float32[Tensor, "q d"]:
        return self.encoder.text(prompts)

    @cached_property
    def _batches(self) -> Batches:
        return Batches(1)


def patch_grid(height: int, width: int, count: int) -> tuple[int, int]:
    """Return rows and columns of about `count` squares in an image, none smaller than a pixel.

    >>> patch_grid(960, 540, 1024)
    (43, 24)
    """
    side = max(1.0, math.sqrt(height * width / count))
    return max(1, round(height / side)), max(1, round(width / side))


def scaled(image: UInt8[Tensor, "h w 3"], height: int, width: int) -> Float32[Tensor, "1 3 y x"]:
    """Return the image at another size, in 0..255: bicubic interpolation, with antialiasing when it shrinks."""
    pixels = image.permute(2, 0, 1)[None].float()
    size = height, width
    return torch.nn.functional.interpolate(pixels, size, mode="bicubic", antialias=True, align_corners=False).clamp(
        0, 255
    )
