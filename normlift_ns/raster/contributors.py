"""Contributing Gaussians of pixels, with their compositing weights."""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float, Int, Int64
from torch import Tensor

from normlift_ns.core.evidence import MASKED
from normlift_ns.core.gaussians import Camera, GaussianScene
from normlift_ns.errors import InputError
from normlift_ns.options import BackendName, RasterizeMode
from normlift_ns.raster.rasterize import rasterize_evidence
from normlift_ns.raster.settings import RasterSettings


class Contributors(NamedTuple):
    """Gaussians that contribute to P pixels: entries offsets[p] to offsets[p + 1] belong to pixel p, nearest first.

    >>> import torch
    >>> result = Contributors(torch.tensor([0, 2, 3]), torch.tensor([4, 7, 4]), torch.tensor([0.5, 0.25, 0.9]))
    >>> result.gaussian[result.offsets[0] : result.offsets[1]].tolist()  # of the first pixel
    [4, 7]
    """

    offsets: Int64[Tensor, " p_plus_1"]
    gaussian: Int64[Tensor, " m"]
    """Rows of the scene."""
    weight: Float[Tensor, " m"]
    """Weights A_pj in 0..1; those of a pixel add up to its alpha."""


def contributors(
    scene: GaussianScene,
    camera: Camera,
    pixels: Int[Tensor, "p 2"],
    *,
    backend: BackendName = "auto",
    rasterize_mode: RasterizeMode = "classic",
    settings: RasterSettings | None = None,
    dtype: torch.dtype | None = None,
) -> Contributors:
    """Return the Gaussians that contribute to pixels, with their compositing weights A_pj (eq. 1 of the paper).

    The weights are exact: each pixel is a region of its own, and its evidence is returned. So the sum of A_pj over the
    pixels of a region is the region's evidence. The sum over j of A_pj times any value of the Gaussians is the result
    of `render` in the pixel.

    Args:
        scene: N Gaussians; those out of range (`GaussianScene.drawable`) contribute nothing.
        camera: Camera of the image.
        pixels: (column, row) from the upper left corner; a pixel may occur twice.
        backend: As in `rasterize_evidence`.
        rasterize_mode: As in `rasterize_evidence`.
        settings: As in `rasterize_evidence`.
        dtype: As in `rasterize_evidence`.

    Returns:
        One list per pixel, in the order of the pixels, on the device of the scene.

    Raises:
        ValueError: If the pixels are not integers or not in the image, or an option is unknown.

    >>> import torch
    >>> from normlift_ns import Camera, GaussianScene, contributors
    >>> means, quats = torch.tensor([[0.0, 0, 2], [0, 0, 1]]), torch.tensor([[1.0, 0, 0, 0]]).expand(2, 4)
    >>> scene = GaussianScene(means, quats, scales=torch.ones(2, 3), opacities=torch.tensor([0.5, 0.5]))
    >>> camera = Camera(torch.tensor([[1.0, 0, 0.5], [0, 1, 0.5], [0, 0, 1]]), torch.eye(4), width=1, height=1)
    >>> result = contributors(scene, camera, torch.tensor([[0, 0]]))
    >>> result.offsets.tolist(), result.gaussian.tolist(), result.weight.tolist()
    ([0, 2], [1, 0], [0.5, 0.25])
    """
    device = scene.means.device
    pixels = _check_pixels(pixels, camera).to(device)
    position, region = (pixels[:, 1] * camera.width + pixels[:, 0]).unique(return_inverse=True)
    labels = torch.full((camera.height * camera.width,), MASKED, dtype=torch.int32, device=device)
    labels[position] = torch.arange(len(position), dtype=torch.int32, device=device)
    options = {"backend": backend, "rasterize_mode": rasterize_mode, "settings": settings, "dtype": dtype}
    shape = (camera.height, camera.width)
    rows = rasterize_evidence(scene, [camera], [labels.view(shape)], num_regions=[len(position)], **options).rows
    pose = camera.world_to_camera.to(scene.means)
    depth = scene.means @ pose[2, :3] + pose[2, 3]
    gaussian, column = rows.row_index(), rows.column.long()
    order = depth[gaussian].argsort(stable=True)
    order = order[column[order].argsort(stable=True)]
    bounds = torch.searchsorted(column[order], torch.arange(len(position) + 1, device=device))
    start, count = bounds[:-1][region], bounds.diff()[region]
    offsets = torch.cat([count.new_zeros(1), count.cumsum(0)])
    entry = torch.arange(int(offsets[-1]), device=device) + (start - offsets[:-1]).repeat_interleave(count)
    return Contributors(offsets, gaussian[order[entry]], rows.weight[order[entry]])


def _check_pixels(pixels: Tensor, camera: Camera) -> Int64[Tensor, "p 2"]:
    if pixels.ndim != 2 or pixels.shape[1] != 2 or pixels.dtype.is_floating_point or pixels.dtype == torch.bool:
        raise InputError(f"pixels must be integers [P, 2], (column, row), got {pixels.dtype} {tuple(pixels.shape)}")
    size = pixels.new_tensor([camera.width, camera.height])
    outside = ((pixels < 0) | (pixels >= size)).any(dim=1).nonzero()
    if len(outside) > 0:
        first = int(outside[0])
        raise InputError(
            f"pixels[{first}] is {tuple(pixels[first].tolist())}, but the camera has {camera.width} columns and "
            f"{camera.height} rows, counted from 0"
        )
    return pixels.long()
