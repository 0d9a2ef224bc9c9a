"""Projection of Gaussians into cameras as in gsplat, with one thread per Gaussian or visible splat.

The arithmetic is that of gsplat 1.4.0's fully_fused_projection_fwd.cu as nvcc 13.0 compiles it for sm_90 with gsplat's
flags (-O3 --use_fast_math). The code rounds and fuses the same products as that machine code. Other fused
operations are disabled. Divisions, square roots and reciprocals are the approximate versions of both compilers. All
numbers are therefore equal bit for bit, except those with a magnitude below 2 ** -126.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
import triton
import triton.language as tl
from jaxtyping import Bool, Float32, Int64
from torch import Tensor

CAMERA = 16
"""Number of values per camera: three rows (r, r, r, t) of its pose, then fx, fy, cx and cy."""
SPLAT = 8
"""Number of values per splat, which are read as four pairs.

The values are the center u, v in pixels, then half of xx, half of yy, and xy of the inverse covariance. The last values
are the opacity, and the half width and half height of the rectangle in pixels.
"""
_BLOCK = 128
_ENORMOUS = tl.constexpr(2.0**60)
"""Covariance in square pixels above which determinants are computed in larger units to avoid overflow."""
_LARGEST = tl.constexpr(3.4028234e38)


class ProjectionSettings(NamedTuple):
    """Fields of `RasterSettings` that the projection uses."""

    near_plane: float
    far_plane: float
    eps2d: float
    frustum_margin: float
    min_discriminant: float
    min_compensation: float
    radius_sigmas: float
    min_alpha: float


class ProjectedSplats(NamedTuple):
    """Visible Gaussians of all cameras, as splats."""

    keys: Int64[Tensor, " m"]
    """Keys gaussian * views + view, ascending."""
    splats: Float32[Tensor, "m values"]
    """Values described at `SPLAT`, or for 2D Gaussian Splatting at `SPLAT_2D`."""
    depth: Float32[Tensor, " m"]


@triton.jit
def camera_axis(camera, axis: tl.constexpr, x, y, z):
    """Return one camera coordinate of the points (x, y, z), rounded as CUDA rounds R p + t."""
    a, b = tl.load(camera + 4 * axis), tl.load(camera + 4 * axis + 1)
    c, t = tl.load(camera + 4 * axis + 2), tl.load(camera + 4 * axis + 3)
    return tl.fma(z, c, tl.fma(x, a, b * y)) + t


@triton.jit
def dot(ax, ay, az, bx, by, bz):
    """Return the scalar product of two vectors, rounded as in gsplat."""
    return tl.fma(az, bz, tl.fma(ax, bx, ay * by))


@triton.jit
def _covariance(quats, scales, i, valid):
    """Return the covariance R diag(scale ** 2) R^T as xx, xy, xz, yy, yz, zz."""
    w = tl.load(quats + 4 * i, mask=valid, other=1.0)
    x = tl.load(quats + 4 * i + 1, mask=valid, other=0.0)
    y = tl.load(quats + 4 * i + 2, mask=valid, other=0.0)
    z = tl.load(quats + 4 * i + 3, mask=valid, other=0.0)
    sx = tl.load(scales + 3 * i, mask=valid, other=0.0)
    sy = tl.load(scales + 3 * i + 1, mask=valid, other=0.0)
    sz = tl.load(scales + 3 * i + 2, mask=valid, other=0.0)
    inverse = tl.rsqrt(tl.fma(w, w, dot(x, y, z, x, y, z)))
    x, y, z, w = x * inverse, y * inverse, z * inverse, w * inverse
    y2, z2, wx, wy, wz = y * y, z * z, w * x, w * y, w * z
    ax = (1.0 - 2.0 * (y2 + z2)) * sx
    ay, az = 2.0 * tl.fma(x, y, -wz) * sy, 2.0 * tl.fma(x, z, wy) * sz
    bx, by, bz = 2.0 * tl.fma(x, y, wz) * sx, (1.0 - 2.0 * tl.fma(x, x, z2)) * sy, 2.0 * tl.fma(y, z, -wx) * sz
    cx, cy, cz = 2.0 * tl.fma(x, z, -wy) * sx, 2.0 * tl.fma(y, z, wx) * sy, (1.0 - 2.0 * tl.fma(x, x, y2)) * sz
    return (
        dot(ax, ay, az, ax, ay, az),
        dot(ax, ay, az, bx, by, bz),
        dot(ax, ay, az, cx, cy, cz),
        dot(bx, by, bz, bx, by, bz),
        dot(bx, by, bz, cx, cy, cz),
        dot(cx, cy, cz, cx, cy, cz),
    )


@triton.jit
def _row_times(a, b, c, xx, xy, xz, yy, yz, zz):
    """Return a row of the pose times the covariance; the last entry is summed in a different order, as in gsplat."""
    return dot(a, b, c, xx, xy, xz), dot(a, b, c, xy, yy, yz), tl.fma(c, zz, tl.fma(b, yz, a * xz))


@triton.jit
def _rotate_covariance(camera, xx, xy, xz, yy, yz, zz):
    """Return the nine entries of the covariance C in camera axes, row by row. C_ij and C_ji are rounded differently."""
    a, b, c = tl.load(camera), tl.load(camera + 1), tl.load(camera + 2)
    d, e, f = tl.load(camera + 4), tl.load(camera + 5), tl.load(camera + 6)
    g, h, k = tl.load(camera + 8), tl.load(camera + 9), tl.load(camera + 10)
    x0, x1, x2 = _row_times(a, b, c, xx, xy, xz, yy, yz, zz)
    y0, y1, y2 = _row_times(d, e, f, xx, xy, xz, yy, yz, zz)
    z0, z1, z2 = _row_times(g, h, k, xx, xy, xz, yy, yz, zz)
    return (
        dot(x0, x1, x2, a, b, c), dot(x0, x1, x2, d, e, f), dot(x0, x1, x2, g, h, k),
        dot(y0, y1, y2, a, b, c), dot(y0, y1, y2, d, e, f), dot(y0, y1, y2, g, h, k),
        dot(z0, z1, z2, a, b, c), dot(z0, z1, z2, d, e, f), dot(z0, z1, z2, g, h, k),
    )  # fmt: skip


@triton.jit
def _splat(
    camera, width, height, x, y, z, xx, xy, xz, yy, yz, zz, opacity,
    near_plane, far_plane, eps2d, frustum_margin, min_discriminant, min_compensation, radius_sigmas, min_alpha,
    ANTIALIASED: tl.constexpr, PER_AXIS: tl.constexpr,
):  # fmt: skip
    """Return visibility, u, v, conic (xx, xy, yy), opacity, half width, half height and depth of a splat."""
    fx, fy = tl.load(camera + 12), tl.load(camera + 13)
    cx, cy = tl.load(camera + 14), tl.load(camera + 15)
    xc, yc, depth = camera_axis(camera, 0, x, y, z), camera_axis(camera, 1, x, y, z), camera_axis(camera, 2, x, y, z)
    visible = (depth >= near_plane) & (depth <= far_plane)
    zc = tl.where(visible, depth, 1.0)
    c00, c01, c02, c10, c11, c12, c20, c21, c22 = _rotate_covariance(camera, xx, xy, xz, yy, yz, zz)

    half_x, half_y = 0.5 * width / fx, 0.5 * height / fy
    rz = 1.0 / zc
    low, high = tl.fma(half_x, frustum_margin, cx / fx), tl.fma(half_x, frustum_margin, (width - cx) / fx)
    tx = zc * tl.minimum(high, tl.maximum(-low, xc * rz))
    low, high = tl.fma(half_y, frustum_margin, cy / fy), tl.fma(half_y, frustum_margin, (height - cy) / fy)
    ty = zc * tl.minimum(high, tl.maximum(-low, yc * rz))
    # The Jacobian is (jx, 0, -jxz), (0, jy, -jyz).
    jx, jy, jxz, jyz = fx * rz, fy * rz, rz * rz * (fx * tx), rz * rz * (fy * ty)
    p0, q0 = tl.fma(-c20, jxz, c00 * jx), tl.fma(-c20, jyz, c10 * jy)
    p1, q1 = tl.fma(-c21, jxz, c01 * jx), tl.fma(-c21, jyz, c11 * jy)
    p2, q2 = tl.fma(-c22, jxz, c02 * jx), tl.fma(-c22, jyz, c12 * jy)
    a, b = tl.fma(jxz, -p2, jx * p0), tl.fma(jxz, -q2, jx * q0)
    b_again, c = tl.fma(jyz, -p2, jy * p1), tl.fma(jyz, -q2, jy * q1)

    unit = tl.where(tl.maximum(a, c) > _ENORMOUS, 1.0 / _ENORMOUS, 1.0)
    a, b, b_again, c = unit * a, unit * b, unit * b_again, unit * c
    square = b_again * b
    sharp = tl.fma(c, a, -square)
    a, c = a + unit * eps2d, c + unit * eps2d
    det = tl.fma(c, a, -square)
    visible &= det > 0
    det = tl.where(visible, det, 1.0)
    inverse = 1.0 / det
    if ANTIALIASED:
        opacity *= tl.sqrt(tl.maximum(min_compensation * min_compensation, sharp * inverse))
    conic_x, conic_xy, conic_y = unit * (c * inverse), unit * (-b * inverse), unit * (a * inverse)
    visible &= (tl.abs(conic_x) <= _LARGEST) & (tl.abs(conic_xy) <= _LARGEST) & (tl.abs(conic_y) <= _LARGEST)

    if PER_AXIS:
        visible &= opacity >= min_alpha
        reach = tl.sqrt(2.0 * tl.log(tl.maximum(opacity / min_alpha, 1.0)))
        sigmas = tl.minimum(radius_sigmas, reach)
        half_width, half_height = tl.ceil(sigmas * tl.sqrt(a / unit)), tl.ceil(sigmas * tl.sqrt(c / unit))
        visible &= (half_width > 0) & (half_height > 0)
    else:
        mean = 0.5 * (a + c)
        larger = mean + tl.sqrt(tl.maximum(unit * unit * min_discriminant, tl.fma(mean, mean, -det)))
        half_width = tl.ceil(radius_sigmas * tl.sqrt(larger / unit))
        half_height = half_width
    visible &= (half_width <= _LARGEST) & (half_height <= _LARGEST)
    u, v = tl.fma(rz, fx * xc, cx), tl.fma(rz, fy * yc, cy)
    visible &= (u + half_width > 0) & (u - half_width < width) & (v + half_height > 0) & (v - half_height < height)
    return visible, u, v, conic_x, conic_xy, conic_y, opacity, half_width, half_height, depth


@triton.jit(do_not_specialize=["gaussians", "views", "width", "height"])
def _find_visible(
    means, quats, scales, opacities, drawable, cameras, out, gaussians, views, width, height,
    near_plane, far_plane, eps2d, frustum_margin, min_discriminant, min_compensation, radius_sigmas, min_alpha,
    ANTIALIASED: tl.constexpr, PER_AXIS: tl.constexpr, CAMERA: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Write 1 to out[gaussian, view] if the Gaussian can be visible with an opacity of at least min_alpha, else 0."""
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = i < gaussians
    valid = tl.load(drawable + i, mask=inside, other=0) != 0
    x = tl.load(means + 3 * i, mask=valid, other=0.0)
    y = tl.load(means + 3 * i + 1, mask=valid, other=0.0)
    z = tl.load(means + 3 * i + 2, mask=valid, other=0.0)
    opacity = tl.load(opacities + i, mask=valid, other=0.0)
    xx, xy, xz, yy, yz, zz = _covariance(quats, scales, i, valid)
    for view in range(views):
        visible, _, _, _, _, _, scaled_opacity, _, _, _ = _splat(
            cameras + view * CAMERA, width, height, x, y, z, xx, xy, xz, yy, yz, zz, opacity,
            near_plane, far_plane, eps2d, frustum_margin, min_discriminant, min_compensation, radius_sigmas, min_alpha,
            ANTIALIASED, PER_AXIS,
        )  # fmt: skip
        tl.store(out + i * views + view, (visible & valid & (scaled_opacity >= min_alpha)).to(tl.int8), mask=inside)


@triton.jit(do_not_specialize=["count", "views", "width", "height"])
def _project_visible(
    means, quats, scales, opacities, cameras, keys, out_splat, out_depth, count, views, width, height,
    near_plane, far_plane, eps2d, frustum_margin, min_discriminant, min_compensation, radius_sigmas, min_alpha,
    ANTIALIASED: tl.constexpr, PER_AXIS: tl.constexpr, CAMERA: tl.constexpr, SPLAT: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    e = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    valid = e < count
    key = tl.load(keys + e, mask=valid, other=0)
    i = key // views
    # Every lane has a different camera.
    camera = cameras + (key - i * views) * CAMERA
    x = tl.load(means + 3 * i, mask=valid, other=0.0)
    y = tl.load(means + 3 * i + 1, mask=valid, other=0.0)
    z = tl.load(means + 3 * i + 2, mask=valid, other=1.0)
    opacity = tl.load(opacities + i, mask=valid, other=0.0)
    xx, xy, xz, yy, yz, zz = _covariance(quats, scales, i, valid)
    _, u, v, a, b, c, opacity, half_width, half_height, depth = _splat(
        camera, width, height, x, y, z, xx, xy, xz, yy, yz, zz, opacity,
        near_plane, far_plane, eps2d, frustum_margin, min_discriminant, min_compensation, radius_sigmas, min_alpha,
        ANTIALIASED, PER_AXIS,
    )  # fmt: skip
    row = out_splat + SPLAT * e
    tl.store(row, u, mask=valid)
    tl.store(row + 1, v, mask=valid)
    tl.store(row + 2, 0.5 * a, mask=valid)
    tl.store(row + 3, 0.5 * c, mask=valid)
    tl.store(row + 4, b, mask=valid)
    tl.store(row + 5, opacity, mask=valid)
    tl.store(row + 6, half_width, mask=valid)
    tl.store(row + 7, half_height, mask=valid)
    tl.store(out_depth + e, depth, mask=valid)


def project_gaussians(
    means: Float32[Tensor, "n 3"],
    quats: Float32[Tensor, "n 4"],
    scales: Float32[Tensor, "n 3"],
    opacities: Float32[Tensor, " n"],
    drawable: Bool[Tensor, " n"],
    cameras: Float32[Tensor, "views 16"],
    width: int,
    height: int,
    rules: ProjectionSettings,
    *,
    antialiased: bool,
    per_axis: bool,
) -> ProjectedSplats:
    """Project a scene into cameras of one size. Invisible Gaussians take only one byte per view.

    Args:
        means: Centers of the Gaussians in world coordinates.
        quats: Rotations as quaternions (w, x, y, z) of any length above 0.
        scales: Standard deviations in world units.
        opacities: Opacities in 0..1.
        drawable: Mask of the Gaussians to project.
        cameras: Values of every camera, as described at `CAMERA`.
        width: Width of the images in pixels.
        height: Height of the images in pixels.
        rules: Constants of the projection.
        antialiased: Scale opacities as splatfacto does with rasterize_mode "antialiased".
        per_axis: Use rectangles as in gsplat 1.5 and later, instead of squares.
    """
    views, n, device = len(cameras), len(means), means.device
    scene = [x.contiguous() for x in (means, quats, scales, opacities)]
    flags = torch.empty(n * views, dtype=torch.bool, device=device)
    options = {"ANTIALIASED": antialiased, "PER_AXIS": per_axis, "CAMERA": CAMERA, "BLOCK": _BLOCK, "num_warps": 4}
    options["enable_fp_fusion"] = False
    if n > 0:
        _find_visible[(triton.cdiv(n, _BLOCK),)](
            *scene, drawable.view(torch.int8), cameras, flags.view(torch.int8), n, views, width, height, *rules,
            **options,
        )  # fmt: skip
    keys = flags.nonzero().squeeze(1)
    splats = torch.empty(len(keys), SPLAT, device=device)
    depth = torch.empty(len(keys), device=device)
    if len(keys) > 0:
        _project_visible[(triton.cdiv(len(keys), _BLOCK),)](
            *scene, cameras, keys, splats, depth, len(keys), views, width, height, *rules, SPLAT=SPLAT, **options
        )
    return ProjectedSplats(keys, splats, depth)
