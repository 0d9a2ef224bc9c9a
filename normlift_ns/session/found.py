"""Found objects: a row for each, with what a panel shows of it and what its buttons need."""

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

_WELL = 0.8
_BY_HAND = "selected by hand"
_HAND_COLOUR = (1.0, 0.75, 0.1)


@dataclass(frozen=True, eq=False)
class FoundObject:
    """One object: what hangs together of what one prompt selects."""

    text: str
    """The prompt."""
    number: int
    """1 for the largest object of its prompt."""
    colour: Colour
    """Of its swatch, that of the prompt."""
    mask: Bool[Tensor, " n"]
    """For [only], [hide] and [export]."""
    size: int
    """Number of Gaussians."""
    reliability: float
    """Mean R, weighted by what the views saw of each Gaussian."""
    views: float
    """Mean N_eff, weighted likewise."""
    centre: tuple[float, float, float]
    """For [go to]: what the camera looks at."""
    extent: float
    """For [go to]: diagonal of the box that holds the central 90 % of the centres."""

    @property
    def name(self) -> str:
        """The prompt and the number.

        For the name of a file, pass it through `core.files.file_name`.
        """
        return f"{self.text} {self.number}"

    @property
    def evidence(self) -> str:
        """In words."""
        grade = "well" if self.reliability >= _WELL else "fairly" if self.reliability >= POOR else "poorly"
        return f"{grade} evidenced (R {self.reliability:.2f}, {self.views:.1f} views)"


@dataclass(frozen=True, eq=False)
class Found:
    """The objects of a selection."""

    objects: tuple[FoundObject, ...]
    """By prompt, the largest first."""
    left_out: int
    """Objects that are large enough, but too many to be listed."""
    in_smaller_parts: int
    """Gaussians of parts too small to be objects."""


def found_objects(state: State, *, most: int = 12, min_size: int = MIN_SIZE) -> Found:
    """The objects of what is selected and drawn: of each prompt that selects, or of what was selected by hand.

    Args:
        most: objects listed in all; every prompt gets its largest before any gets a second.
        min_size: Gaussians of smaller parts are only counted.
    """
    chosen, answer = state.selection & state.drawn, state.answer
    if answer is None or not state.from_answer:
        groups = [(_BY_HAND, _HAND_COLOUR, chosen)]
    else:
        which = range(len(answer.texts)) if state.shown is None else [state.shown]
        colours = prompt_colours(answer.texts)
        groups = [(answer.texts[q], colours[q], chosen & answer.selected[:, q]) for q in which]
    rows, small = [], 0
    for group, (text, colour, mask) in enumerate(groups):
        labels = connected_components(state.space.means, mask)
        sizes = torch.bincount(labels[labels >= 0].long()).tolist()
        listed = sum(size >= min_size for size in sizes)
        small += sum(sizes[listed:])
        rows += [(number, group, text, colour, labels, size) for number, size in enumerate(sizes[:listed])]
    kept = sorted(sorted(rows, key=lambda row: row[:2])[:most], key=lambda row: (row[1], row[0]))
    objects = [_object(state, text, n, colour, labels == n, size) for n, _, text, colour, labels, size in kept]
    return Found(tuple(objects), len(rows) - len(kept), small)


def _object(state: State, text: str, number: int, colour: Colour, mask: Tensor, size: int) -> FoundObject:
    scalars = state.space.field.scalars
    weight = scalars.weight[mask].double() + 1e-12
    weight = weight / weight.sum()
    places = state.space.means[mask].double()
    centre = (weight[:, None] * places).sum(dim=0).tolist()
    low, high = np.quantile(places.cpu().numpy(), (0.05, 0.95), axis=0)
    reliability, views = (float((weight * x[mask].double()).sum()) for x in (scalars.reliability, scalars.n_eff))
    extent = float(np.linalg.norm(high - low))
    return FoundObject(text, number + 1, colour, mask, size, reliability, views, tuple(centre), extent)
