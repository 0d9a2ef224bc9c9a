"""Regions that do not follow objects: superpixels, a grid and patches of rendered images, with features of their
content.

Most damage of masks (merged, split, shifted, frayed) does not apply to pieces of an image. The remaining kinds are
noise, wrong classes, missing pieces and few views.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor
from torch.nn.functional import conv2d, one_hot

from normlift_ns import Evidence, rasterize_evidence
from normlift_ns.encoders.base import patch_grid
from normlift_ns.segmentation.regions import Grid, Superpixels, resample_nearest
from research.damage import Damage, Observed, choose_views
from research.features import (
    Lengths,
    Looks,
    as_features,
    class_histograms,
    histograms,
    mixture_features,
    pictures,
    region_looks,
)
from research.synthetic_scenes import Words, World

KINDS = ("superpixels", "grid", "patches")
COUNT = {"superpixels": 256, "grid": 256, "patches": 1024}
"""Default number of pieces per image of each source."""
AROUND = (0.5, 1.0, 0.5)
"""Weights with which a patch shows the patch before it, itself and the patch after it, along both axes, because a
network also uses the surroundings of a patch."""


@dataclass(frozen=True)
class Pieces:
    """A world divided into pieces."""

    world: World
    kind: str
    evidence: Evidence
    """Evidence with one column per piece."""
    content: Tensor
    """[S, K + 1] share of every class among the pixels that the feature of a piece covers, with the background last."""
    labels: list[Tensor]
    """[H, W] piece of every pixel of each view, numbered through all views."""

    @cached_property
    def looks(self) -> Looks:
        """Histograms of the pieces."""
        world = self.world
        assert world.colors is not None, world.name
        seen, held_out = (pictures(world.scene, world.colors, some) for some in (world.cameras, world.held_out))
        return Looks(
            histograms(seen, self.labels, len(self.content)),
            class_histograms(seen, world.cells.maps, world.classes),
            as_features(class_histograms(held_out, world.held_out_maps, world.classes).sum(0)),
        )


def pieces(world: World, kind: str, count: int | None = None) -> Pieces:
    """Divide the rendered images of all training views into pieces.

    Args:
        count: Number of pieces per image (default: that of the source).
    """
    assert world.colors is not None, world.name
    count = count or COUNT[kind]
    local, numbers, content = [], [], []
    for picture, classes in zip(pictures(world.scene, world.colors, world.cameras), world.cells.maps, strict=True):
        labels = label_map(kind, (picture * 255).round().byte(), count)
        number = int(labels.max()) + 1
        shares = shares_of(labels, classes, number, world.classes)
        if kind == "patches":
            shares = blurred(shares, patch_grid(labels.shape[0], labels.shape[1], count))
        local.append(labels)
        numbers.append(number)
        content.append(shares)
    drawn = world.scene.to("cuda") if torch.cuda.is_available() else world.scene
    evidence = rasterize_evidence(drawn, world.cameras, local, num_regions=numbers).to(world.scene.means.device)
    first = torch.tensor([0, *numbers]).cumsum(0).tolist()
    return Pieces(world, kind, evidence, torch.cat(content), [x.long() + n for x, n in zip(local, first)])


def label_map(kind: str, image: Tensor, count: int) -> Tensor:
    """Return [H, W], the int32 piece of every pixel of an image [H, W, 3], as in the package's own sources."""
    if kind == "patches":
        rows, columns = patch_grid(image.shape[0], image.shape[1], count)
        patches = torch.arange(rows * columns, dtype=torch.int32).view(1, rows, columns).numpy()
        return torch.from_numpy(resample_nearest(patches, image.shape[0], image.shape[1])[0])
    source = Superpixels(count) if kind == "superpixels" else Grid(count)
    return source.labels(image, "")[0, 0]


def shares_of(labels: Tensor, classes: Tensor, number: int, count: int) -> Tensor:
    """Return [number, K + 1], the share of every class among the pixels of each piece, with the background last."""
    what = one_hot(torch.where(classes >= 0, classes, count).flatten(), count + 1).float()
    sums = torch.zeros(number, count + 1).index_add_(0, labels.flatten().long(), what)
    return sums / sums.sum(1, keepdim=True).clamp(min=1)


def blurred(shares: Tensor, grid: tuple[int, int]) -> Tensor:
    """Return the content of patches [rows * columns, K + 1] mixed with that of their neighbors; see `AROUND`."""
    line = torch.tensor(AROUND)
    planes = shares.T.reshape(-1, 1, *grid)
    kernel = (line[:, None] * line)[None, None]
    mixed = conv2d(planes, kernel, padding=1) / conv2d(torch.ones_like(planes), kernel, padding=1)
    return mixed.view(shares.shape[1], -1).T


def observe_pieces(
    found: Pieces, words: Words | Looks, damage: Damage, seed: int, lengths: Lengths | None = None
) -> Observed:
    """Return the input of a lift from the pieces after noise, wrong classes, missing pieces and few views.

    The same arguments give the same result.
    """
    g = torch.Generator().manual_seed(seed)
    world, content = found.world, found.content
    if isinstance(words, Looks):
        features = region_looks(words, content, damage.wrong, g)
    else:
        features = mixture_features(words, content, damage.wrong, damage.noise, lengths or Lengths(), g)
    views = len(world.cameras)
    kept = torch.rand(len(content), generator=g) >= damage.dropped
    chosen = choose_views(views, damage, g)
    evidence = found.evidence.select_views(chosen) if len(chosen) < views else found.evidence
    columns = found.evidence.columns_of(chosen).cpu()
    kept, features = kept[columns], features[columns]
    index = torch.where(kept, kept.long().cumsum(0) - 1, -1)[None]
    evidence = evidence.regroup(index, evidence.region_view.cpu()[kept])
    return Observed(evidence, features[kept].to(world.scene.means.device), index, chosen)
