"""Where 2D semantics come from: an image becomes labelled regions with one unit feature each, a text a unit vector.

The two concerns are kept apart. `Regions` cuts an image into pieces, an `Encoder` puts pieces and texts into one space,
`RegionFeatures` joins one of each to a `FeatureSource`, which is all that the rest of the package knows. Whatever
brings labels and features together, as the importer of a preprocessed data set does, is a `FeatureSource` of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import torch
from jaxtyping import Float32, Int32, UInt8
from torch import Tensor


@dataclass(frozen=True)
class ViewFeatures:
    """The 2D semantics of one image, on the CPU.

    Raises:
        ValueError: wrong types or shapes, a label without a feature row, rows that are not unit vectors.
    """

    labels: Int32[Tensor, "h w"]
    """Region of every pixel, in -1..R-1; -1: none."""
    features: Float32[Tensor, "r d"]
    """One unit row per region."""

    def __post_init__(self) -> None:
        for name, dtype in (("labels", torch.int32), ("features", torch.float32)):
            value: Tensor = getattr(self, name)
            if value.ndim != 2 or value.dtype != dtype or value.device.type != "cpu":
                raise ValueError(
                    f"ViewFeatures.{name} must be a {dtype} matrix on the CPU, got {value.dtype} "
                    f"{tuple(value.shape)} on {value.device}"
                )
        if self.labels.numel() > 0 and not -1 <= int(self.labels.min()) <= int(self.labels.max()) < len(self.features):
            raise ValueError(
                f"ViewFeatures.labels must be in -1..{len(self.features) - 1} (one feature row per region), found "
                f"{int(self.labels.min())}..{int(self.labels.max())}"
            )
        length = torch.linalg.vector_norm(self.features.double(), dim=1)
        bad = (~((length - 1).abs() < 1e-3)).nonzero().squeeze(1)
        if bad.numel() > 0:
            first = int(bad[0])
            raise ValueError(
                f"{bad.numel()} of {len(self.features)} rows of ViewFeatures.features are not unit vectors (row "
                f"{first} has length {length[first]:.3g}); normalise them, and label regions without a feature -1"
            )


class FeatureSource(Protocol):
    """2D semantics of images, and texts in the same space."""

    @property
    def identity(self) -> dict[str, Any]:
        """Every setting that changes the result, ready for JSON: part of cache keys and of the manifest.

        Device and precision are left out: they change rounding only.
        """
        ...

    def files(self, name: str) -> tuple[Path, ...]:
        """The files beside the image that `view` reads for it: their content belongs to cache keys."""
        ...

    def view(self, image: UInt8[Tensor, "h w 3"], name: str) -> ViewFeatures:
        """Regions and features of one image.

        Args:
            image: RGB, 0..255.
            name: path of the image relative to its dataset, such as "images/0001.jpg".
        Raises:
            ValueError, FileNotFoundError: with what was found, what was expected and what to do.
        """
        ...

    def text(self, prompts: Sequence[str]) -> Float32[Tensor, "q d"]:
        """One unit row per prompt, on the CPU.

        Raises:
            ValueError: no prompt, an empty one, or one that the encoder does not understand.
        """
        ...


class Regions(Protocol):
    """A rule that cuts images into regions."""

    @property
    def identity(self) -> dict[str, Any]:
        """As in `FeatureSource`."""
        ...

    def files(self, name: str) -> tuple[Path, ...]:
        """As in `FeatureSource`."""
        ...

    def labels(self, image: UInt8[Tensor, "h w 3"], name: str) -> Int32[Tensor, "h w"]:
        """Region of every pixel; ids 0..R-1 without gaps, -1 for none."""
        ...


class Encoder(Protocol):
    """A joint space of image regions and texts."""

    @property
    def identity(self) -> dict[str, Any]:
        """As in `FeatureSource`."""
        ...

    def encode(self, image: UInt8[Tensor, "h w 3"], labels: Int32[Tensor, "h w"]) -> Float32[Tensor, "r d"]:
        """One unit row per region, on the CPU; `labels` as `Regions.labels` returns them."""
        ...

    def text(self, prompts: Sequence[str]) -> Float32[Tensor, "q d"]:
        """As in `FeatureSource`."""
        ...


@dataclass(frozen=True)
class RegionFeatures:
    """A `FeatureSource` made of regions and an encoder."""

    regions: Regions
    encoder: Encoder

    @property
    def identity(self) -> dict[str, Any]:
        return {"regions": self.regions.identity, "encoder": self.encoder.identity}

    def files(self, name: str) -> tuple[Path, ...]:
        return self.regions.files(name)

    def view(self, image: UInt8[Tensor, "h w 3"], name: str) -> ViewFeatures:
        if image.ndim != 3 or image.shape[2] != 3 or image.dtype != torch.uint8 or image.numel() == 0:
            raise ValueError(
                f"image {name} must be a uint8 tensor [H, W, 3] (RGB, 0..255), got {image.dtype} {tuple(image.shape)}"
            )
        image = image.cpu()
        labels = self.regions.labels(image, name)
        return ViewFeatures(labels, self.encoder.encode(image, labels))

    def text(self, prompts: Sequence[str]) -> Float32[Tensor, "q d"]:
        return self.encoder.text(prompts)


def check_prompts(prompts: Sequence[str]) -> None:
    """Raises ValueError unless `prompts` is a list of at least one text, none of them empty."""
    if isinstance(prompts, str):
        raise ValueError(f"prompts must be a list of texts, got the single text {prompts!r}; write [{prompts!r}]")
    if len(prompts) == 0:
        raise ValueError('no text given; name at least one thing to look for, such as --text "orange"')
    empty = [i for i, prompt in enumerate(prompts) if not prompt.strip()]
    if len(empty) > 0:
        raise ValueError(
            f"text {empty[0] + 1} of {len(prompts)} is empty ({prompts[empty[0]]!r}); remove it, or say what to look "
            "for in words"
        )
