"""Scenes with known classes of their Gaussians, and evidence on cells that are fine enough for any damage to the masks.

Evidence is rasterized once, on the joint cells of the exact masks and of `BLOCKS` square blocks across every image.
Damage to masks then only regroups the cells (`Evidence.regroup`), without another rasterization.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor
from torch.nn.functional import normalize

from normlift_ns import Camera, Evidence, GaussianScene, rasterize_evidence
from normlift_ns.core.evidence import MASKED
from normlift_ns.core.metrics import NO_CLASS
from normlift_ns.core.sparse import SparseRows
from normlift_ns.demo.capture import demo_cameras, held_out_cameras, view_labels
from normlift_ns.demo.room import DemoRoom
from normlift_ns.encoders.base import joint_partition
from tests.captures import SHARED, all_cameras, base_colors, trained_scene, training_indices
from tests.plain_room import plain_room

BLOCKS = 40
"""Number of blocks across an image."""
PIXEL_STEP = 4
"""Distance between sampled pixels of held-out views along each axis, in pixels."""
SHADE = 0.3
"""Optical depth of all floaters together in the median view, in which they absorb a quarter of the light."""
PARTS = 4
"""Number of parts of every object, if regions are of parts."""
PURITY, WEIGHT = 0.75, 1.0
"""Smallest share of the weight of a Gaussian in the exact masks of its class, and smallest weight in pixels, over all
training views and including the background. A Gaussian below either minimum does not count."""


@dataclass(frozen=True)
class Cells:
    """Cells of all training views, the columns of their evidence."""

    view: Tensor
    """[C] view of each cell."""
    mask: Tensor
    """[C] class of the exact mask, or -1 for none."""
    centre: Tensor
    """[C, 2] center (x, y), in pixels."""
    maps: Tensor
    """[V, H, W] exact masks, for other positions."""
    of_pixel: Tensor
    """[V, H, W] cell of every pixel."""


@dataclass(frozen=True)
class World:
    """A scene with its evidence and its ground truth."""

    name: str
    scene: GaussianScene
    cameras: list[Camera]
    evidence: Evidence
    """Evidence of the cells."""
    cells: Cells
    truth: Tensor
    """[N] class of every Gaussian, or -1 if it does not count."""
    classes: int
    held_out: list[Camera]
    held_out_maps: Tensor
    """[V', H, W] exact masks."""
    colors: Tensor | None = None
    """[N, 3] sRGB colors in 0..1, for the histograms of regions."""

    @cached_property
    def squared(self) -> Evidence:
        """Evidence with the weights A ** 2 of Splat Feature Solver."""
        return cell_evidence(self.scene, self.cameras, self.cells.maps, weight_power=2)[0]

    @cached_property
    def pixels(self) -> tuple[SparseRows, Tensor]:
        """Evidence [N, P] in sampled pixels of the held-out views, each its own region, and their classes [P]."""
        labels, truth, step = [], [], PIXEL_STEP
        for classes in self.held_out_maps:
            chosen = torch.zeros_like(classes, dtype=torch.bool)
            chosen[step // 2 :: step, step // 2 :: step] = True
            labels.append(torch.where(chosen, chosen.flatten().cumsum(0).view_as(classes) - 1, MASKED).int())
            truth.append(classes[chosen])
        return rasterize_evidence(self.scene, self.held_out, labels).rows, torch.cat(truth)

    @cached_property
    def azimuth_rank(self) -> Tensor:
        """[V, K] rank of every training camera by its azimuth around each object, with z up."""
        eyes = torch.stack([camera.world_to_camera.double().cpu().inverse()[:3, 3] for camera in self.cameras])
        means, truth, ranks = self.scene.means.double().cpu(), self.truth.cpu(), []
        for c in range(self.classes):
            of_class = truth == c
            middle = means[of_class].mean(0) if bool(of_class.any()) else eyes.mean(0)
            beside = eyes - middle
            ranks.append(torch.atan2(beside[:, 1], beside[:, 0]).argsort().argsort())
        return torch.stack(ranks, dim=1)

    @cached_property
    def angles(self) -> Tensor:
        """[K, V, V] angles in degrees between the directions from the center of each object to the training cameras."""
        eyes = torch.stack([camera.world_to_camera.double().cpu().inverse()[:3, 3] for camera in self.cameras])
        means, truth, found = self.scene.means.double().cpu(), self.truth.cpu(), []
        for c in range(self.classes):
            of_class = truth == c
            toward = normalize(eyes - means[of_class if bool(of_class.any()) else slice(None)].mean(0), dim=1)
            found.append(torch.rad2deg((toward @ toward.T).clamp(-1, 1).acos()))
        return torch.stack(found)

    @cached_property
    def parts(self) -> Tensor:
        """[C] part of an object with the most weight in each cell; see `parts_of`."""
        part = parts_of(self.scene.means.cpu(), self.truth.cpu(), self.classes)
        rows = self.evidence.rows.to("cpu")
        weights = torch.zeros(len(self.cells.view), PARTS)
        weights.index_put_((rows.column.long(), part[rows.row_index()]), rows.weight, accumulate=True)
        return weights.argmax(1)

    def to(self, device: str) -> World:
        """Return the world with the tensors of the lift on another device."""
        scene, evidence, truth = (x.to(device) for x in (self.scene, self.evidence, self.truth))
        return replace(self, scene=scene, evidence=evidence, truth=truth)


def block_side(maps: Tensor) -> int:
    """Return the side of the blocks of maps [V, H, W], in pixels."""
    return -(-maps.shape[2] // BLOCKS)


def cell_evidence(
    scene: GaussianScene, cameras: Sequence[Camera], maps: Tensor, *, weight_power: int = 1
) -> tuple[Evidence, Cells]:
    """Return the evidence on the joint cells of masks [V, H, W] and blocks, and the cells."""
    views, height, width = maps.shape
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    side = block_side(maps)
    blocks = (y // side * -(-width // side) + x // side).int()
    labels, masks, centres = [], [], []
    for classes in maps.cpu().int():
        cells, regions = joint_partition(torch.stack([classes, blocks]))
        flat, count = cells.flatten().long(), torch.bincount(cells.flatten())
        place = torch.stack([x.flatten(), y.flatten()], 1).double()
        centre = torch.zeros(len(count), 2, dtype=torch.float64).index_add_(0, flat, place) / count[:, None] + 0.5
        labels.append(cells)
        masks.append(regions[0].long())
        centres.append(centre.float())
    drawn = scene.to("cuda") if torch.cuda.is_available() else scene
    evidence = rasterize_evidence(
        drawn, cameras, labels, num_regions=[len(m) for m in masks], weight_power=weight_power
    ).to(scene.means.device)
    counts = torch.tensor([len(m) for m in masks])
    view = torch.repeat_interleave(torch.arange(views), counts)
    of_pixel = torch.stack(labels) + (counts.cumsum(0) - counts).int()[:, None, None]
    return evidence, Cells(view, torch.cat(masks), torch.cat(centres), maps.cpu(), of_pixel)


def parts_of(means: Tensor, thing: Tensor, count: int) -> Tensor:
    """Return [N], the part of every Gaussian of an object: the nearest of distant points. Other Gaussians have part
    0."""
    part = torch.zeros(len(means), dtype=torch.int64)
    for k in range(count):
        of_thing = (thing == k).nonzero().squeeze(1)
        if len(of_thing) == 0:
            continue
        places = means[of_thing]
        nearest = torch.full((len(places),), torch.inf)
        chosen = int((places - places.mean(0)).norm(dim=1).argmax())
        for p in range(PARTS):
            distance = (places - places[chosen]).norm(dim=1)
            part[of_thing[distance < nearest]] = p
            nearest = torch.minimum(nearest, distance)
            chosen = int(nearest.argmax())
    return part


def truth_of(evidence: Evidence, cells: Cells, classes: int) -> Tensor:
    """Return the class of every Gaussian by the exact masks; see `PURITY`."""
    one_hot = torch.nn.functional.one_hot(cells.mask + 1, classes + 1).to(evidence.rows.weight)
    weights = evidence.rows.matmul(one_hot)
    total = weights.sum(1)
    share, best = weights[:, 1:].max(dim=1)
    return torch.where((total >= WEIGHT) & (share >= PURITY * total), best, NO_CLASS)


def tabletop(views: int | None = None) -> World:
    """Return the tabletop capture: twelve objects, and 44 training views or `views` of them, evenly spread."""
    scene, cameras = trained_scene("tabletop"), all_cameras("tabletop")
    folder = SHARED / "captures" / "tabletop" / "instance"
    maps = torch.stack([
        torch.from_numpy(np.array(Image.open(folder / f"{i:04d}.png")).astype(np.int64)) - 1
        for i in range(len(cameras))
    ])  # fmt: skip
    train = training_indices("tabletop")
    held_out = [i for i in range(len(cameras)) if i not in train]
    train = train if views is None else [train[i] for i in np.linspace(0, len(train) - 1, views).round().astype(int)]
    evidence, cells = cell_evidence(scene, [cameras[i] for i in train], maps[train])
    truth = truth_of(evidence, cells, 12)
    return World(
        "tabletop", scene, [cameras[i] for i in train], evidence, cells, truth, 12,
        [cameras[i] for i in held_out], maps[held_out], base_colors("tabletop"),
    )  # fmt: skip


def demo(num_gaussians: int = 40_000, views: int = 24, width: int = 320) -> World:
    """Return the plain room: thirteen classes, known for every Gaussian except floaters, whether a view shows it or
    not."""
    size = width, width * 3 // 4
    return world_of_room("demo", plain_room(num_gaussians), demo_cameras(views, *size), held_out_cameras(4, *size))


def world_of_room(name: str, room: DemoRoom, cameras: list[Camera], held_out: list[Camera]) -> World:
    """Return a room of known classes, seen from two sets of cameras."""
    drawn = room
    if torch.cuda.is_available():
        drawn = replace(room, scene=room.scene.to("cuda"), labels=room.labels.to("cuda"))
    maps, held_out_maps = (
        torch.stack([view_labels(drawn, camera).cpu().long() - 1 for camera in some]) for some in (cameras, held_out)
    )
    evidence, cells = cell_evidence(room.scene, cameras, maps)
    classes = len(room.names)
    return World(name, room.scene, cameras, evidence, cells, room.labels, classes, held_out, held_out_maps, room.colors)


def with_floaters(world: World, share: float = 0.05, seed: int = 0) -> World:
    """Return the world with more Gaussians, half-transparent blobs without a class between cameras and surfaces."""
    scene, count, g = world.scene, round(share * len(world.scene)), torch.Generator().manual_seed(seed)
    eyes = torch.stack([camera.world_to_camera.double().inverse()[:3, 3] for camera in world.cameras]).float()
    eye = eyes[torch.randint(0, len(eyes), (count,), generator=g)]
    seen = (world.truth >= 0).nonzero().squeeze(1)
    target = scene.means[seen[torch.randint(0, len(seen), (count,), generator=g)]]
    means = eye + (target - eye) * (0.3 + 0.6 * torch.rand(count, 1, generator=g))
    opacities = 0.05 + 0.55 * torch.rand(count, generator=g)
    depth = torch.stack([_optical_depth(means, opacities, camera) for camera in world.cameras]).median()
    scales = (SHADE / depth).sqrt() * (0.5 + torch.rand(count, 3, generator=g))
    floaters = GaussianScene(means, torch.randn(count, 4, generator=g), scales, opacities)
    names = ("means", "quats", "scales", "opacities")
    both: dict[str, Any] = {name: torch.cat([getattr(x, name) for x in (scene, floaters)]) for name in names}
    joined = replace(scene, **both)
    evidence, cells = cell_evidence(joined, world.cameras, world.cells.maps)
    truth = torch.cat([world.truth, torch.full((count,), NO_CLASS)])
    colors = None if world.colors is None else torch.cat([world.colors, torch.full((count, 3), 0.6)])
    changed = {"scene": joined, "evidence": evidence, "cells": cells, "truth": truth, "colors": colors}
    return replace(world, name=f"{world.name}_floaters", **changed)


def _optical_depth(means: Tensor, opacities: Tensor, camera: Camera) -> Tensor:
    """Return the mean optical depth of blobs of scale 1 over the pixels of one view."""
    pose, K = camera.world_to_camera.float(), camera.K.float()
    place = means @ pose[:3, :3].T + pose[:3, 3]
    pixel = place @ K.T
    x, y, z = pixel[:, 0] / pixel[:, 2], pixel[:, 1] / pixel[:, 2], place[:, 2]
    inside = (z > 0) & (x > 0) & (y > 0) & (x < camera.width) & (y < camera.height)
    area = 2 * torch.pi * K[0, 0] * K[1, 1] / z**2
    return (opacities * area)[inside].sum() / (camera.width * camera.height)


@dataclass(frozen=True)
class Words:
    """Vectors of texts."""

    classes: Tensor
    """[K, D] unit vectors of the world's classes."""
    others: Tensor
    """[M, D] unit vectors of many texts, whose covariance the noise follows."""


def real_words() -> Words:
    """Return CLIP ViT-B/32 vectors of the tabletop's stand-in names, and of the 1,203 LVIS names."""
    folder = SHARED / "clip_vectors"
    vectors = normalize(torch.from_numpy(np.load(folder / "lvis_v1_text.npy")).double(), dim=1).float()
    index = {name: i for i, name in enumerate(json.loads((folder / "lvis_v1_names.json").read_text()))}
    mapping = json.loads((folder / "tabletop_map.json").read_text())
    return Words(vectors[[index[mapping[str(i)]] for i in range(1, 13)]], vectors)


def made_words(classes: int, dimension: int = 512, seed: int = 0) -> Words:
    """Return vectors as similar to each other as those of CLIP's texts (mean cosine 0.74), in a space of 100
    directions."""
    g = torch.Generator().manual_seed(seed)
    common = normalize(torch.randn(dimension, generator=g), dim=0)
    space = torch.linalg.qr(torch.randn(dimension, 100, generator=g)).Q.T
    own = normalize(torch.randn(classes + 1000, 100, generator=g) @ space, dim=1)
    words = normalize(0.74**0.5 * common + 0.26**0.5 * own, dim=1)
    return Words(words[:classes], words)
