"""Dataset splits: images and cameras for training and evaluation."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int, Int64
from torch import Tensor

from normlift_ns.errors import InputError
from normlift_ns.scenes.nerfstudio.data_classes import ColmapDataParserConfig, NerfstudioDataParserConfig


@dataclass(frozen=True)
class Photographs:
    """One split of a dataset: V image files and their cameras, before undistortion."""

    files: list[Path]
    masks: list[Path] | None
    kind: str
    """PERSPECTIVE, FISHEYE or another of nerfstudio's camera types."""
    poses: Float[Tensor, "v 3 4"]
    intrinsics: Float[Tensor, "v 4"]
    """fx, fy, cx, cy."""
    sizes: Int64[Tensor, "v 2"]
    """Width, height."""
    distortion: Float[Tensor, "v k"] | None

    def __len__(self) -> int:
        return len(self.files)

    def select(self, indices: Int[np.ndarray, " m"]) -> Photographs:
        """Return the images and cameras at these indices."""
        rows = torch.tensor(indices, dtype=torch.long)
        return Photographs(
            [self.files[i] for i in indices],
            None if self.masks is None else [self.masks[i] for i in indices],
            self.kind,
            self.poses[rows],
            self.intrinsics[rows],
            self.sizes[rows],
            None if self.distortion is None else self.distortion[rows],
        )

    def resized(self, factor: float, rounding: str = "floor") -> Photographs:
        """Return the split with cameras for resized images, like nerfstudio's `rescale_output_resolution`."""
        scale = torch.tensor([factor])
        sides = self.sizes * scale
        if rounding == "round":
            sides = torch.floor(0.5 + sides)
        elif rounding == "ceil":
            sides = torch.ceil(sides)
        return Photographs(
            self.files, self.masks, self.kind, self.poses, self.intrinsics * scale, sides.to(torch.int64),
            self.distortion,
        )  # fmt: skip


@dataclass(frozen=True)
class Dataset:
    """Result of a data parser."""

    train: Photographs
    held_out: Photographs
    transform: Float[Tensor, "3 4"]
    scale: float
    """Map from the poses in the capture to the scene's world: scale * (transform @ point)."""


def split_by_mode(
    files: Sequence[Path], parser: NerfstudioDataParserConfig | ColmapDataParserConfig
) -> tuple[Any, Any]:
    """Return the indices of the training and the evaluation images by the parser's eval_mode.

    Raises:
        ValueError: if eval_mode is filename and a file name does not tell its split.
    """
    indices = np.arange(len(files))
    if parser.eval_mode == "fraction":
        count = math.ceil(len(files) * parser.train_split_fraction)
        trained = np.linspace(0, len(files) - 1, count, dtype=int)
        return trained, np.setdiff1d(indices, trained)
    if parser.eval_mode == "interval":
        is_eval = indices % parser.eval_interval == 0
        return indices[~is_eval], indices[is_eval]
    if parser.eval_mode == "all":
        return indices, indices
    for file in files:
        if "train" not in file.name and "eval" not in file.name:
            raise InputError(f"eval_mode is filename, but {file.name} has neither train nor eval in its name")
    is_train = np.array(["train" in file.name for file in files], dtype=bool)
    return indices[is_train], indices[~is_train]


def split_by_lists(lists: Mapping[str, Any], files: Sequence[Path]) -> tuple[Any, Any] | None:
    """Return the indices of the training and the evaluation images from the dataset's lists; None if it has none.

    Raises:
        ValueError: if only one of the train and test lists exists, or a listed file is missing.
    """
    if all(names is None for names in lists.values()):
        return None
    splits = []
    for split in ("train", "test"):
        names = lists[split]
        if names is None:
            raise InputError(f"the dataset's list of filenames for split {split} is missing")
        unknown = sorted(map(str, set(names) - set(files)))
        if unknown:
            raise InputError(f"some filenames for split {split} were not found, the first is {unknown[0]}")
        listed = set(names)
        splits.append(np.array([i for i, file in enumerate(files) if file in listed], dtype=np.int32))
    return splits[0], splits[1]
