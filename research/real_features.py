"""Synthetic features with the same cosines as those of a trained network on photographs.

`research.geometry` measured the cosines on the fox, in regions between learned edges with ImageNet's classifier. An
object has several parts, each a region of its own. The feature of a part in a view is the normalized sum of

* a direction that all features share, one of the object and one of the part, all orthogonal to the texts;
* the text of the class, longer in some parts than in others, and the text of one other class that is the same
  in all views: the best wrong text;
* two random directions that turn as the camera moves around the object, one of the whole object and one of the part.
  Their correlation between two views is exp(-angle / scale), so that nearby views have almost the same mistakes;
* noise of this region in this view.

The lengths of the last two are as measured for a damage with noise `NOISE`, and proportional to the noise otherwise.
Texts are orthogonal, like the class vectors of such a network. Squared lengths are differences of the measured cosines.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import normalize

from research.features import mistaken
from research.synthetic_scenes import PARTS, Words

NOISE = 1.2
"""Noise of the step "noise only"."""


@dataclass(frozen=True)
class Cosines:
    """Means of cosines between features over pairs, with their keys in results/geometry.json in brackets."""

    two_things: float = 0.217
    """Cosine between two objects, in two views. [two_things.two_views]"""
    two_parts: float = 0.325
    """Cosine between two parts of an object, in two views. [thing.two_views]"""
    two_parts_one_view: float = 0.399
    """Cosine between two parts of an object, in one view. [thing.one_view]"""
    far: float = 0.390
    """Cosine between two views of one part, from opposite directions. [far]"""
    near: float = 0.770
    """Cosine between two views of one part, from almost the same position. [near]"""
    scale: float = 21.7
    """Angle between the views in degrees over which the cosine decays. [scale]"""
    own: float = 0.076
    """Cosine between a feature and its text. [own]"""
    wrong: float = 0.045
    """Cosine between a feature and the best wrong text among 11. [wrong]"""
    spread: float = 0.382
    """Standard deviation of the cosine with the own text within an object, relative to this cosine. [spread]"""


FOX = Cosines()


@dataclass(frozen=True)
class Regions:
    """Masks of parts of objects."""

    view: Tensor
    """[S] view."""
    thing: Tensor
    """[S] class."""
    part: Tensor
    """[S] part, in 0..PARTS-1."""
    forced: Tensor
    """[S] class that a region shows in any case, or -1 for none."""


def real_features(
    words: Words, regions: Regions, angles: Tensor, wrong: float, noise: float, g: torch.Generator, like: Cosines = FOX
) -> Tensor:
    """Return [S, D] unit features.

    Args:
        angles: [K, V, V] angles in degrees between the directions in which two views show each object.
        wrong: Share of regions that show another class.
        noise: Length of the noise of a damage.
    """
    (count, dimension), views = words.classes.shape, angles.shape[1]
    thing, part = regions.thing, regions.part
    basis = torch.linalg.qr(words.classes.T).Q
    constant = torch.randn(1 + count * (1 + PARTS), dimension, generator=g)
    constant = normalize(constant - constant @ basis @ basis.T, dim=1)
    of_part = constant[1 + count :].view(count, PARTS, -1)
    strength = (1 + like.spread * torch.randn(count, PARTS, generator=g)).clamp(min=0)
    worst = mistaken(torch.arange(count), words.classes, g)
    struck = torch.rand(len(thing), generator=g) < wrong
    shown = torch.where(struck, mistaken(thing, words.classes, g), thing)
    shown = torch.where(regions.forced >= 0, regions.forced, shown)
    together = torch.exp(-angles.double() / like.scale) + 1e-6 * torch.eye(views)
    turning = torch.linalg.cholesky(together).float()
    turning = torch.einsum("kvw,kwpd->kvpd", turning, torch.randn(count, views, PARTS + 1, dimension, generator=g))
    turning = turning / dimension**0.5
    static = torch.randn(len(thing), dimension, generator=g) / dimension**0.5
    whole = like.two_parts_one_view - like.two_parts
    constant = (
        like.two_things**0.5 * constant[0]
        + (like.two_parts - like.two_things) ** 0.5 * constant[1 + thing]
        + (like.far - like.two_parts) ** 0.5 * of_part[thing, part]
        + like.own * strength[thing, part, None] * words.classes[shown]
        + like.wrong * words.classes[worst[thing]]
    )
    changing = (
        whole**0.5 * turning[thing, regions.view, PARTS]
        + (like.near - like.far - whole) ** 0.5 * turning[thing, regions.view, part]
        + (1 - like.near) ** 0.5 * static
    )
    return normalize(constant + noise / NOISE * changing, dim=1)
