"""Search for the world in which a splat fits its images."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from torch.nn import functional

from normlift_ns.core.scene import View
from normlift_ns.data.alignment import Alignment, measure_alignment
from normlift_ns.data.open_scene import SplatScene
from normlift_ns.data.reduced_views import ReducedView, sample_views
from normlift_ns.data.worlds import CandidateWorld
from normlift_ns.rasterization.projection import rotation_matrices
from normlift_ns.rasterization.settings import RasterSettings

_SIDE, _POINTS, _BATCH = 32, 8000, 64
"""Longer side in pixels of the images that are compared with points, number of points, and number of cameras per
batch."""
_MAX_SAMPLED = 2**20
"""Maximum number of Gaussians from which the points are sampled."""
_SAME_DEPTH = 1.05
"""Maximum depth of a visible point, relative to the depth of the nearest point in the same pixel."""
_LIKELY, _MAX_LIKELY = 0.7, 4
"""Minimum agreement of worlds to render, relative to the best world, and maximum number of these worlds."""
_SCALES = 1.12 ** np.arange(-61, 62)
"""Uniform scales that are tried, from about 0.001 to about 1000."""
_SHRINKING = (0.04, 0.02, 0.01)
"""Successive steps of the logarithm of the scale, in the refinement with points."""
_PARABOLAS, _MAX_MOVES = ((100, 0.01), (400, 0.001)), 5
"""Longer side in pixels of the renders that refine a scale further, with the step of the logarithm of the scale;
maximum number of steps at each size."""
_MIN_START = 2.0
"""Minimum lead in dB of the PSNR of a small render over the PSNR of the mean color of its image."""
_TURN, _TURNED_SIDE = math.radians(1), 200
"""Angle in radians of the rotations that must not improve the fit of a correct world, and longer side in pixels of the
renders that check this."""
_SH_C0 = 0.28209479177387814
"""Value of the constant spherical harmonic."""
_ROUND = 1e-3
"""A scale is rounded to two digits if this changes it by less than this fraction, else to five digits."""


class _Points(NamedTuple):
    """Points sampled from the Gaussians of a scene, and the small images that are compared with them."""

    positions: Float[Tensor, "n 3"]
    colors: Float[Tensor, "n 3"]
    """RGB in 0..1, the same from all sides."""
    background: Float[Tensor, " 3"]
    """RGB in 0..1 of pixels without points."""
    views: list[View]

    def agreement(self, worlds: Sequence[_Motion]) -> Float[Tensor, " w"]:
        """Return the mean correlation, in -1..1, between the images and the visible points, with the cameras moved to
        each of the worlds."""
        values = torch.zeros(len(worlds))
        for view in self.views:
            poses = torch.stack([world.move(view.camera.world_to_camera) for world in worlds])
            values += torch.cat([self._correlation(view, part) for part in poses.split(_BATCH)])
        return values / len(self.views)

    def _correlation(self, view: View, poses: Float[Tensor, "b 4 4"]) -> Float[Tensor, " b"]:
        camera, count = view.camera, view.camera.width * view.camera.height
        seen = self.positions @ poses[:, :3, :3].transpose(1, 2) + poses[:, None, :3, 3]
        depth = seen[..., 2]
        u, v = (camera.K[i, i] * seen[..., i] / depth + camera.K[i, 2] for i in (0, 1))
        inside = (depth > 0) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
        pose, point = inside.nonzero(as_tuple=True)
        pixel = (pose * camera.height + v[inside].long()) * camera.width + u[inside].long()
        depth = depth[inside]
        nearest = depth.new_full((len(poses) * count,), torch.inf).scatter_reduce(0, pixel, depth, "amin")
        is_front = depth <= _SAME_DEPTH * nearest[pixel]
        colors = torch.cat([self.colors, self.colors.new_ones(len(self.colors), 1)], dim=1)[point[is_front]]
        sums = colors.new_zeros(len(poses) * count, 4).index_add_(0, pixel[is_front], colors)
        drawn = functional.avg_pool2d(
            sums.view(len(poses), camera.height, camera.width, 4).permute(0, 3, 1, 2), 3, 1, 1
        )
        image = view.image.permute(2, 0, 1)[None].float() / 255
        image = functional.avg_pool2d(image, 3, 1, 1, count_include_pad=False)
        used = torch.ones_like(image[:, :1]) if view.mask is None else view.mask[None, None].float()
        empty = self.background[:, None, None]
        drawn = torch.where(drawn[:, 3:] > 0, drawn[:, :3] / drawn[:, 3:].clamp(min=1e-6), empty)
        first, second = _centered(drawn, used), _centered(image, used)
        variances = first.square().sum(dim=(1, 2, 3)) * second.square().sum()
        return (first * second).sum(dim=(1, 2, 3)) / variances.sqrt().clamp(min=1e-6)


def _centered(image: Float[Tensor, "b c h w"], used: Float[Tensor, "1 1 h w"]) -> Float[Tensor, "b c h w"]:
    """Subtract from an image the mean color of its pixels with weight 1, and set its pixels with weight 0 to 0."""
    return (image - (image * used).sum(dim=(2, 3), keepdim=True) / used.sum().clamp(min=1)) * used


class _Motion(NamedTuple):
    """Change from one candidate world to another."""

    matrix: Float[np.ndarray, "4 4"]
    """Similarity from the first world to the second."""
    flipped: bool
    """True if only one of the worlds has cameras with the axes of OpenCV."""

    def move(self, world_to_camera: Float[Tensor, "4 4"]) -> Float[Tensor, "4 4"]:
        """Return the pose of a camera in the second world."""
        pose = world_to_camera.double().numpy()
        if self.flipped:
            pose = np.diag([1.0, -1, -1, 1]) @ pose
        moved = pose @ np.linalg.inv(self.matrix)
        moved[:3] *= np.cbrt(np.linalg.det(self.matrix[:3, :3]))
        return torch.from_numpy(moved).to(world_to_camera)


class _Search:
    """Comparison of candidate worlds with the images of a scene.

    Args:
        scene: The scene in one of the worlds.
        here: The world of `scene`.
        device: torch device to render on.
    """

    def __init__(self, scene: SplatScene, here: CandidateWorld, device: str) -> None:
        self._scene, self._views, self._gaussians = scene, sample_views(scene), scene.gaussians.to(device)
        self._points = _draw_points(scene, self._views)
        self._back, self._flipped = np.linalg.inv(here.matrix), here.opencv_cameras

    def _motion(self, candidate: CandidateWorld) -> _Motion:
        return _Motion(candidate.matrix @ self._back, candidate.opencv_cameras != self._flipped)

    def agreement(self, candidates: Sequence[CandidateWorld]) -> Float[Tensor, " w"]:
        """Return the mean correlation, in -1..1, between points of the splat and the images in each world."""
        return self._points.agreement([self._motion(candidate) for candidate in candidates])

    def likely(self, candidates: Sequence[CandidateWorld]) -> list[CandidateWorld]:
        """Return the worlds other than the first that may fit, by descending agreement."""
        return [candidates[i] for i in _likely(self.agreement(candidates)) if i > 0 and self._is_near(candidates[i])]

    def likely_scales(self, candidates: Sequence[CandidateWorld]) -> list[CandidateWorld]:
        """Return uniformly rescaled copies of the worlds that may fit, by descending agreement."""
        unscaled = [
            candidate for candidate in candidates if candidate.world.scale == 1 and not candidate.opencv_cameras
        ]
        scaled = [(world, float(scale)) for world in unscaled for scale in _SCALES]
        grid = self.agreement([world.scaled(scale) for world, scale in scaled]).view(len(unscaled), len(_SCALES))
        is_peak = grid == functional.max_pool1d(grid, 5, stride=1, padding=2)
        likely = [scaled[i] for i in _likely(grid.where(is_peak, -1.0).flatten())]
        logs = [(world, self._refine(world, float(np.log(scale)))) for world, scale in likely]
        found = [world.scaled(_rounded(float(np.exp(log)))) for world, log in logs if log is not None]
        return [world for world in found if world.world.scale != 1]

    def _is_near(self, candidate: CandidateWorld) -> bool:
        """Return True if a small render fits an image clearly better than the mean color of the image does."""
        small = self._farthest(candidate).reduced(_PARABOLAS[0][0])
        return small.psnr(self._render(small, candidate)) >= small.psnr(small.mean_color()) + _MIN_START

    def _farthest(self, candidate: CandidateWorld) -> ReducedView:
        """Return the view whose camera is farthest from the origin, because a change of scale affects it most."""
        motion = self._motion(candidate)
        return max(self._views, key=lambda small: float(motion.move(small.view.camera.world_to_camera)[:3, 3].norm()))

    def _render(self, small: ReducedView, candidate: CandidateWorld) -> UInt8[Tensor, "h w 3"]:
        """Render a view of the scene in a world."""
        camera = small.view.camera
        camera = replace(camera, world_to_camera=self._motion(candidate).move(camera.world_to_camera))
        identity = self._scene.identity
        planes = candidate.clip_planes(identity.get("clip_planes"))
        settings = RasterSettings.recorded({**identity, "clip_planes": planes})
        return small._replace(view=small.view._replace(camera=camera)).render(self._scene, self._gaussians, settings)

    def _refine(self, candidate: CandidateWorld, log: float) -> float | None:
        """Return the logarithm of the scale that fits best, from the guess `log`; None if its render does not fit.

        Points refine the guess to a few percent. Parabolas through the mean squared errors of renders of one view then
        refine it further.
        """
        for step in _SHRINKING:
            near = [log - step, log, log + step]
            log = near[int(self.agreement([candidate.scaled(float(np.exp(value))) for value in near]).argmax())]
        if not self._is_near(candidate.scaled(float(np.exp(log)))):
            return None
        for side, step in _PARABOLAS:
            log = self._lowest(candidate, self._farthest(candidate).reduced(side), log, step)
        return log

    def _lowest(self, candidate: CandidateWorld, small: ReducedView, log: float, step: float) -> float:
        """Return the logarithm of the scale with the lowest mean squared error, by a parabola through three errors."""

        @cache
        def error(place: int) -> float:
            world = candidate.scaled(float(np.exp(log + place * step)))
            return 10 ** (-small.psnr(self._render(small, world)) / 10)

        place = 0
        for _ in range(_MAX_MOVES):
            lowest = min((place, place - 1, place + 1), key=error)
            if lowest == place:
                break
            place = lowest
        left, here, right = (error(place + offset) for offset in (-1, 0, 1))
        bend = max(left - 2 * here + right, abs(left - right))  # the vertex is half a step away at most
        return log + step * (place + ((left - right) / (2 * bend) if bend > 0 else 0.0))


def _rounded(scale: float) -> float:
    """Round a scale to two digits if this hardly changes it, otherwise to five.

    >>> _rounded(1.9997), _rounded(0.157858)
    (2.0, 0.15786)
    """
    short = float(f"{scale:.2g}")
    return short if abs(short - scale) < _ROUND * scale else float(f"{scale:.5g}")


def _likely(agreement: Float[Tensor, " w"]) -> list[int]:
    """Return the indices of the worlds that agree nearly as well as the best world, starting with the best."""
    values, order = agreement.sort(descending=True)
    return order[values >= _LIKELY * values[0].clamp(min=1e-6)][:_MAX_LIKELY].tolist()


def _draw_points(scene: SplatScene, views: Sequence[ReducedView]) -> _Points:
    """Sample points from the Gaussians with a fixed seed. Large and opaque Gaussians get more points."""
    gaussians, generator = scene.gaussians, torch.Generator().manual_seed(0)
    rows = gaussians.drawable.nonzero().squeeze(1)
    rows = rows[:: len(rows) // _MAX_SAMPLED + 1]
    areas = gaussians.scales[rows].sort(dim=1).values[:, 1:].prod(dim=1) * gaussians.opacities[rows]
    rows = rows[torch.multinomial(areas.double().sqrt() + 1e-30, _POINTS, replacement=True, generator=generator)]
    offsets = torch.randn(_POINTS, 3, generator=generator) * gaussians.scales[rows]
    axes = rotation_matrices(gaussians.quats[rows])
    colors = (0.5 + _SH_C0 * scene.splat.features_dc[rows]).clamp(0, 1)
    small = [view.reduced(_SIDE).view for view in views]
    positions = gaussians.means[rows] + (axes @ offsets[:, :, None])[:, :, 0]
    return _Points(positions, colors, scene.background, small)


def _is_best_nearby(scene: SplatScene, device: str) -> bool:
    """Return True if no rotation of the world by one degree about an axis improves the fit to the images.

    A world that is only close to the correct one can reach the usual PSNR, but one of the rotations improves its fit.
    """
    gaussians, settings = scene.gaussians.to(device), RasterSettings.recorded(scene.identity)
    views = [view.reduced(_TURNED_SIDE) for view in sample_views(scene)]
    center = scene.gaussians.means[scene.gaussians.drawable].median(dim=0).values.double()

    def psnr(turn: Float[Tensor, "4 4"]) -> float:
        total = 0.0
        for small in views:
            camera = small.view.camera
            turned = replace(camera, world_to_camera=camera.world_to_camera @ turn.to(camera.world_to_camera))
            moved = small._replace(view=small.view._replace(camera=turned))
            total += small.psnr(moved.render(scene, gaussians, settings))
        return total

    here = psnr(torch.eye(4, dtype=torch.float64))
    for axis in range(3):
        for angle in (-_TURN, _TURN):
            turn = torch.eye(4, dtype=torch.float64)
            i, j = (axis + 1) % 3, (axis + 2) % 3
            turn[i, i] = turn[j, j] = math.cos(angle)
            turn[i, j], turn[j, i] = -math.sin(angle), math.sin(angle)
            turn[:3, 3] = center - turn[:3, :3] @ center
            if psnr(turn) > here:
                return False
    return True


def find_world(
    candidates: Sequence[CandidateWorld],
    scene_in: Callable[[CandidateWorld], SplatScene],
    *,
    device: str,
    say: Callable[[str], None],
) -> SplatScene:
    """Search for the world in which renders of the scene fit the images, and return the scene in this world.

    If the first world fits, no other world is tried. Otherwise, the result is the scene in the only other world that
    fits, or in the first world if none or several fit.

    Args:
        candidates: Possible worlds.
        scene_in: Function that returns the scene in a world.
        device: torch device to render on.
        say: Function that is called with a message if other worlds fit.
    """
    here = candidates[0]
    scene = scene_in(here)
    match = measure_alignment(scene, device=device, explain=False)
    if match.is_usual:
        return replace(scene, alignment=match)
    if not bool(scene.gaussians.drawable.any()):
        return scene

    def fitting(worlds: Sequence[CandidateWorld]) -> list[tuple[CandidateWorld, SplatScene, Alignment]]:
        scenes = [(world, scene_in(world)) for world in worlds]
        found = [(world, other, measure_alignment(other, device=device, explain=False)) for world, other in scenes]
        return [item for item in found if item[2].is_usual and _is_best_nearby(item[1], device)]

    search = _Search(scene, here, device)
    found = fitting(search.likely(candidates)) or fitting(search.likely_scales(candidates))
    if len(found) == 0:
        return scene
    before = f"{match.psnr:.1f} dB in {here.name}"
    fits = "; ".join(f"{world.name} ({other.psnr:.1f} dB)" for world, _, other in found)
    if len(found) > 1:
        say(
            f"The splat fits its images in several worlds: {fits}. None of these is chosen; {here.name} "
            f"({match.psnr:.1f} dB) is used. To use another world, give its transform as a file with --world-transform."
        )
        return scene
    _, other, other_match = found[0]
    say(f"The splat fits its images in {fits}, so this world is used. The PSNR is only {before}.")
    return replace(other, alignment=other_match)
