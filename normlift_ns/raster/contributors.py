"""Which Gaussians make up a pixel, and with which weight."""

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
    """What P pixels are made of: those of pixel p are entries offsets[p] to offsets[p + 1], the nearest first.

    >>> import torch
    >>> found = Contributors(torch.tensor([0, 2, 3]), torch.tensor([4, 7, 4]), torch.tensor([0.5, 0.25, 0.9]))
    >>> found.gaussian[found.offsets[0] : found.offsets[1]].tolist()  # of the first pixel
    [4, 7]
    """

    offsets: Int64[Tensor, " p_plus_1"]
    gaussian: Int64[Tensor, " m"]
    """Rows of the scene."""
    weight: Float[Tensor, " m"]
    """A_pj, in 0..1; those of a pixel add up to its alpha."""


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
    """The Gaussians that contribute to some pixels, with their compositing weights A_pj (eq. 1 of the paper).

    They are exact: the evidence of regions of one pixel each, so that A_pj summed over the pixels of a region is its
    evidence, and A_pj times any value of the Gaussians summed over j is what `render` draws in the pixel.

    Args:
        scene: N Gaussians; those out of range (`GaussianScene.drawable`) contribute nothing.
        pixels: (column, row) from the upper left corner; one may be named twice.
        backend: as in `rasterize_evidence`.
        rasterize_mode: likewise.
        settings: likewise.
        dtype: likewise.
    Returns:
        One list per pixel, in the order of the pixels, on the device of the scene.
    Raises:
        ValueError: pixels that are no whole numbers or not in the image, an unknown option.

    >>> import torch
    >>> from normlift_ns import Camera, GaussianScene, contributors
    >>> means, quats = torch.tensor([[0.0, 0, 2], [0, 0, 1]]), torch.tensor([[1.0, 0, 0, 0]]).expand(2, 4)
    >>> scene = GaussianScene(means, quats, scales=torch.ones(2, 3), opacities=torch.tensor([0.5, 0.5]))
    >>> camera = Camera(torch.tensor([[1.0, 0, 0.5], [0, 1, 0.5], [0, 0, 1]]), torch.eye(4), width=1, height=1)
    >>> found = contributors(scene, camera, torch.tensor([[0, 0]]))
    >>> found.offsets.tolist(), found.gaussian.tolist(), found.weight.tolist()
    ([0, 2], [1, 0], [0.5, 0.25])
    """
    device = scene.means.device
    pixels = _checked(pixels, camera).to(device)
    place, region = (pixels[:, 1] * camera.width + pixels[:, 0]).unique(return_inverse=True)
    labels = torch.full((camera.height * camera.width,), MASKED, dtype=torch.int32, device=device)
    labels[place] = torch.arange(len(place), dtype=torch.int32, device=device)
    how = {"backend": backend, "rasterize_mode": rasterize_mode, "settings": settings, "dtype": dtype}
    shape = (camera.height, camera.width)
    rows = rasterize_evidence(scene, [camera], [labels.view(shape)], num_regions=[len(place)], **how).rows
    pose = camera.world_to_camera.to(scene.means)
    depth = scene.means @ pose[2, :3] + pose[2, 3]
    gaussian, column = rows.row_index(), rows.column.long()
    order = depth[gaussian].argsort(stable=True)
    order = order[column[order].argsort(stable=True)]
    bounds = torch.searchsorted(column[order], torch.arange(len(place) + 1, device=device))
    start, count = bounds[:-1][region], bounds.diff()[region]
    offsets = torch.cat([count.new_zeros(1), count.cumsum(0)])
    entry = torch.arange(int(offsets[-1]), device=device) + (start - offsets[:-1]).repeat_interleave(count)
    return Contributors(offsets, gaussian[order[entry]], rows.weight[order[entry]])


def _checked(pixels: Tensor, camera: Camera) -> Int64[Tensor, "p 2"]:
    if pixels.ndim != 2 or pixels.shape[1] != 2 or pixels.dtype.is_floating_point or pixels.dtype == torch.bool:
        raise InputError(
            f"pixels must be whole numbers [P, 2], (column, row), got {pixels.dtype} {tuple(pixels.shape)}"
        )
    size = pixels.new_tensor([camera.width, camera.height])
    outside = ((pixels < 0) | (pixels >= size)).any(dim=1).nonzero()
    if len(outside) > 0:
        first = int(outside[0])
        raise InputError(
            f"pixels[{first}] is {tuple(pixels[first].tolist())}, but the camera has {camera.width} columns and "
            f"{camera.height} rows, counted from 0"
        )
    return pixels.long()
