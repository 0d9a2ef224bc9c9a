"""Photographs that were taken after the training, whose cameras a new reconstruction knows beside the old ones."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from normlift_ns.core.gaussians import Camera
from normlift_ns.core.scene import View, Views
from normlift_ns.errors import InputError
from normlift_ns.options import SplatOptions
from normlift_ns.scenes.cameras import Cameras, read_camera_file
from normlift_ns.scenes.frames import Frame, World, check_frames, moved
from normlift_ns.scenes.nerfstudio.load import NerfstudioScene
from normlift_ns.scenes.opening import SplatScene
from normlift_ns.scenes.photographs import PhotographViews
from normlift_ns.scenes.transforms import read_transforms, relative_name

ADDED_FILE = "added_photographs.json"
"""Of a lifted run of nerfstudio: cameras of the added photographs, in the world of its Gaussians."""
_MOST_MOVED, _MOST_TURNED = 1e-3, 0.1
"""How far an old camera may be from where it was: a share of the extent of all cameras, and degrees."""
_Scene = TypeVar("_Scene", NerfstudioScene, SplatScene)


class _Together:
    """`Views`: some, and others after them."""

    def __init__(self, *parts: Views) -> None:
        self._parts = parts
        self.names = [name for part in parts for name in part.names]
        self.cameras = [camera for part in parts for camera in part.cameras]

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, index: int, /) -> View:
        if not -len(self) <= index < len(self):
            raise IndexError(f"view {index} of {len(self)}")
        index %= len(self)
        first, *_ = self._parts
        return first[index] if index < len(first) else self._parts[1][index - len(first)]


def add_photographs(scene: _Scene, cameras: Path, images: Path | None = None) -> _Scene:
    """The scene, with photographs among its training views that it was not trained with.

    The file of cameras must hold photographs of the scene too: their names tell which are new, and their cameras where
    its world lies in that of the scene. Photographs that the training held out are not new.

    Args:
        cameras: folder of a COLMAP project, or a transforms.json, with old and new photographs.
        images: folder of the photographs; None: as `SplatOptions.images`.
    Raises:
        FileNotFoundError, ValueError: as `open_splat`; no new photograph, fewer than two old ones, or old cameras that
            have moved among each other; the message names the photograph.
    """
    path = cameras.absolute()
    of_transforms = path.suffix == ".json" or (path / "transforms.json").is_file()
    options = (
        SplatOptions(transforms=path, images=images) if of_transforms else SplatOptions(colmap=path, images=images)
    )
    found = read_camera_file(options, f"take them out of {path}")
    known = _known(scene)
    new = [frame for frame in found.frames if _key(frame.name) not in known]
    if len(new) == 0:
        raise InputError(
            f"{found.source} names no photograph that {scene.name} was not trained with. Give the file of cameras in "
            "which new photographs stand beside the old ones, or leave --add-images out."
        )
    world = _world(found, known)
    base = scene.photographs if isinstance(scene, SplatScene) else scene.location.folder
    placed = [replace(frame, name=relative_name(frame.file, base)) for frame in moved(new, world)]
    placed.sort(key=lambda frame: frame.file)  # as they are found in a lifted run
    identity = {**scene.identity, "added_photographs": [frame.name for frame in placed]}
    return replace(with_frames(scene, placed), identity=identity)


def with_frames(scene: _Scene, frames: Sequence[Frame]) -> _Scene:
    """The scene, with photographs among its training views whose cameras are in its world.

    Raises:
        FileNotFoundError, ValueError: a photograph that is missing or cannot be read.
    """
    views = PhotographViews(frames, scene.background)
    remarks = (*scene.remarks, *views.check_files())
    if isinstance(scene, SplatScene):
        together = sorted([*scene.train.frames, *frames], key=lambda frame: frame.file)
        return replace(scene, train=PhotographViews(together, scene.background), remarks=remarks)
    return replace(scene, train=_Together(scene.train, views), remarks=remarks, added=tuple(frames))


def with_saved(scene: NerfstudioScene, run_dir: Path) -> NerfstudioScene:
    """The scene of a lifted run, with the photographs that were added to it.

    Raises:
        FileNotFoundError, ValueError: a file that is missing or damaged; the message names it.
    """
    path = run_dir / ADDED_FILE
    if not path.is_file():
        return scene
    found = read_transforms(path, base=scene.location.folder, advice="put them back, or lift without --add-images")
    check_frames(found.frames, path)
    return with_frames(scene, found.frames)


def _key(name: str) -> str:
    """What is the same of a photograph in every file of cameras: its name without the folder of all, images/ or
    images_4/.

    >>> _key("images_4/left/0001.jpg"), _key("0001.jpg")
    ('left/0001.jpg', '0001.jpg')
    """
    first, *rest = PurePosixPath(name).parts
    return "/".join(rest) if len(rest) > 0 and first.startswith("images") else name


def _known(scene: NerfstudioScene | SplatScene) -> dict[str, Camera]:
    views = (scene.train, scene.held_out)
    return {_key(name): camera for part in views for name, camera in zip(part.names, part.cameras)}


def _world(found: Cameras, known: dict[str, Camera]) -> World:
    """From the world of the file to that of the scene, by the cameras that both have.

    Raises:
        ValueError: fewer than two, or some that have moved among each other.
    """
    old = [frame for frame in found.frames if _key(frame.name) in known]
    there = np.stack([frame.pose for frame in old]) if len(old) > 0 else np.zeros((0, 3, 4))
    here = np.array([_opengl(known[_key(frame.name)]).numpy() for frame in old]).reshape(-1, 3, 4)
    first, second = (poses[:, :, 3] - poses[:, :, 3].sum(axis=0) / max(1, len(old)) for poses in (there, here))
    extent = float(np.linalg.norm(second, axis=1).max(initial=0.0))
    if len(old) < 2 or extent == 0 or not np.linalg.norm(first) > 0:
        raise InputError(
            f"{found.source} has {len(old)} of the {len(known)} photographs of the scene, such as {next(iter(known))}. "
            "Expected two at different places at least, which tell where the new cameras are. Give the file of cameras "
            "in which new photographs stand beside the old ones."
        )
    left, _, right = np.linalg.svd(np.einsum("vij,vkj->ik", here[:, :, :3], there[:, :, :3]))
    rotation = left @ np.diag([1, 1, np.sign(np.linalg.det(left @ right))]) @ right
    scale = float((second * (first @ rotation.T)).sum() / (first**2).sum())
    shift = here[:, :, 3].mean(axis=0) - scale * rotation @ there[:, :, 3].mean(axis=0)
    gaps = np.linalg.norm(scale * there[:, :, 3] @ rotation.T + shift - here[:, :, 3], axis=1) / extent
    cosines = (np.einsum("ij,vjk,vik->v", rotation, there[:, :, :3], here[:, :, :3]) - 1) / 2
    turns = np.degrees(np.arccos(cosines.clip(-1, 1)))
    worst = int(np.argmax(np.maximum(gaps / _MOST_MOVED, turns / _MOST_TURNED)))
    if not (gaps[worst] <= _MOST_MOVED and turns[worst] <= _MOST_TURNED and 0 < scale < math.inf):
        raise InputError(
            f"The worlds differ: in {found.source} the camera of {old[worst].name} is not where it was in the training "
            f"(off by {gaps[worst]:.2%} of the extent of the cameras and {turns[worst]:.2g} degrees; {len(old)} old "
            f"photographs were compared). Register new photographs without moving old ones (COLMAP: "
            "image_registrator on the old model, no bundle adjustment); cameras that the training itself optimised "
            "have moved, too."
        )
    return World(np.concatenate([rotation, shift[:, None] / scale], axis=1), scale)


def _opengl(camera: Camera) -> Float[Tensor, "3 4"]:
    """Camera to world, x right, y up, z backward, of a camera."""
    pose = torch.linalg.inv(camera.world_to_camera.double())[:3]
    return pose * pose.new_tensor([1.0, -1.0, -1.0, 1.0])
