"""What the application knows of a trained splat and its photographs, wherever they come from."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from normlift_ns.core.gaussians import Camera, GaussianScene
from normlift_ns.options import RasterizeMode

_SAME = 1e-5
"""Relative difference of numbers of cameras that are the same but for rounding: a tenth of it is taken absolutely, for
numbers near zero."""


class View(NamedTuple):
    """One photograph.

    >>> import torch
    >>> from normlift_ns import Camera, View
    >>> camera = Camera(torch.tensor([[100.0, 0, 80], [0, 100, 60], [0, 0, 1]]), torch.eye(4), width=160, height=120)
    >>> image = torch.full((120, 160, 3), 255, dtype=torch.uint8)
    >>> view = View(camera, image, mask=None, name="images/0000.png")
    >>> view.name, tuple(view.image.shape) == (view.camera.height, view.camera.width, 3)
    ('images/0000.png', True)
    """

    camera: Camera
    image: UInt8[Tensor, "h w 3"]
    mask: Bool[Tensor, "h w"] | None
    """True where the pixel counts; None: everywhere."""
    name: str
    """Image file relative to the dataset, with forward slashes."""
    original: tuple[int, int] | None = None
    """Width and height of the photograph before it was undistorted; None: it was not."""


@runtime_checkable
class Views(Protocol):
    """Photographs as the scene was trained on them, undistorted; each is read when it is asked for."""

    @property
    def names(self) -> Sequence[str]:
        """Of the images, relative to the dataset, with forward slashes."""
        ...

    @property
    def cameras(self) -> Sequence[Camera]:
        """Of the images, in the same order; asking for them reads no image."""
        ...

    def __len__(self) -> int: ...

    def __getitem__(self, index: int, /) -> View:
        """Reads one photograph.

        Raises:
            FileNotFoundError, ValueError: a file that is missing or cannot be read; the message names it.
        """
        ...


@runtime_checkable
class Scene(Protocol):
    """A trained splat and the photographs that it was trained with.

    >>> from normlift_ns import Scene, open_scene
    >>> scene = open_scene(config)
    >>> isinstance(scene, Scene), scene.rasterize_mode, scene.train[1].name
    (True, 'classic', 'images/0001.png')
    >>> len(scene.colors(scene.train.cameras[1])) == len(scene.gaussians)
    True
    """

    @property
    def name(self) -> str:
        """What runs of it are filed under."""
        ...

    @property
    def checkpoint_path(self) -> Path:
        """The file that the Gaussians come from."""
        ...

    @property
    def runs_dir(self) -> Path:
        """Where lifted runs of it go by default."""
        ...

    @property
    def identity(self) -> Mapping[str, Any]:
        """Where the scene comes from, ready for JSON; it stands in the manifest of a lifted run."""
        ...

    @property
    def gaussians(self) -> GaussianScene:
        """The N Gaussians, activated; none left out."""
        ...

    @property
    def rasterize_mode(self) -> RasterizeMode:
        """How the scene was rasterized in its training; lifts must do the same."""
        ...

    @property
    def train(self) -> Views:
        """Photographs of the training, with the cameras that the Gaussians fit."""
        ...

    @property
    def held_out(self) -> Views:
        """Photographs kept for evaluation."""
        ...

    @property
    def background(self) -> Float[Tensor, " 3"]:
        """RGB in 0..1 behind the Gaussians."""
        ...

    @property
    def remarks(self) -> tuple[str, ...]:
        """What a person should know of the files, in whole sentences."""
        ...

    @property
    def renderer(self) -> Callable[[Camera], UInt8[Tensor, "h w 3"]] | None:
        """A renderer of the scene's own; None: that of normlift_ns, with `colors` on `background`."""
        ...

    def colors(self, camera: Camera) -> Float[Tensor, "n 3"]:
        """RGB >= 0 of every Gaussian as the camera sees it."""
        ...

    @property
    def parameters(self) -> Mapping[str, Tensor]:
        """What was trained, as a checkpoint holds it: means [N, 3], quats [N, 4], scales [N, 3] (logarithms), opacities
        [N, 1] (logits), features_dc [N, 3] and features_rest [N, K, 3]."""
        ...

    @property
    def has_harmonics(self) -> bool:
        """Whether colours are spherical harmonics; False: features_dc are logits."""
        ...


def camera_summary(cameras: Sequence[Camera]) -> list[float]:
    """A few numbers that change with every camera, and with their order: how many there are, and weighted means of
    size, intrinsics and pose, of which later cameras have more. For manifests.

    >>> import torch
    >>> left = Camera(torch.tensor([[50.0, 0, 8], [0, 50, 6], [0, 0, 1]]), torch.eye(4), 16, 12)
    >>> camera_summary([left, left])[:5]
    [2.0, 16.0, 12.0, 50.0, 0.0]
    """
    if len(cameras) == 0:
        return [0.0]
    rows = [
        torch.cat([torch.tensor([c.width, c.height], dtype=torch.float64), c.K.double().flatten().cpu(),
                   c.world_to_camera[:3].double().flatten().cpu()])
        for c in cameras
    ]  # fmt: skip
    share = torch.linspace(1, 2, len(rows), dtype=torch.float64)
    return [float(len(rows)), *(share[:, None] * torch.stack(rows)).sum(0).div(share.sum()).tolist()]


def cameras_differ(first: Sequence[float], second: Sequence[float]) -> bool:
    """Whether two summaries are of different cameras, for more than rounding.

    >>> cameras_differ([2.0, 16.0], [2.0, 16.00001]), cameras_differ([2.0, 16.0], [2.0, 16.01])
    (False, True)
    """
    return len(first) != len(second) or any(abs(a - b) > _SAME * (abs(a) + 0.1) for a, b in zip(first, second))
