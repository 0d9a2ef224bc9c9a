"""Projection and tile lists of Gaussians as in gsplat, and the reference rasterizer in torch.

The gsplat sources are utils.cuh and isect_tiles.cu.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Float64, Int, Int32, Int64
from torch import Tensor

from normlift_ns.core.evidence import UNLABELED, Entries
from normlift_ns.core.gaussians import Camera, GaussianScene
from normlift_ns.core.sparse import row_offsets, sum_duplicates
from normlift_ns.rasterization.settings import RasterSettings

_ENORMOUS = 2.0**60
"""Covariance in square pixels above which covariances are multiplied by 1 / _ENORMOUS."""


class PreparedGaussians(NamedTuple):
    """Drawable Gaussians of a scene with their covariances, for any camera."""

    gaussian: Int64[Tensor, " m"]
    """Indices of the Gaussians in the scene."""
    means: Float[Tensor, "m 3"]
    """Centers in the precision of the scene, because rounding would change the drawing order."""
    covariances: Float[Tensor, "m 3 3"]
    opacities: Float[Tensor, " m"]


class ProjectedGaussians(NamedTuple):
    """Visible Gaussians of one camera, nearest first."""

    gaussian: Int64[Tensor, " m"]
    """Indices of the Gaussians in the scene."""
    means2d: Float[Tensor, "m 2"]
    conics: Float[Tensor, "m 3"]
    """Entries xx, xy and yy of the inverse covariance, in 1 / pixels^2."""
    opacities: Float[Tensor, " m"]
    radii: Float[Tensor, "m 2"]
    """Half width and half height of the rectangle that selects tiles, in whole pixels."""

    def exponents(
        self, members: Int64[Tensor, " k"], x: Float[Tensor, " w"], y: Float[Tensor, " h"]
    ) -> Float[Tensor, "h w k"]:
        """Return -log(alpha / opacity) of some Gaussians at the pixel centers (x, y)."""
        dx, dy = self.means2d[members, 0] - x[None, :, None], self.means2d[members, 1] - y[:, None, None]
        a, b, c = self.conics[members].unbind(1)
        return 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy


class PreparedGaussians2D(NamedTuple):
    """The drawable Gaussians of a 2D Gaussian Splatting scene, prepared for any camera."""

    gaussian: Int64[Tensor, " m"]
    """Indices of the Gaussians in the scene."""
    means: Float[Tensor, "m 3"]
    """Centers in the precision of the scene, because rounding would change the drawing order."""
    axes: Float64[Tensor, "m 3 2"]
    """The two axes in the plane of each Gaussian, scaled by the standard deviations along them."""
    opacities: Float[Tensor, " m"]


class ProjectedGaussians2D(NamedTuple):
    """Visible 2D Gaussians of one camera, nearest first."""

    gaussian: Int64[Tensor, " m"]
    """Indices of the Gaussians in the scene."""
    means2d: Float[Tensor, "m 2"]
    """Centers of the projected ellipses of one standard deviation."""
    transforms: Float[Tensor, "m 3 3"]
    """Matrices from (a, b, 1), with a and b in standard deviations along the axes, to homogeneous pixel coordinates."""
    opacities: Float[Tensor, " m"]
    radii: Float[Tensor, "m 2"]
    """Half width and half height of the square that selects the tiles, in whole pixels."""

    def exponents(
        self, members: Int64[Tensor, " k"], x: Float[Tensor, " w"], y: Float[Tensor, " h"]
    ) -> Float[Tensor, "h w k"]:
        """Return -log(alpha / opacity) of some Gaussians at the pixel centers (x, y); inf for planes seen edge-on.

        This is half the square of the smaller of two distances. The first is the distance in standard deviations from
        the center to the point where the ray of the pixel meets the plane. The second is sqrt(2) times the distance of
        the pixel from `means2d`, in pixels.
        """
        rows = self.transforms[members]
        across, down = x[:, None, None] * rows[:, 2] - rows[:, 0], y[:, None, None] * rows[:, 2] - rows[:, 1]
        a, b, c = torch.linalg.cross(across[None], down[:, None]).unbind(3)
        in_plane = (a / c).square() + (b / c).square()
        center = self.means2d[members]
        in_image = 2 * ((center[:, 0] - x[:, None]).square()[None] + (center[:, 1] - y[:, None]).square()[:, None])
        return torch.where(c == 0, torch.inf, 0.5 * torch.minimum(in_plane, in_image))


AnyPrepared = PreparedGaussians | PreparedGaussians2D
AnyProjected = ProjectedGaussians | ProjectedGaussians2D


class TileLists(NamedTuple):
    """Lists of the Gaussians of every tile, with tiles numbered row by row.

    Tile t contains the rows indices[offsets[t]:offsets[t + 1]] of `ProjectedGaussians`, nearest first.
    """

    offsets: Int64[Tensor, " tiles_plus_1"]
    indices: Int32[Tensor, " intersections"]


def prepare_gaussians(scene: GaussianScene, dtype: torch.dtype) -> PreparedGaussians:
    """Return the drawable Gaussians with their covariances R diag(scale ** 2) R^T."""
    gaussian = scene.drawable.nonzero().squeeze(1)
    quats, scales, opacities = (x[gaussian].to(dtype) for x in (scene.quats, scene.scales, scene.opacities))
    half = rotation_matrices(quats) * scales[:, None, :]
    return PreparedGaussians(gaussian, scene.means[gaussian], half @ half.transpose(1, 2), opacities)


def prepare_gaussians_2d(scene: GaussianScene, dtype: torch.dtype) -> PreparedGaussians2D:
    """Return the drawable Gaussians with the axes of their planes."""
    gaussian = scene.drawable.nonzero().squeeze(1)
    axes = rotation_matrices(scene.quats[gaussian].double())[:, :, :2] * scene.scales[gaussian, None, :2].double()
    return PreparedGaussians2D(gaussian, scene.means[gaussian], axes, scene.opacities[gaussian].to(dtype))


def rotation_matrices(quats: Float[Tensor, "n 4"]) -> Float[Tensor, "n 3 3"]:
    """Return the rotation matrices of quaternions (w, x, y, z) of any length > 0."""
    w, x, y, z = (quats / torch.linalg.vector_norm(quats, dim=1, keepdim=True)).unbind(1)
    return torch.stack(
        [
            torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], 1),
            torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], 1),
            torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], 1),
        ],
        1,
    )


def project(
    world: PreparedGaussians, camera: Camera, settings: RasterSettings, antialiased: bool
) -> ProjectedGaussians:
    """Project Gaussians, blur them by eps2d, drop invisible ones, and sort by depth and then by index.

    Args:
        world: Gaussians.
        camera: Camera of the image.
        settings: Constants of the rasterizer.
        antialiased: Scale opacities by sqrt(det(covariance) / det(blurred covariance)), as splatfacto does with
            rasterize_mode "antialiased".
    """
    dtype, device = world.opacities.dtype, world.opacities.device
    pose = camera.world_to_camera.to(device)
    fx, _, cx, _, fy, cy, *_ = camera.K.double().flatten().tolist()
    width, height = camera.width, camera.height
    near = _between_planes(world, camera, settings)
    means, rotation = world.means[near].to(dtype), pose[:3, :3].to(dtype)
    x, y, z = (_camera_axis(means, row) for row in pose[:3])

    margin_x, margin_y = settings.frustum_margin * 0.5 * width / fx, settings.frustum_margin * 0.5 * height / fy
    tx = z * (x / z).clamp(-cx / fx - margin_x, (width - cx) / fx + margin_x)
    ty = z * (y / z).clamp(-cy / fy - margin_y, (height - cy) / fy + margin_y)
    zero = torch.zeros_like(z)
    jacobian = torch.stack(
        [torch.stack([fx / z, zero, -fx * tx / z**2], 1), torch.stack([zero, fy / z, -fy * ty / z**2], 1)], 1
    )
    to_image = jacobian @ rotation
    covariance = to_image @ world.covariances[near] @ to_image.transpose(1, 2)
    # Scale down enormous covariances, whose determinants would overflow float32. Powers of two do not cause rounding.
    unit = torch.where(covariance.diagonal(dim1=1, dim2=2).amax(dim=1) > _ENORMOUS, 1 / _ENORMOUS, 1.0).to(dtype)
    a, b, c = (unit * x for x in (covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]))
    det_sharp = a * c - b * b
    a, c = a + unit * settings.eps2d, c + unit * settings.eps2d
    det = a * c - b * b
    opacities = world.opacities[near]
    if antialiased:
        opacities = opacities * (det_sharp / det).clamp(min=settings.min_compensation**2).sqrt()

    if settings.per_axis:
        # Alpha >= min_alpha up to this number of standard deviations. If it is NaN, the Gaussian is dropped.
        sigmas = (2 * (opacities / settings.min_alpha).log()).sqrt().clamp(max=settings.radius_sigmas)
        radii = (sigmas[:, None] * (torch.stack([a, c], 1) / unit[:, None]).sqrt()).ceil()
    else:
        mean = 0.5 * (a + c)
        larger = mean + torch.maximum(mean * mean - det, unit * unit * settings.min_discriminant).sqrt()
        radii = (settings.radius_sigmas * (larger / unit).sqrt()).ceil()[:, None].expand(-1, 2)
    u, v = fx * x / z + cx, fy * y / z + cy
    means2d = torch.stack([u, v], 1)
    conics = unit[:, None] * (torch.stack([c, -b, a], 1) / det[:, None])
    visible = (det > 0) & _touch_image(means2d, radii, camera) & conics.isfinite().all(1)
    visible = visible.nonzero().squeeze(1)
    return ProjectedGaussians(
        world.gaussian[near[visible]], means2d[visible], conics[visible], opacities[visible], radii[visible]
    )


_LEAST_EXTENT = 1e-4
"""Lower bound on the squared half extent of a projected ellipse of one standard deviation, in square pixels."""


def project_2d(world: PreparedGaussians2D, camera: Camera, settings: RasterSettings) -> ProjectedGaussians2D:
    """Project 2D Gaussians, drop invisible ones, and sort by depth and then by index.

    The computation uses float64, because the extent in the image is a difference of large numbers.

    Args:
        world: Gaussians.
        camera: Camera of the image.
        settings: Constants of the rasterizer.
    """
    near, device = _between_planes(world, camera, settings), world.means.device
    pose, means = camera.world_to_camera.to(device), world.means[near].double()
    center = torch.stack([_camera_axis(means, row) for row in pose[:3]], 1)
    in_camera = torch.cat([pose[:3, :3].double() @ world.axes[near], center[:, :, None]], 2)
    transforms = camera.K.to(device).double() @ in_camera
    # {a^2 + b^2 <= 1} projects to an ellipse with this center and these half sides of its bounding box.
    sign = transforms.new_tensor([1.0, 1.0, -1.0])
    last = transforms[:, 2:]
    factor = sign / (sign * last * last).sum(2, keepdim=True)
    means2d = (factor * transforms[:, :2] * last).sum(2)
    extents = means2d.square() - (factor * transforms[:, :2].square()).sum(2)
    radii = (
        (settings.radius_sigmas * extents.amax(1, keepdim=True).clamp(min=_LEAST_EXTENT).sqrt()).ceil().expand(-1, 2)
    )
    visible = _touch_image(means2d, radii, camera).nonzero().squeeze(1)
    dtype = world.opacities.dtype
    means2d, transforms, radii = (x[visible].to(dtype) for x in (means2d, transforms, radii))
    return ProjectedGaussians2D(
        world.gaussian[near[visible]], means2d, transforms, world.opacities[near[visible]], radii
    )


def _between_planes(world: AnyPrepared, camera: Camera, settings: RasterSettings) -> Int64[Tensor, " m"]:
    """Return the rows of `world` with centers between the near and the far plane, nearest first."""
    depth = camera_depths(world.means, camera)
    near = ((depth >= settings.near_plane) & (depth <= settings.far_plane)).nonzero().squeeze(1)
    return near[torch.argsort(depth[near], stable=True)]


def _touch_image(means2d: Float[Tensor, "m 2"], radii: Float[Tensor, "m 2"], camera: Camera) -> Bool[Tensor, " m"]:
    """Return a mask of the rectangles around the centers that are finite, not empty, and touch the image."""
    size = means2d.new_tensor([camera.width, camera.height])
    return (radii.isfinite() & (radii > 0) & (means2d + radii > 0) & (means2d - radii < size)).all(1)


def camera_depths(means: Float[Tensor, "m 3"], camera: Camera) -> Float[Tensor, " m"]:
    """Return the depth of every mean along the viewing axis, rounded as in gsplat."""
    return _camera_axis(means, camera.world_to_camera.to(means.device)[2])


def _camera_axis(means: Float[Tensor, "m 3"], row: Float[Tensor, " 4"]) -> Float[Tensor, " m"]:
    """Return one camera coordinate of all means, rounded as CUDA rounds R p + t.

    CUDA rounds b y, adds a x and c z with fused multiply-adds, and then adds t. The last bit decides the drawing order
    of Gaussians at nearly the same depth. A product of two float32 numbers is exact in float64, so rounding the sum in
    float64 once gives the result of a fused multiply-add.
    """
    dtype, (x, y, z) = means.dtype, means.double().unbind(1)
    a, b, c, t = row.to(dtype).double()
    total = (b * y).to(dtype)
    total = (a * x + total).to(dtype)
    total = (c * z + total).to(dtype)
    return total + t.to(dtype)


def assign_tiles(projected: AnyProjected, width: int, height: int, tile_size: int) -> TileLists:
    """List, for every tile, the Gaussians whose rectangle touches it."""
    columns, rows = -(-width // tile_size), -(-height // tile_size)
    u, v = (projected.means2d / tile_size).unbind(1)
    across, down = (projected.radii / tile_size).unbind(1)
    x0, x1 = (u - across).floor().clamp(0, columns).long(), (u + across).ceil().clamp(0, columns).long()
    y0, y1 = (v - down).floor().clamp(0, rows).long(), (v + down).ceil().clamp(0, rows).long()
    wide, count = x1 - x0, (x1 - x0) * (y1 - y0)
    member = torch.repeat_interleave(torch.arange(count.numel(), device=count.device), count)
    step = torch.arange(member.numel(), device=count.device) - (count.cumsum(0) - count)[member]
    tile = ((y0[member] + step // wide[member]) * columns + x0[member] + step % wide[member]).int()
    tile, order = tile.sort(stable=True)
    return TileLists(row_offsets(tile, rows * columns), member[order].int())


# Reference rasterizer in plain torch, for any device and precision.
#
# It processes one tile at a time, and is slow. All other backends are tested against it.


def compositing_weights(alpha: Float[Tensor, "p k"], min_transmittance: float) -> Float[Tensor, "p k"]:
    """Return A_ij = alpha_ij prod_{k<j} (1 - alpha_ik) (eq. 1 of the paper) of K Gaussians, nearest first, in P pixels.

    A pixel stops before the first Gaussian that would reduce its transmittance to `min_transmittance` or less.

    >>> compositing_weights(torch.tensor([[0.3, 0.8, 0.5]]), 1e-4)
    tensor([[0.3000, 0.5600, 0.0700]])
    >>> compositing_weights(torch.tensor([[0.3, 0.8, 0.5]]), 0.1)
    tensor([[0.3000, 0.5600, 0.0000]])
    """
    after = torch.cumprod(1 - alpha, dim=1)
    before = torch.cat([torch.ones_like(after[:, :1]), after[:, :-1]], dim=1)
    return torch.where(after > min_transmittance, alpha * before, 0.0)


def view_evidence(
    projected: AnyProjected,
    tiles: TileLists,
    labels: Int[Tensor, "h w"],
    num_regions: int,
    weight_power: int,
    settings: RasterSettings,
) -> Entries:
    """Return the sums of A_ij ** weight_power by (Gaussian, region) of one view. Region -1 is for unlabeled pixels."""
    parts: list[tuple[Tensor, Tensor, Tensor]] = []
    for member, (rows, columns), a in _tiles(projected, tiles, labels.shape[1], labels.shape[0], settings):
        weight = torch.where(a > 0, a.double() ** weight_power, 0.0)
        region, local = labels[rows, columns].flatten().unique(return_inverse=True)
        sums = weight.new_zeros(region.numel(), member.numel()).index_add_(0, local, weight)
        r, k = (sums * (region >= UNLABELED)[:, None]).nonzero(as_tuple=True)
        parts.append((projected.gaussian[member[k]], region[r], sums[r, k]))
    empty = torch.zeros(0, dtype=torch.int64, device=labels.device)
    gaussian, region, weight = (torch.cat(part) for part in zip((empty, empty, empty.double()), *parts))
    gaussian, column, weight = sum_duplicates(gaussian, region + 1, weight)
    return Entries(gaussian, column, weight.to(projected.opacities.dtype), (num_regions,))


def composite(
    projected: AnyProjected,
    tiles: TileLists,
    values: Float[Tensor, "m c"],
    width: int,
    height: int,
    settings: RasterSettings,
) -> tuple[Float[Tensor, "h w c"], Float[Tensor, "h w"]]:
    """Return sum_j A_ij values_j and sum_j A_ij of every pixel i (eq. 2 of the paper without its background)."""
    image, alpha = values.new_zeros(height, width, values.shape[1]), values.new_zeros(height, width)
    for member, (rows, columns), weight in _tiles(projected, tiles, width, height, settings):
        area = image[rows, columns]
        image[rows, columns] = (weight.to(values.dtype) @ values[member]).view(area.shape)
        alpha[rows, columns] = weight.sum(1).view(area.shape[:2]).to(values.dtype)
    return image, alpha


def _tiles(
    projected: AnyProjected, tiles: TileLists, width: int, height: int, settings: RasterSettings
) -> Iterator[tuple[Tensor, tuple[slice, slice], Tensor]]:
    """Yield the K Gaussians, the pixels as slices of the image, and A_ij [pixels, K] of every nonempty tile."""
    size, device, dtype = settings.tile_size, projected.means2d.device, projected.means2d.dtype
    across = -(-width // size)
    bounds = tiles.offsets.tolist()
    for tile, (start, stop) in enumerate(pairwise(bounds)):
        if start == stop:
            continue
        member = tiles.indices[start:stop].long()
        top, left = tile // across * size, tile % across * size
        rows, columns = slice(top, min(top + size, height)), slice(left, min(left + size, width))
        x, y = (torch.arange(side.start, side.stop, device=device).to(dtype) + 0.5 for side in (columns, rows))
        sigma = projected.exponents(member, x, y).flatten(0, 1)  # [P, K]
        alpha = (projected.opacities[member] * torch.exp(-sigma)).clamp(max=settings.max_alpha)
        alpha = torch.where((sigma >= 0) & (alpha >= settings.min_alpha), alpha, 0.0)
        yield member, (rows, columns), compositing_weights(alpha, settings.min_transmittance)
