"""What a state looks like: a colour for every Gaussian, and a legend in words and colours."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Literal, get_args

import numpy as np
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from normlift_ns.session.colours import prompt_colours
from normlift_ns.session.state import State
from normlift_ns.viewer.records import Records

Look = Literal["colours", "overlay", "prompts", "reliability"]
LOOKS: tuple[Look, ...] = get_args(Look)
"""colours: the scene itself. overlay: relevancy of what is selected. prompts: the colour of the most relevant prompt.
reliability: R, on a fixed scale."""
_MAP = "viridis"
_HAND = (1.0, 0.75, 0.1)
_LEAST_SPAN = 0.05
_FAINT, _SEEN = 64, 160
"""Opacities of 255: a selection whose median is below the first is drawn with the second."""
_WEAKEST = 0.45
"""Opacity of the overlay at the threshold; it is 1 at the best match."""


def painted(records: Records, state: State) -> tuple[UInt8[np.ndarray, "m 3"], Bool[np.ndarray, " m"]]:
    """Colours of the records, and which of them are drawn."""
    rows = records.rows
    drawn = _array(state.drawn)[rows]
    colours = records.colours
    if state.look == "reliability":
        return _ramp(_array(state.space.field.scalars.reliability)[rows]), drawn
    if state.look == "colours":
        return colours, drawn
    chosen = _array(state.selection)[rows]
    grey = np.repeat((colours @ np.array([0.3, 0.59, 0.11]) * 0.8).astype(np.uint8)[:, None], 3, axis=1)
    share, over = _overlay(state, rows) if state.look == "overlay" else _prompts(state, rows)
    mixed = (1 - share[:, None]) * grey + share[:, None] * over
    return np.where(chosen[:, None], mixed.round().astype(np.uint8), grey), drawn


def opacities(records: Records, state: State) -> UInt8[np.ndarray, " m"]:
    """Opacities of the records: their own, but what is selected by hand and faint, such as floaters, is drawn so that
    it can be seen.
    """
    chosen = _array(state.selection)[records.rows]
    by_hand = state.look == "overlay" and (state.answer is None or not state.from_answer)
    if not by_hand or not chosen.any() or np.median(records.alpha[chosen]) >= _FAINT:
        return records.alpha
    return np.where(chosen, np.maximum(records.alpha, _SEEN), records.alpha).astype(np.uint8)


def coloured(state: State) -> State:
    """The state, with what is selected in colours where it would not be seen."""
    return replace(state, look="overlay") if state.look == "colours" else state


def scale(state: State) -> tuple[float, float]:
    """Relevancies of the first and the last colour of the overlay: the threshold, and the best match in the scene."""
    answer = state.answer
    if answer is None:
        return 0.0, 1.0
    relevancy = answer.relevancy[answer.valid]
    relevancy = relevancy if state.shown is None else relevancy[:, state.shown]
    low = answer.question.threshold
    return low, max(float(relevancy.max()) if relevancy.numel() > 0 else low, low + _LEAST_SPAN)


def legend(state: State) -> str:
    """As MDX: a bar of the colours with the numbers at its ends; empty where colours are those of the scene, or
    say only that something is selected.
    """
    by_hand = state.answer is None or not state.from_answer
    if state.look in ("colours", "prompts") or (state.look == "overlay" and by_hand):
        return ""
    low, high, what = (0.0, 1.0, "reliability R") if state.look == "reliability" else (*scale(state), "relevancy")
    stops = ",".join(f"rgb({r},{g},{b})" for r, g, b in _ramp(np.linspace(0, 1, 6)).tolist())
    style = f'{{{{background: "linear-gradient(to right,{stops})", height: "0.6em", borderRadius: "3px"}}}}'
    return f"<div style={style}></div>\n\n{low:.2f} {what} {high:.2f}"


def _overlay(state: State, rows: np.ndarray) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, "m 3"]]:
    if state.answer is None or not state.from_answer:
        return np.ones(len(rows)), np.broadcast_to(np.array(_HAND) * 255, (len(rows), 3))
    answer = state.answer
    relevancy = _array(answer.relevancy.amax(dim=1) if state.shown is None else answer.relevancy[:, state.shown])[rows]
    low, high = scale(state)
    step = ((relevancy - low) / (high - low)).clip(0, 1)
    return _WEAKEST + (1 - _WEAKEST) * step, _ramp(step).astype(float)


def _prompts(state: State, rows: np.ndarray) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, "m 3"]]:
    colours = np.array([_HAND])
    best = np.zeros(len(rows), int)
    if state.answer is not None and state.from_answer:
        colours = np.array(prompt_colours(state.answer.texts))
        relevancy = state.answer.relevancy.where(state.answer.selected, -9.0)
        best = _array(relevancy.argmax(dim=1))[rows] if state.shown is None else np.full(len(rows), state.shown)
    return np.full(len(rows), 0.85), colours[best] * 255


def _ramp(values: np.ndarray) -> UInt8[np.ndarray, "m 3"]:
    return _colour_map()[(np.nan_to_num(values).clip(0, 1) * 255).round().astype(int)]


@cache
def _colour_map() -> UInt8[np.ndarray, "256 3"]:
    from matplotlib import colormaps  # noqa: PLC0415 (--help should not wait for it)

    return (colormaps[_MAP](np.arange(256))[:, :3] * 255).round().astype(np.uint8)


def _array(values: Tensor) -> np.ndarray:
    return values.detach().cpu().numpy()
