"""What the views of a scene say about its Gaussians: evidence and feature rows, block by block, kept in a cache."""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int32, Int64, UInt8
from torch import Tensor
from xxhash import xxh3_128

from normlift_ns.core.evidence import MASKED, Evidence
from normlift_ns.core.gaussians import Camera, GaussianScene
from normlift_ns.core.scene import Scene, View
from normlift_ns.encoders.ahead import ahead
from normlift_ns.encoders.source import FeatureSource, each_view
from normlift_ns.encoders.undistorted import check_undistorted
from normlift_ns.errors import InputError
from normlift_ns.options import BackendName, RasterizeMode
from normlift_ns.raster.kept import Place, joined_views, keep_views, kept_views
from normlift_ns.raster.rasterize import rasterize_evidence, render_picture
from normlift_ns.raster.settings import RasterSettings

_LARGEST_CHUNK = 16
_READERS = 8
"""Photographs that are read at a time, while one is looked at or a network loads."""
_SMALLEST = 8
"""Pixels along a side of an image made smaller; fewer show nothing."""
_KEY = "normlift_ns.block/6"
"""Part of every key: to be raised when evidence changes for the same input."""


def region_levels(regions: Int32[Tensor, "levels c"], count: int) -> Int64[Tensor, " r"]:
    """The level of each of `count` regions: the first that it occurs in, 0 for one without cells.

    >>> region_levels(torch.tensor([[0, 0, -1], [1, 2, 2]], dtype=torch.int32), 3).tolist()
    [0, 1, 1]
    """
    level = torch.zeros(count, dtype=torch.int64)
    for number, of_cell in reversed(list(enumerate(regions))):
        level[of_cell[of_cell >= 0].long()] = number
    return level


class Block(NamedTuple):
    """Some views as the rasterizer and the lift need them."""

    cameras: list[Camera]
    labels: list[Int32[Tensor, "h w"]]
    """Cells, -1 unlabelled, -2 masked."""
    regions: list[Int32[Tensor, "levels c"]]
    """Region of every cell, -1 none."""
    features: list[Float[Tensor, "r d"]]


def in_chunks(views: Sequence[int], processes: int = 1) -> list[Sequence[int]]:
    """Views that are looked at together, whose evidence is one file: what an interrupted lift may lose.

    Where several processes divide the chunks, all have as many. What is found of a view does not depend on what else is
    in its chunk.

    >>> [[len(chunk) for chunk in in_chunks(range(45), processes)] for processes in (1, 2)]
    [[15, 15, 15], [12, 12, 12, 9]]
    """
    chunks = -(-len(views) // _LARGEST_CHUNK)
    chunks = processes * max(1, -(-chunks // processes))
    size = max(1, -(-len(views) // chunks))
    return [views[first : first + size] for first in range(0, len(views), size)]


def spread(count: int, most: int | None) -> list[int]:
    """At most `most` of `count` indices, evenly spread, the first and the last among them.

    >>> spread(10, 4)
    [0, 3, 6, 9]
    """
    if most is None or most >= count:
        return list(range(count))
    return torch.linspace(0, count - 1, most).round().long().tolist() if most > 1 else [0]


def observe_views(
    scene: Scene,
    indices: Sequence[int],
    source: FeatureSource,
    *,
    rendered: RasterSettings | None,
    divisor: int,
    done: Callable[[View], None],
) -> Block:
    """Labels and features of some training views.

    Args:
        rendered: look at the trained scene rendered from the cameras, with these constants, instead of at the
            photographs.
        divisor: of the size of images and cameras.
        done: called after every view, with the view as the source saw it.
    Raises:
        ValueError, FileNotFoundError: what `FeatureSource.view` and `check_undistorted` raise; an image, a mask or
            labels of another size than the camera.
    """
    waiting: deque[View] = deque()

    def images() -> Iterator[tuple[Tensor, str]]:
        for read in ahead(scene.train.__getitem__, indices, _READERS):
            view = (
                read if rendered is None else read._replace(image=render_picture(scene, read.camera, settings=rendered))
            )
            _check_sizes(view)
            waiting.append(_smaller(view, divisor) if divisor > 1 else view)
            check_undistorted(source, view, waiting[-1])
            yield waiting[-1].image, view.name

    block = Block([], [], [], [])
    for found in each_view(source, images()):
        view = waiting.popleft()
        if found.labels.shape != view.image.shape[:2]:
            raise InputError(
                f"labels of {view.name} are {tuple(found.labels.shape)}, but the image is {tuple(view.image.shape[:2])}"
                " (height x width); a source of features must label every pixel"
            )
        block.cameras.append(view.camera)
        block.labels.append(found.labels if view.mask is None else found.labels.where(view.mask, MASKED))
        block.regions.append(found.region_of_cell)
        block.features.append(found.features)
        done(view)
    return block


def _check_sizes(view: View) -> None:
    expected = (view.camera.height, view.camera.width)
    for what, found in (("image", view.image.shape[:2]), ("mask", expected if view.mask is None else view.mask.shape)):
        if tuple(found) != expected:
            raise InputError(
                f"the {what} of {view.name} is {tuple(found)}, but its camera {expected} (height x width); both must "
                "be undistorted alike"
            )


def block_evidence(
    gaussians: GaussianScene,
    block: Block,
    folder: Path,
    *,
    rasterize_mode: RasterizeMode,
    settings: RasterSettings,
    backend: BackendName,
    weight_power: int,
    dtype: torch.dtype,
    reuse: bool,
    done: Callable[[], None],
) -> Evidence:
    """Evidence of the regions of a block.

    That of the cells of a view, from which it is made, is taken from the folder if it was rasterized before with the
    same scene, camera and labels, whatever the regions and features were, and whichever views were in its block.
    """
    facts = [rasterize_mode, weight_power, str(dtype), asdict(settings), backend]
    keys = view_keys(gaussians, block, facts)
    found = kept_views(folder, keys) if reuse else {}
    new = [view for view in range(len(keys)) if view not in found]
    for _ in found:
        done()
    if len(new) > 0:
        evidence = rasterize_evidence(
            gaussians,
            [block.cameras[view] for view in new],
            [block.labels[view] for view in new],
            num_regions=[block.regions[view].shape[1] for view in new],
            backend=backend,
            rasterize_mode=rasterize_mode,
            weight_power=weight_power,
            settings=settings,
            dtype=dtype,
            progress=lambda *_: done(),
        )
        keep_views(evidence, folder, [keys[view] for view in new])
        found.update((view, Place(evidence, place)) for place, view in enumerate(new))
    return of_regions(joined_views(found).to(gaussians.means.device), block)


def kept_evidence(
    gaussians: GaussianScene,
    block: Block,
    folder: Path,
    *,
    rasterize_mode: RasterizeMode,
    settings: RasterSettings,
    backend: BackendName,
    weight_power: int,
    dtype: torch.dtype,
) -> Evidence | None:
    """What `block_evidence` has kept of a block; None where it is not there, and would have to be rasterized again."""
    facts = [rasterize_mode, weight_power, str(dtype), asdict(settings), backend]
    found = kept_views(folder, view_keys(gaussians, block, facts))
    return of_regions(joined_views(found), block) if len(found) == len(block.cameras) else None


def view_keys(gaussians: GaussianScene, block: Block, facts: Sequence[Any]) -> list[str]:
    """What finds the evidence of the cells of each view again: digests of all that it is made from.

    Args:
        facts: how it is rasterized, ready for JSON.
    """
    scene = _digest([_KEY, *facts], [gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities])
    views = zip(block.cameras, block.labels, block.regions)
    return [
        _digest([scene, regions.shape[1]], [labels, camera.K, camera.world_to_camera])
        for camera, labels, regions in views
    ]


def of_regions(evidence: Evidence, block: Block) -> Evidence:
    """Evidence of the regions of a block, from that of its cells."""
    counts = torch.tensor([0, *(len(rows) for rows in block.features)])
    first = counts.cumsum(0).tolist()
    columns = [torch.where(regions >= 0, regions + start, -1) for regions, start in zip(block.regions, first)]
    region_view = torch.repeat_interleave(torch.arange(len(block.features)), counts[1:])
    return evidence.regroup(torch.cat(columns, dim=1), region_view.int())


def _digest(facts: Any, tensors: Sequence[Tensor]) -> str:
    key = xxh3_128(json.dumps(facts).encode())
    for tensor in tensors:
        key.update(f"{tensor.dtype}{tuple(tensor.shape)}".encode())
        key.update(tensor.detach().cpu().contiguous().numpy().tobytes())
    return key.hexdigest()


def _smaller(view: View, divisor: int) -> View:
    """The view at a fraction of its size: pixels are averaged, a mask keeps what it keeps throughout."""
    camera = view.camera
    height, width = camera.height // divisor, camera.width // divisor
    if min(height, width) < _SMALLEST:
        raise InputError(
            f"lift_downscale {divisor:,} leaves {width} x {height} pixels of {view.name}, which has {camera.width} x "
            f"{camera.height}; give a number that leaves {_SMALLEST} pixels on each side"
        )
    scale = torch.tensor([[width / camera.width], [height / camera.height], [1.0]], dtype=camera.K.dtype)
    mask = None if view.mask is None else _averaged(view.mask[:, :, None], height, width)[:, :, 0] > 0.999
    image: UInt8[Tensor, "h w 3"] = _averaged(view.image, height, width).round().to(torch.uint8)
    smaller = Camera(camera.K * scale, camera.world_to_camera, width, height)
    return view._replace(camera=smaller, image=image, mask=mask)


def _averaged(image: Tensor, height: int, width: int) -> Tensor:
    channels_first = image.permute(2, 0, 1)[None].float()
    return torch.nn.functional.interpolate(channels_first, (height, width), mode="area")[0].permute(1, 2, 0)
