"""Objects of a selection: a row for each, with what a panel shows and what its buttons need."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from normlift_ns.objects import connected_components
from normlift_ns.options import MIN_SIZE
from normlift_ns.session.colours import Colour, prompt_colours
from normlift_ns.session.state import POOR, State

_STRONG = 0.8
"""R from which on evidence is strong."""
_BY_HAND = "selected by hand"
_BY_HAND_COLOR = (1.0, 0.75, 0.1)


@dataclass(frozen=True, eq=False)
class FoundObject:
    """One object: a connected component of the Gaussians that one prompt selects."""

    text: str
    """The prompt."""
    number: int
    """1 for the largest object of its prompt."""
    colour: Colour
    """Color of the prompt, for the swatch."""
    mask: Bool[Tensor, " n"]
    """Gaussians of the object, for the buttons only, hide and export."""
    size: int
    """Number of Gaussians."""
    reliability: float
    """Mean R, weighted by the total evidence of each Gaussian."""
    views: float
    """Mean N_eff, weighted in the same way."""
    centre: tuple[float, float, float]
    """Point that the camera looks at, for the button go to."""
    extent: float
    """Diagonal of the box around the central 90 % of the Gaussian centers, for the button go to."""

    @property
    def name(self) -> str:
        """The prompt and the number. `core.files.file_name` makes a file name of it."""
        return f"{self.text} {self.number}"

    @property
    def evidence(self) -> str:
        """Strength of the evidence in words, with R and the number of views."""
        grade = "strong" if self.reliability >= _STRONG else "fair" if self.reliability >= POOR else "weak"
        return f"{grade} evidence (R {self.reliability:.2f}, {self.views:.1f} views)"


@dataclass(frozen=True, eq=False)
class Found:
    """The objects of a selection."""

    objects: tuple[FoundObject, ...]
    """Listed objects, by prompt, the largest first."""
    left_out: int
    """Number of objects that are large enough but not listed, because there are too many."""
    in_smaller_parts: int
    """Number of Gaussians in components too small to be objects."""


def found_objects(state: State, *, most: int = 12, min_size: int = MIN_SIZE) -> Found:
    """Return the objects that are selected and drawn, of each prompt that selects or of the selection by hand.

    Args:
        most: largest number of objects listed; each prompt gets its largest object before any gets a second.
        min_size: fewest Gaussians of an object; those in smaller components are only counted.
    """
    selected, answer = state.selection & state.drawn, state.answer
    if answer is None or not state.from_answer:
        groups = [(_BY_HAND, _BY_HAND_COLOR, selected)]
    else:
        prompts = range(len(answer.texts)) if state.shown is None else [state.shown]
        colors = prompt_colours(answer.texts)
        groups = [(answer.texts[q], colors[q], selected & answer.selected[:, q]) for q in prompts]
    rows, small = [], 0
    for group, (text, color, mask) in enumerate(groups):
        labels = connected_components(state.space.means, mask)
        sizes = torch.bincount(labels[labels >= 0].long()).tolist()
        count = sum(size >= min_size for size in sizes)
        small += sum(sizes[count:])
        rows += [(number, group, text, color, labels, size) for number, size in enumerate(sizes[:count])]
    listed = sorted(sorted(rows, key=lambda row: row[:2])[:most], key=lambda row: (row[1], row[0]))
    objects = [_object(state, text, n, color, labels == n, size) for n, _, text, color, labels, size in listed]
    return Found(tuple(objects), len(rows) - len(listed), small)


def _object(state: State, text: str, number: int, color: Colour, mask: Tensor, size: int) -> FoundObject:
    scalars = state.space.field.scalars
    weight = scalars.weight[mask].double() + 1e-12
    weight = weight / weight.sum()
    means = state.space.means[mask].double()
    center = (weight[:, None] * means).sum(dim=0).tolist()
    low, high = np.quantile(means.cpu().numpy(), (0.05, 0.95), axis=0)
    reliability, views = (float((weight * x[mask].double()).sum()) for x in (scalars.reliability, scalars.n_eff))
    extent = float(np.linalg.norm(high - low))
    return FoundObject(text, number + 1, color, mask, size, reliability, views, tuple(center), extent)
