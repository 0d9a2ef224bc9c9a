"""Interface of a trained splat and its images, independent of their file formats."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from normlift_ns.core.arguments import check_arguments
from normlift_ns.core.gaussians import Camera, GaussianScene
from normlift_ns.options import RasterizeMode

_TOLERANCE = 1e-5
"""Relative tolerance within which two numbers of a camera summary count as equal. A tenth of it is added as an absolute
tolerance, for numbers near zero."""


@check_arguments
class View(NamedTuple):
    """An image with its camera.

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
    mask: Bool[Tensor, "mask_h mask_w"] | None  # readers check its size, to name the file in the error
    """True at pixels to use, or None to use all pixels."""
    name: str
    """Path of the image file relative to the dataset, with forward slashes."""
    original: tuple[int, int] | None = None
    """Width and height of the image before undistortion, or None if it was not undistorted."""

    @check_arguments
    def downscaled(self, height: int, width: int) -> View:
        """Downscale the image by averaging pixels, and adapt its camera.

        A pixel of the mask is True only if the mask is True at all averaged pixels.
        """
        camera = self.camera
        scale = torch.tensor([[width / camera.width], [height / camera.height], [1.0]], dtype=camera.K.dtype)

        def averaged(image: Tensor) -> Tensor:
            channels = image.permute(2, 0, 1)[None].float()
            return torch.nn.functional.interpolate(channels, (height, width), mode="area")[0].permute(1, 2, 0)

        mask = None if self.mask is None else averaged(self.mask[:, :, None])[:, :, 0] > 0.999
        smaller = Camera(camera.K * scale, camera.world_to_camera, width, height)
        return self._replace(camera=smaller, image=averaged(self.image).round().to(torch.uint8), mask=mask)


@runtime_checkable
class Views(Protocol):
    """Undistorted images of a scene with their cameras. Each image is read on access."""

    @property
    def names(self) -> Sequence[str]:
        """Paths of the images relative to the dataset, with forward slashes."""
        ...

    @property
    def cameras(self) -> Sequence[Camera]:
        """Cameras of the images, in the order of `names`. No image is read."""
        ...

    def __len__(self) -> int: ...

    def __getitem__(self, index: int, /) -> View:
        """Read one image.

        Raises:
            FileNotFoundError, ValueError: If the file is missing or cannot be read. The message names the file.
        """
        ...


@runtime_checkable
class Scene(Protocol):
    """A trained splat and the images that it was trained on.

    >>> from normlift_ns import Scene, open_scene
    >>> scene = open_scene(config)
    >>> isinstance(scene, Scene), scene.rasterize_mode, scene.train[1].name
    (True, 'classic', 'images/0001.png')
    >>> len(scene.colors(scene.train.cameras[1])) == len(scene.gaussians)
    True
    """

    @property
    def name(self) -> str:
        """Name of the scene, under which its runs are stored."""
        ...

    @property
    def checkpoint_path(self) -> Path:
        """File that the Gaussians were read from."""
        ...

    @property
    def runs_dir(self) -> Path:
        """Default directory for lifted runs of the scene."""
        ...

    @property
    def identity(self) -> Mapping[str, Any]:
        """Source of the scene as JSON-ready metadata, for the manifest of a lifted run."""
        ...

    @property
    def gaussians(self) -> GaussianScene:
        """All N Gaussians, with activated parameters."""
        ...

    @property
    def rasterize_mode(self) -> RasterizeMode:
        """Rasterization mode that was used in training, and that a lift should also use."""
        ...

    @property
    def train(self) -> Views:
        """Training images, with the cameras that the Gaussians were optimized for."""
        ...

    @property
    def held_out(self) -> Views:
        """Images held out for evaluation."""
        ...

    @property
    def background(self) -> Float[Tensor, " 3"]:
        """Background color as RGB in 0..1."""
        ...

    @property
    def remarks(self) -> tuple[str, ...]:
        """Notes for the user about the files, in full sentences."""
        ...

    @property
    def renderer(self) -> Callable[[Camera], UInt8[Tensor, "h w 3"]] | None:
        """Renderer of the scene, or None if normlift_ns renders `colors` on `background`."""
        ...

    def colors(self, camera: Camera) -> Float[Tensor, "n 3"]:
        """Return the view-dependent RGB of every Gaussian, >= 0."""
        ...

    @property
    def parameters(self) -> Mapping[str, Tensor]:
        """Trained parameters by name, as in a checkpoint. They are means [N, 3], quats [N, 4], scales [N, 3]
        (logarithms), opacities [N, 1] (logits), features_dc [N, 3] and features_rest [N, K, 3]."""
        ...

    @property
    def has_harmonics(self) -> bool:
        """True if colors are spherical harmonics; False if `features_dc` holds logits."""
        ...


def camera_summary(cameras: Sequence[Camera]) -> list[float]:
    """Summarize cameras as a list of numbers for a manifest.

    The list contains the number of cameras, and weighted means of size, intrinsics and pose. The weights increase from
    1 for the first camera to 2 for the last, so that the order of the cameras also matters.

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
    weight = torch.linspace(1, 2, len(rows), dtype=torch.float64)
    return [float(len(rows)), *(weight[:, None] * torch.stack(rows)).sum(0).div(weight.sum()).tolist()]


def cameras_differ(first: Sequence[float], second: Sequence[float]) -> bool:
    """Return True if two camera summaries differ by more than rounding.

    >>> cameras_differ([2.0, 16.0], [2.0, 16.00001]), cameras_differ([2.0, 16.0], [2.0, 16.01])
    (False, True)
    """
    return len(first) != len(second) or any(abs(a - b) > _TOLERANCE * (abs(a) + 0.1) for a, b in zip(first, second))
