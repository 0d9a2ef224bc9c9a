"""Photographs and their cameras, as camera files describe them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float

from normlift_ns.errors import InputError
from normlift_ns.scenes.image_files import check_mask, read_head

_SUFFIXES = (".png", ".jpg", ".jpeg", ".JPG", ".JPEG", ".PNG", ".webp", ".tif", ".tiff", ".bmp")
_RIGID = 1e-3
"""How far a rotation may be from orthonormal: files round."""


class Intrinsics(NamedTuple):
    """A camera's projection: a pinhole with OpenCV's distortion k1 k2 p1 p2 k3, in pixels."""

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    p1: float = 0.0
    p2: float = 0.0

    @property
    def distortion(self) -> tuple[float, float, float, float, float]:
        """k1, k2, k3, p1, p2."""
        return self[6:]

    def resized(self, width: int, height: int) -> Intrinsics:
        """Those of the same photograph at another size."""
        x, y = width / self.width, height / self.height
        return self._replace(
            fx=self.fx * x, fy=self.fy * y, cx=self.cx * x, cy=self.cy * y, width=width, height=height
        )  # fmt: skip


class World(NamedTuple):
    """A similarity p -> scale * (transform @ p) from the world of the cameras to that of a splat."""

    transform: Float[np.ndarray, "3 4"]
    """Rotation and translation."""
    scale: float
    single: bool = False
    """Computed in float32, as nerfstudio does: only so are the cameras those of its training, bit by bit."""


@dataclass(frozen=True)
class Frame:
    """One photograph and its camera."""

    file: Path
    """Absolute."""
    name: str
    """The file relative to the dataset, with forward slashes."""
    pose: Float[np.ndarray, "3 4"]
    """Camera to world in OpenGL convention: x right, y up, z backward."""
    intrinsics: Intrinsics
    mask: Path | None = None
    """Image of the same size, zero where a pixel does not count; absolute."""


def check_frames(frames: Sequence[Frame], source: Path) -> None:
    """Refuses cameras that no photograph can have.

    Raises:
        ValueError: no camera, numbers that are not finite, no focal length, a pose that is not rigid, names twice.
    """
    if len(frames) == 0:
        raise InputError(f"{source} has no cameras with photographs. Expected one for every image of the training.")
    for frame in frames:
        if not np.isfinite([*frame.pose.ravel(), *frame.intrinsics]).all():
            raise InputError(
                f"{source}: the camera of {frame.name} has numbers that are NaN or infinite. Expected finite ones; "
                "make the file again, or remove the image from it."
            )
        if min(frame.intrinsics[:2]) <= 0 or min(frame.intrinsics[4:6]) < 1:
            raise InputError(
                f"{source}: the camera of {frame.name} has focal lengths {frame.intrinsics.fx:g}, "
                f"{frame.intrinsics.fy:g} and size {frame.intrinsics.width} x {frame.intrinsics.height}. Expected "
                "positive numbers."
            )
        rotation = frame.pose[:, :3]
        if np.abs(rotation @ rotation.T - np.eye(3)).max() > _RIGID or np.linalg.det(rotation) < 0:
            raise InputError(
                f"{source}: the pose of {frame.name} is no rotation and translation. Expected a rigid camera-to-world "
                "matrix without scale or mirror."
            )
    names = [frame.name for frame in frames]
    twice = sorted({name for name in names if names.count(name) > 1}) if len(set(names)) < len(names) else []
    if twice:
        raise InputError(f"{source} names {twice[0]} more than once. Expected every photograph once.")


def find_photographs(names: Sequence[str], folder: Path, source: Path, advice: str, *, copies: bool) -> list[Path]:
    """The files of those names in a folder, absolute.

    Args:
        copies: whether the folder may hold copies of the photographs, so that names need not begin with their folders.
    Raises:
        FileNotFoundError: some are missing; the message counts them and names the first.
        ValueError: two names stand for one file.
    """
    found = [find_file(folder, name, copies=copies) for name in names]
    missing = [name for name, file in zip(names, found) if file is None]
    if missing:
        raise FileNotFoundError(
            f"{len(missing)} of the {len(names)} photographs that {source} names are not in {folder}, the first is "
            f"{missing[0]}. Put them back, or {advice}."
        )
    files = [file.absolute() for file in found if file is not None]
    if len(set(files)) < len(files):
        first = next(i for i, file in enumerate(files) if file in files[:i])
        raise InputError(
            f"{source} names {names[files.index(files[first])]} and {names[first]}, but in {folder} there is only "
            f"{files[first]} for both. Put the photographs into the folders that it names, or {advice}."
        )
    return files


def find_file(folder: Path, name: str, *, copies: bool) -> Path | None:
    """The file of that name in a folder, or of another suffix, as downscaled copies have.

    Args:
        copies: try it without its first folders too, as copies in images_2 lie.
    """
    path = Path(name)
    parts = path.parts[1:] if path.is_absolute() else path.parts
    places = [folder.joinpath(*parts[start:]) for start in range(len(parts))] if copies else [folder / path]
    for place in places:
        for file in (
            *(place.with_name(place.name + end) for end in ("", *_SUFFIXES)),
            *map(place.with_suffix, _SUFFIXES),
        ):
            if file.is_file():
                return file
    return None


def find_masks(names: Sequence[str], folder: Path) -> list[Path]:
    """The masks of photographs: name.jpg.png as COLMAP has it, or any image of the same stem.

    Raises:
        FileNotFoundError: one is missing.
    """
    masks = []
    for name in names:
        found = find_file(folder, f"{name}.png", copies=True) or find_file(folder, name, copies=True)
        if found is None:
            raise FileNotFoundError(
                f"There is no mask for {name} in {folder}. Expected {Path(name).name}.png or {Path(name).stem}.png for "
                "every photograph."
            )
        masks.append(found.absolute())
    return masks


def sized(frame: Frame, source: Path) -> Frame:
    """The frame with the intrinsics of the photograph as it lies on the disk, which may be a smaller copy.

    Raises:
        FileNotFoundError, ValueError: no such file, no image, one of another aspect than its camera.
    """
    width, height = read_head(frame.file).size
    camera = frame.intrinsics
    if (width, height) != (camera.width, camera.height):
        scale = (width / camera.width + height / camera.height) / 2
        if abs(camera.width * scale - width) > 1 or abs(camera.height * scale - height) > 1:
            raise InputError(
                f"{frame.file} is {width} x {height} pixels, but its camera in {source} {camera.width} x "
                f"{camera.height}: the aspect differs. Give the images that the cameras were computed from, or copies "
                "of them at a fraction of the size, with --images."
            )
        camera = camera.resized(width, height)
    if frame.mask is not None:
        check_mask(frame.mask, frame.file, (width, height))
    return replace(frame, intrinsics=camera)


def moved(frames: Sequence[Frame], world: World) -> list[Frame]:
    """The frames in another world."""
    kind = torch.float32 if world.single else torch.float64
    poses = torch.from_numpy(np.array([[*frame.pose, [0, 0, 0, 1]] for frame in frames])).to(kind)
    there = torch.from_numpy(world.transform).to(kind) @ poses  # all at once, as nerfstudio does: same roundings
    there[:, :, 3] *= world.scale
    return [replace(frame, pose=pose.double().numpy()) for frame, pose in zip(frames, there)]
