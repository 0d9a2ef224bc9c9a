"""gsplat's projection of the flat Gaussians of 2D Gaussian Splatting, with one thread per Gaussian and camera.

The arithmetic is that of gsplat 1.4.0's fully_fused_projection_2dgs_fwd.cu as nvcc 13.0 compiles it for sm_90; see
`kernels.projection`.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
import triton
import triton.language as tl
from jaxtyping import Bool, Float32
from torch import Tensor

from normlift_ns.kernels.projection import CAMERA, ProjectedSplats, camera_axis, dot

SPLAT_2D = 16
"""Number of values per splat: seven pairs, and two zeros as padding. The first values are the center u, v in pixels,
the first row of the transform and the opacity. The half width and half height of the square and the other two rows of
the transform follow. See `rasterization.projection.ProjectedGaussians2D`.
"""
_BLOCK = 128
_LEAST_EXTENT = tl.constexpr(1e-4)
"""Lower bound on the squared half extent of an ellipse of one standard deviation, in square pixels."""
_LARGEST_RADIUS = tl.constexpr(2147483648.0)


class Settings2D(NamedTuple):
    """Fields of `RasterSettings` that the projection uses."""

    near_plane: float
    far_plane: float
    radius_sigmas: float
    min_alpha: float


@triton.jit
def _world_axes(quats, scales, i, valid):
    """Return the first two columns of the rotation matrix and the first two scales."""
    w = tl.load(quats + 4 * i, mask=valid, other=1.0)
    x = tl.load(quats + 4 * i + 1, mask=valid, other=0.0)
    y = tl.load(quats + 4 * i + 2, mask=valid, other=0.0)
    z = tl.load(quats + 4 * i + 3, mask=valid, other=0.0)
    inverse = tl.rsqrt(tl.fma(w, w, dot(x, y, z, x, y, z)))
    x, y, z, w = x * inverse, y * inverse, z * inverse, w * inverse
    z2, wx, wy, wz = z * z, w * x, w * y, w * z
    ax, ay, az = 1.0 - 2.0 * (y * y + z2), 2.0 * tl.fma(x, y, wz), 2.0 * tl.fma(x, z, -wy)
    bx, by, bz = 2.0 * tl.fma(x, y, -wz), 1.0 - 2.0 * tl.fma(x, x, z2), 2.0 * tl.fma(y, z, wx)
    first = tl.load(scales + 3 * i, mask=valid, other=0.0)
    second = tl.load(scales + 3 * i + 1, mask=valid, other=0.0)
    return ax, ay, az, bx, by, bz, first, second


@triton.jit
def _rotated(camera, axis: tl.constexpr, ax, ay, az, bx, by, bz):
    """Return one camera coordinate of the vectors (ax, ay, az) and (bx, by, bz).

    As in gsplat, the terms of the first are added in the order x, y, z, and those of the second in the order y, x, z.
    """
    a, b, c = tl.load(camera + 4 * axis), tl.load(camera + 4 * axis + 1), tl.load(camera + 4 * axis + 2)
    return tl.fma(c, az, tl.fma(b, ay, a * ax)), dot(a, b, c, bx, by, bz)


@triton.jit
def _along_axis(last_a, last_b, last_c, a, b, c, inverse):
    """Return the center and the squared half extent of the projected ellipse along one axis of the image."""
    scaled_a, scaled_b, scaled_c = a * inverse, b * inverse, -(c * inverse)
    center = tl.fma(last_c, scaled_c, tl.fma(last_a, scaled_a, last_b * scaled_b))
    square = tl.fma(c, scaled_c, tl.fma(a, scaled_a, b * scaled_b))
    return center, tl.fma(center, center, -square)


@triton.jit(do_not_specialize=["count", "views", "width", "height"])
def _project(
    means, quats, scales, opacities, drawable, cameras, keys, out_visible, out_splat, out_depth, count, views,
    width, height, near_plane, far_plane, radius_sigmas, min_alpha,
    WRITE: tl.constexpr, CAMERA: tl.constexpr, SPLAT: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Mark the visible pairs of a Gaussian and a camera, or write the splats of the pairs in `keys`."""
    e = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = e < count
    key = e
    if WRITE:
        key = tl.load(keys + e, mask=inside, other=0)
    i = key // views
    valid = inside & (tl.load(drawable + i, mask=inside, other=0) != 0)
    camera = cameras + tl.where(inside, key - i * views, 0) * CAMERA  # every lane has its own camera
    x = tl.load(means + 3 * i, mask=valid, other=0.0)
    y = tl.load(means + 3 * i + 1, mask=valid, other=0.0)
    z = tl.load(means + 3 * i + 2, mask=valid, other=1.0)
    opacity = tl.load(opacities + i, mask=valid, other=0.0)
    xc, yc, depth = camera_axis(camera, 0, x, y, z), camera_axis(camera, 1, x, y, z), camera_axis(camera, 2, x, y, z)
    visible = valid & (depth >= near_plane) & (depth <= far_plane) & (opacity >= min_alpha)

    ax, ay, az, bx, by, bz, first, second = _world_axes(quats, scales, i, valid)
    a0, b0 = _rotated(camera, 0, ax, ay, az, bx, by, bz)
    a1, b1 = _rotated(camera, 1, ax, ay, az, bx, by, bz)
    a2, b2 = _rotated(camera, 2, ax, ay, az, bx, by, bz)
    a0, a1, a2, b0, b1, b2 = a0 * first, a1 * first, a2 * first, b0 * second, b1 * second, b2 * second
    fx, fy = tl.load(camera + 12), tl.load(camera + 13)
    cx, cy = tl.load(camera + 14), tl.load(camera + 15)
    u0, u1, u2 = tl.fma(a2, cx, a0 * fx), tl.fma(b2, cx, b0 * fx), tl.fma(depth, cx, xc * fx)
    v0, v1, v2 = tl.fma(a2, cy, a1 * fy), tl.fma(b2, cy, b1 * fy), tl.fma(depth, cy, yc * fy)

    distance = tl.fma(-depth, depth, tl.fma(a2, a2, b2 * b2))
    visible &= distance != 0
    inverse = 1.0 / tl.where(visible, distance, 1.0)
    u, extent_x = _along_axis(a2, b2, depth, u0, u1, u2, inverse)
    v, extent_y = _along_axis(a2, b2, depth, v0, v1, v2, inverse)
    extent = tl.maximum(tl.maximum(extent_x, extent_y).to(tl.float64), _LEAST_EXTENT)
    radius = tl.ceil(tl.sqrt(extent) * radius_sigmas).to(tl.float32)
    visible &= (u + radius > 0) & (u - radius < width) & (v + radius > 0) & (v - radius < height)
    if WRITE:
        radius = tl.minimum(radius, _LARGEST_RADIUS)
        row = out_splat + SPLAT * e
        tl.store(row, u, mask=inside)
        tl.store(row + 1, v, mask=inside)
        tl.store(row + 2, u0, mask=inside)
        tl.store(row + 3, u1, mask=inside)
        tl.store(row + 4, u2, mask=inside)
        tl.store(row + 5, opacity, mask=inside)
        tl.store(row + 6, radius, mask=inside)
        tl.store(row + 7, radius, mask=inside)
        tl.store(row + 8, v0, mask=inside)
        tl.store(row + 9, v1, mask=inside)
        tl.store(row + 10, v2, mask=inside)
        tl.store(row + 11, a2, mask=inside)
        tl.store(row + 12, b2, mask=inside)
        tl.store(row + 13, depth, mask=inside)
        tl.store(out_depth + e, depth, mask=inside)
    else:
        tl.store(out_visible + e, visible.to(tl.int8), mask=inside)


def project_gaussians_2d(
    means: Float32[Tensor, "n 3"],
    quats: Float32[Tensor, "n 4"],
    scales: Float32[Tensor, "n 3"],
    opacities: Float32[Tensor, " n"],
    drawable: Bool[Tensor, " n"],
    cameras: Float32[Tensor, "views 16"],
    width: int,
    height: int,
    rules: Settings2D,
) -> ProjectedSplats:
    """Project a 2D Gaussian Splatting scene into cameras of one size. Invisible Gaussians take one byte per view.

    Args:
        means: Centers of the Gaussians in world coordinates.
        quats: Rotations as quaternions (w, x, y, z) of any length above 0.
        scales: Standard deviations in world units; the third one is not used.
        opacities: Opacities in 0..1.
        drawable: Mask of the Gaussians to project.
        cameras: Values of every camera, as described at `CAMERA`.
        width: Width of the images in pixels.
        height: Height of the images in pixels.
        rules: Constants of the projection.
    """
    views, device = len(cameras), means.device
    pairs = len(means) * views
    scene = [x.contiguous() for x in (means, quats, scales, opacities)]
    flags = torch.empty(pairs, dtype=torch.bool, device=device)
    options = {"CAMERA": CAMERA, "SPLAT": SPLAT_2D, "BLOCK": _BLOCK, "num_warps": 4, "enable_fp_fusion": False}
    outputs = [flags.view(torch.int8), torch.empty(0, SPLAT_2D, device=device), torch.empty(0, device=device)]
    keys = torch.empty(0, dtype=torch.int64, device=device)
    sizes = (views, width, height, *rules)
    inputs = (*scene, drawable.view(torch.int8), cameras)
    if pairs > 0:
        _project[(triton.cdiv(pairs, _BLOCK),)](*inputs, keys, *outputs, pairs, *sizes, WRITE=False, **options)
        keys = flags.nonzero().squeeze(1)
    splats, depth = torch.zeros(len(keys), SPLAT_2D, device=device), torch.empty(len(keys), device=device)
    if len(keys) > 0:
        outputs[1:] = [splats, depth]
        _project[(triton.cdiv(len(keys), _BLOCK),)](*inputs, keys, *outputs, len(keys), *sizes, WRITE=True, **options)
    return ProjectedSplats(keys, splats, depth)
