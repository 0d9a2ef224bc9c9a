"""What a person can do: each action takes a state and returns another one, or the same where nothing changes.

All raise ValueError (`InputError`) with a message for the person where they cannot be done; the state stays then.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from normlift_ns.errors import InputError
from normlift_ns.question import Question
from normlift_ns.session.prompts import Prompt, join_prompts
from normlift_ns.session.space import Box
from normlift_ns.session.state import POOR, State
from normlift_ns.session.verdicts import suggested

Mode = Literal["select", "add", "take away"]
"""What a click does with the object that it meets."""
MOST_STEPS = 10
LOWEST, HIGHEST = -0.2, 1.0
"""Thresholds that a slider offers."""
LOOK_FIRST = "Likely floaters are selected. Look at them, then press Hide; Undo takes it back."


def ask(state: State, prompts: Sequence[Prompt], question: Question) -> State:
    """The answer to the prompts, as `pose` made a question of them. What is hidden stays hidden; clicks and cuts go.

    Raises:
        ValueError: vectors of another length than the field's.
    """
    did = f"Ask {join_prompts([prompt.text for prompt in prompts])}"
    return _settled(State(state.space, tuple(prompts), question, hidden=state.hidden, look=state.look, did=did))


def ask_again(state: State, question: Question | None, did: str) -> State:
    """The same prompts by another question: another rule, or refined features or not. Clicks and cuts stay."""
    return state if question is None else _settled(replace(state, question=question, did=did))


def _settled(state: State) -> State:
    """The state with the threshold that its question suggests; what is wrong with the question shows here."""
    if state.answer is None or state.question is None or not state.question.suggest:
        return state
    return replace(state, question=state.answer.question)


def clear(state: State) -> State:
    """No question and no selection. What is hidden stays hidden."""
    return State(state.space, hidden=state.hidden, look=state.look, did="Clear")


def threshold(state: State, value: float) -> State:
    """Another relevancy above which to select; one that the slider does not have becomes its end."""
    value = min(HIGHEST, max(LOWEST, value))
    if state.question is None or value == state.question.threshold:
        return state
    question = replace(state.question, threshold=value, suggest=False)
    return replace(state, question=question, did=f"Threshold {value:.3g}")


def suggest(state: State) -> State:
    """The threshold that the relevancies of the prompts that select suggest; ValueError where nothing is asked."""
    value = suggested(state)
    if value is None:
        raise InputError("No query yet; there is no threshold to suggest.")
    return threshold(state, value)


def min_reliability(state: State, value: float) -> State:
    """Another R, in 0..1, that what is selected by the prompts must have."""
    value = min(1.0, max(0.0, value))
    if state.question is None or value == state.question.min_reliability:
        return state
    return replace(state, question=replace(state.question, min_reliability=value), did=f"Reliability {value:.2g}")


def leave_out_poor(state: State) -> State:
    """Takes what is poorly evidenced out of the selection, clicks included."""
    poor = state.selection & (state.space.field.scalars.reliability < POOR)
    return take_away(state, poor, "Leave out what is poorly evidenced")


def show(state: State, shown: int | None) -> State:
    """Only one text of the question selects; None: all of them."""
    count = 0 if state.question is None else len(state.question.texts)
    if shown == state.shown or (shown is not None and not 0 <= shown < count):
        return state
    text = "all prompts" if shown is None or state.question is None else state.question.texts[shown]
    return replace(state, shown=shown, did=f"Show {text}")


def look(state: State, name: str) -> State:
    """Draws the same otherwise."""
    return state if name == state.look else replace(state, look=name, did=f"Draw {name}")


def met(state: State, weights: Float[Tensor, " n"]) -> int:
    """The Gaussian that weighs most on a ray, among those that are drawn and have a direction.

    Raises:
        ValueError: there is none.
    """
    seen = weights.where(state.space.field.valid(refined=state.refined) & state.drawn, 0.0)
    found = int(seen.argmax()) if len(seen) > 0 else 0
    if len(seen) == 0 or not float(seen[found]) > 0:
        raise InputError("There is nothing with semantics where you clicked.")
    return found


def click(state: State, weights: Float[Tensor, " n"], mode: Mode = "select") -> State:
    """Selects the connected object under a click, adds it, or takes it away; see `Space.object_at`.

    Args:
        weights: of the Gaussians on the ray, for instance by `raster.picking.ray_weights`.
    """
    gaussian = met(state, weights)
    found = state.space.object_at(gaussian, state.selection, refined=state.refined)
    if mode == "take away":
        return take_away(state, found, "Take away an object")
    return add(state, found, "Add an object") if mode == "add" else select(state, found, "Select an object")


def click_vector(state: State, weights: Float[Tensor, " n"]) -> Float[np.ndarray, " d"]:
    """The direction under a click, to ask for everything like it: the vector of a prompt `click_name(...)`."""
    row = torch.tensor([met(state, weights)], device=state.space.means.device)
    return state.space.field.directions(row, refined=state.refined)[0].cpu().numpy()


def select(state: State, chosen: Bool[Tensor, " n"], did: str = "Select") -> State:
    """Selects these Gaussians and no others."""
    return replace(state, from_answer=False, added=chosen, removed=None, steps=0, box=None, did=did)


def add(state: State, chosen: Bool[Tensor, " n"], did: str = "Add") -> State:
    """Adds Gaussians to the selection. The prompts and thresholds go on as they are, unless it was grown or cut."""
    if state.steps != 0 or state.box is not None:
        return select(state, state.selection | chosen, did)
    removed = None if state.removed is None else state.removed & ~chosen
    return replace(state, added=chosen if state.added is None else state.added | chosen, removed=removed, did=did)


def take_away(state: State, chosen: Bool[Tensor, " n"], did: str = "Take away") -> State:
    """Takes Gaussians out of the selection. The prompts and thresholds go on as they are, unless it was grown."""
    if state.steps != 0:
        return select(state, state.selection & ~chosen, did)
    return replace(state, removed=chosen if state.removed is None else state.removed | chosen, did=did)


def select_floaters(state: State, found: Bool[Tensor, " n"]) -> State:
    """Selects what likely floats, as `insight.floaters` has found it.

    Raises:
        ValueError: nothing.
    """
    if not bool(found.any()):
        raise InputError("There are no likely floaters.")
    return select(state, found, "Select likely floaters")


def resize(state: State, steps: int) -> State:
    """Grows (above 0) or shrinks (below) what is selected, from part to whole, by -10 to 10 steps in all."""
    steps = max(-MOST_STEPS, min(MOST_STEPS, int(steps)))
    return state if steps == state.steps else replace(state, steps=steps, did=f"Grow {steps:+d}")


def cut(state: State, box: Box | None) -> State:
    """Cuts the selection with a box; None: takes the box away."""
    if box == state.box:
        return state
    return replace(state, box=box, did="Remove the box" if box is None else "Cut with the box")


def hide(state: State, chosen: Bool[Tensor, " n"] | None = None) -> State:
    """Hides Gaussians beside those that are hidden already; None: the selection."""
    chosen = state.selection if chosen is None else chosen
    if not bool(chosen.any()):
        raise InputError("Nothing is selected. There is nothing to hide.")
    hidden = chosen if state.hidden is None else state.hidden | chosen
    return replace(state, hidden=hidden, did=f"Hide {int(chosen.sum()):,}")


def only(state: State, chosen: Bool[Tensor, " n"] | None = None) -> State:
    """Draws these Gaussians alone, hidden or not before; None: the selection."""
    chosen = state.selection if chosen is None else chosen
    if not bool(chosen.any()):
        raise InputError("Nothing is selected. The screen would be blank.")
    return replace(state, hidden=~chosen, did=f"Only {int(chosen.sum()):,}")


def show_all(state: State) -> State:
    """Nothing is hidden any more."""
    return state if state.hidden is None else replace(state, hidden=None, did="Show everything")
