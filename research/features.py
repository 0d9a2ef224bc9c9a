"""Features of regions with six kinds of statistics, like those of different encoders; pure functions with a generator.

Made of words, the feature of a mask is normalize(t + C c + O o + N n). Here, t is the text vector of its class, c is a
direction that all image features share (the modality gap), and o is a direction of the object. n is the noise of this
mask in this view. c and o are orthogonal to the classes. A region that does not follow an object shows a mixture of
classes, so t and o are means over its pixels. The noise follows the covariance of text vectors, so that it resembles
confusion with other classes, or is the same in all directions.

| statistic | one object in two views | two objects | |
|---|---|---|---|
| clip | 0.83 | 0.64 | image and own text 0.34, another text 0.25 |
| isotropic | 0.13 | 0.10 | text vectors with the same noise in all directions, no modality gap |
| low contrast | 0.90 | 0.85 | a long common direction |
| orthogonal | 0.26 | 0 | texts in random directions, no modality gap |
| histogram | that of the images | that of the images | color and gradient of rendered images, see `Looks` |
| real | 0.39 to 0.77 | 0.22 | as measured on photographs, in `research.real_features`; not used for decisions |

The cosines are those of step "noise only" with 512 dimensions. The noise of isotropic and orthogonal features is as
long as makes a single feature at step "noise" about as often nearest to the text of another class as a CLIP-like one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from normlift_ns import Camera, GaussianScene, render
from research.synthetic_scenes import Words, World

COLOUR_STEPS, ANGLES = 4, 8
"""Number of bins of every sRGB channel, and of gradient directions without their sign."""


@dataclass(frozen=True)
class Lengths:
    """Lengths of the parts of a feature, relative to a text vector of length 1."""

    common: float = 2.2
    own: float = 1.2
    noise: float = 1.0
    """Factor on the length of the noise of a damage."""
    isotropic: bool = False
    """True if the noise is the same in all directions, False if it follows the covariance of text vectors."""


LENGTHS = {
    "clip": Lengths(),
    "isotropic": Lengths(common=0.0, own=0.0, noise=2.2, isotropic=True),
    "low contrast": Lengths(common=3.13, own=0.6, noise=0.925),
    "orthogonal": Lengths(common=0.0, own=1.0, noise=2.0),
}
"""Lengths of the statistics that are made of words."""
STATISTICS = (*LENGTHS, "histogram")


def orthogonal_words(classes: int, dimension: int = 512, seed: int = 0) -> Words:
    """Return vectors in random directions of a space of 100 dimensions."""
    g = torch.Generator().manual_seed(seed)
    space = torch.linalg.qr(torch.randn(dimension, 100, generator=g)).Q.T
    words = normalize(torch.randn(classes + 1000, 100, generator=g) @ space, dim=1)
    return Words(words[:classes], words)


def mistaken(masks: Tensor, classes: Tensor, g: torch.Generator) -> Tensor:
    """Return another class for every mask; similar classes are more likely."""
    near = torch.softmax(20 * (classes @ classes.T).fill_diagonal_(-torch.inf), dim=1)
    return torch.multinomial(near[masks], 1, generator=g).squeeze(1) if len(masks) > 0 else masks


def mask_features(
    words: Words, masks: Tensor, forced: Tensor, wrong: float, noise: float, lengths: Lengths, g: torch.Generator
) -> Tensor:
    """Return [S, D] unit features of masks of the given classes.

    Args:
        forced: [S] class that a mask shows in any case, or -1 for none.
        wrong: Share of masks that show another class.
    """
    free = _free(words, g)
    other = mistaken(masks, words.classes, g)
    shown = torch.where(torch.rand(len(masks), generator=g) < wrong, other, masks)
    shown = torch.where(forced >= 0, forced, shown)
    static = _noise(words, len(masks), lengths, g)
    length = noise * lengths.noise
    mixed = words.classes[shown] + lengths.common * free[-1] + lengths.own * free[masks] + length * static
    return normalize(mixed, dim=1)


def mixture_features(
    words: Words, content: Tensor, wrong: float, noise: float, lengths: Lengths, g: torch.Generator
) -> Tensor:
    """Return [S, D] unit features of regions, given their shares [S, K + 1] of the classes and, last, of the
    background."""
    count = content.shape[1] - 1
    free = _free(words, g)
    vectors = torch.cat([words.classes, words.others[-1:]])  # the background has a word of its own
    other = mistaken(content[:, :count].argmax(1), words.classes, g)
    struck = torch.rand(len(content), generator=g) < wrong
    shown = torch.where(struck[:, None], torch.nn.functional.one_hot(other, count + 1).to(content), content)
    static = _noise(words, len(content), lengths, g)
    own = content[:, :count] @ free[:count]
    mixed = shown @ vectors + lengths.common * free[-1] + lengths.own * own + noise * lengths.noise * static
    return normalize(mixed, dim=1)


def _free(words: Words, g: torch.Generator) -> Tensor:
    """Return [K + 1, D] unit directions orthogonal to the classes: one per object, and the common one last."""
    basis = torch.linalg.qr(words.classes.T).Q
    random = torch.randn(len(words.classes) + 1, words.classes.shape[1], generator=g)
    return normalize(random - random @ basis @ basis.T, dim=1)


def _noise(words: Words, count: int, lengths: Lengths, g: torch.Generator) -> Tensor:
    if lengths.isotropic:
        return normalize(torch.randn(count, words.classes.shape[1], generator=g), dim=1)
    others = words.others
    return normalize(torch.randn(count, len(others), generator=g) @ (others - others.mean(0)), dim=1)


@dataclass(frozen=True)
class Looks:
    """Histograms that replace words."""

    pieces: Tensor
    """[C, B] sums over the pixels of every cell of the training views, or of every region."""
    masks: Tensor
    """[V, K, B] sums over the exact masks of the training views, or 0 if a class is not visible."""
    classes: Tensor
    """[K, B] unit histograms of the exact masks of all held-out views, which take the place of text vectors."""


def as_features(sums: Tensor) -> Tensor:
    """Return [S, B] unit features: square roots of the shares of the bins, with equal weight for color and gradient."""
    colours = COLOUR_STEPS**3
    parts = sums.clamp(min=0).split([colours, sums.shape[1] - colours], dim=1)
    shares = [part / part.sum(1, keepdim=True).clamp(min=1e-12) for part in parts]
    return normalize(torch.cat(shares, dim=1).sqrt(), dim=1)


def mask_looks(looks: Looks, index: Tensor, masks: Tensor, forced: Tensor, wrong: float, g: torch.Generator) -> Tensor:
    """Return [S, B] features of masks made of cells.

    A wrong mask looks like the exact mask of another class in a random view in which that class is visible.

    Args:
        index: [C] mask of every cell, or -1 for none.
        masks: [S] class of each mask.
        forced: As in `mask_features`.
    """
    inside = index >= 0
    sums = torch.zeros(len(masks), looks.pieces.shape[1]).index_add_(0, index[inside], looks.pieces[inside])
    other = mistaken(masks, looks.classes, g)
    struck = torch.rand(len(masks), generator=g) < wrong
    return as_features(_struck(looks, sums, torch.where(forced >= 0, forced, other), struck | (forced >= 0), g))


def region_looks(looks: Looks, content: Tensor, wrong: float, g: torch.Generator) -> Tensor:
    """Return [S, B] features of the regions themselves, with wrong ones as in `mask_looks`."""
    other = mistaken(content[:, :-1].argmax(1), looks.classes, g)
    struck = torch.rand(len(content), generator=g) < wrong
    return as_features(_struck(looks, looks.pieces, other, struck, g))


def _struck(looks: Looks, sums: Tensor, other: Tensor, struck: Tensor, g: torch.Generator) -> Tensor:
    """Return sums [S, B], with those of another class in a random view for the rows in `struck`."""
    chance = torch.rand(len(sums), len(looks.masks), generator=g) * (looks.masks.sum(2).T > 0)[other]
    return torch.where(struck[:, None], looks.masks[chance.argmax(1), other], sums)


def pictures(scene: GaussianScene, colors: Tensor, cameras: Sequence[Camera]) -> list[Tensor]:
    """Return rendered images [H, W, 3] in 0..1, on black."""
    device = "cuda" if torch.cuda.is_available() else "cpu"
    scene, colors = scene.to(device), colors.to(device)
    return [render(scene, camera, colors)[0].clamp(0, 1).cpu() for camera in cameras]


def pixel_bins(picture: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return, for every pixel [P], its color bin, its gradient bin and the length of its gradient."""
    colour = (picture * COLOUR_STEPS).long().clamp(0, COLOUR_STEPS - 1)
    colour = (colour[..., 0] * COLOUR_STEPS + colour[..., 1]) * COLOUR_STEPS + colour[..., 2]
    grey = (picture @ picture.new_tensor([0.299, 0.587, 0.114])).numpy()
    down, right = np.gradient(grey)
    angle = (np.arctan2(down, right) / np.pi % 1 * ANGLES).astype(np.int64) % ANGLES
    return colour.flatten(), torch.from_numpy(angle).flatten(), torch.from_numpy(np.hypot(down, right)).flatten()


def histograms(pictures: Sequence[Tensor], labels: Sequence[Tensor], count: int) -> Tensor:
    """Return [count, B] sums over the pixels of every label of all views; pixels without a label have -1."""
    colours = COLOUR_STEPS**3
    out = torch.zeros(count, colours + ANGLES)
    for picture, of_view in zip(pictures, labels, strict=True):
        colour, angle, size = pixel_bins(picture)
        label = of_view.flatten().long()
        inside = label >= 0
        for column, weight in ((colour, torch.ones_like(size)), (colours + angle, size)):
            out.view(-1).index_add_(0, label[inside] * out.shape[1] + column[inside], weight[inside].float())
    return out


def class_histograms(pictures: Sequence[Tensor], maps: Tensor, classes: int) -> Tensor:
    """Return [V, K, B] sums over exact masks [V, H, W]."""
    of_view = [torch.where(one >= 0, one + v * classes, -1) for v, one in enumerate(maps)]
    return histograms(pictures, of_view, len(maps) * classes).view(len(maps), classes, -1)


def world_looks(world: World) -> Looks:
    """Return the histograms of a world whose Gaussians have colors."""
    assert world.colors is not None, world.name
    seen, held_out = (pictures(world.scene, world.colors, some) for some in (world.cameras, world.held_out))
    return Looks(
        histograms(seen, list(world.cells.of_pixel), len(world.cells.view)),
        class_histograms(seen, world.cells.maps, world.classes),
        as_features(class_histograms(held_out, world.held_out_maps, world.classes).sum(0)),
    )
