"""Photographs of a data set, and which of them a run was trained on."""

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
    """One split of a data set: V files and their cameras, before undistortion."""

    files: list[Path]
    masks: list[Path] | None
    kind: str
    """PERSPECTIVE, FISHEYE or another of nerfstudio's camera types."""
    poses: Float[Tensor, "v 3 4"]
    projections: Float[Tensor, "v 4"]
    """fx, fy, cx, cy."""
    sizes: Int64[Tensor, "v 2"]
    """Width, height."""
    distortion: Float[Tensor, "v k"] | None

    def __len__(self) -> int:
        return len(self.files)

    def only(self, indices: Int[np.ndarray, " m"]) -> Photographs:
        """Some of them."""
        rows = torch.tensor(indices, dtype=torch.long)
        return Photographs(
            [self.files[i] for i in indices],
            None if self.masks is None else [self.masks[i] for i in indices],
            self.kind,
            self.poses[rows],
            self.projections[rows],
            self.sizes[rows],
            None if self.distortion is None else self.distortion[rows],
        )

    def resized(self, factor: float, rounding: str = "floor") -> Photographs:
        """With the cameras of smaller copies: nerfstudio's `rescale_output_resolution`."""
        scale = torch.tensor([factor])
        sides = self.sizes * scale
        if rounding == "round":
            sides = torch.floor(0.5 + sides)
        elif rounding == "ceil":
            sides = torch.ceil(sides)
        return Photographs(
            self.files, self.masks, self.kind, self.poses, self.projections * scale, sides.to(torch.int64),
            self.distortion,
        )  # fmt: skip


@dataclass(frozen=True)
class Dataset:
    """What a data parser says."""

    train: Photographs
    held_out: Photographs
    transform: Float[Tensor, "3 4"]
    scale: float
    """From the poses in the capture to the scene's world: scale * (transform @ point)."""


def split_by_mode(
    files: Sequence[Path], parser: NerfstudioDataParserConfig | ColmapDataParserConfig
) -> tuple[Any, Any]:
    """Which photographs were trained on, and which were kept for evaluation.

    Raises:
        ValueError: names that should say it and do not.
    """
    everything = np.arange(len(files))
    if parser.eval_mode == "fraction":
        count = math.ceil(len(files) * parser.train_split_fraction)
        trained = np.linspace(0, len(files) - 1, count, dtype=int)
        return trained, np.setdiff1d(everything, trained)
    if parser.eval_mode == "interval":
        kept = everything % parser.eval_interval == 0
        return everything[~kept], everything[kept]
    if parser.eval_mode == "all":
        return everything, everything
    for file in files:
        if "train" not in file.name and "eval" not in file.name:
            raise InputError(f"eval_mode is filename, but {file.name} has neither train nor eval in its name")
    trains = np.array(["train" in file.name for file in files], dtype=bool)
    return everything[trains], everything[~trains]


def split_by_lists(lists: Mapping[str, Any], files: Sequence[Path]) -> tuple[Any, Any] | None:
    """The same, where the data set says it itself for train and test; None where it does not.

    Raises:
        ValueError: a list of one of the two alone, or one that names what is not there.
    """
    if all(names is None for names in lists.values()):
        return None
    found = []
    for split in ("train", "test"):
        names = lists[split]
        if names is None:
            raise InputError(f"the dataset's list of filenames for split {split} is missing")
        strange = sorted(map(str, set(names) - set(files)))
        if strange:
            raise InputError(f"some filenames for split {split} were not found, the first is {strange[0]}")
        wanted = set(names)
        found.append(np.array([i for i, file in enumerate(files) if file in wanted], dtype=np.int32))
    return found[0], found[1]
