"""Actions on the state of a session, and diagnostics of its query."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from normlift_ns.errors import InputError
from normlift_ns.options import WEAK_RELIABILITY
from normlift_ns.query.engine import Finding
from normlift_ns.query.question import Query, join_prompts
from normlift_ns.query.threshold import Histogram
from normlift_ns.rendering.colors import RGB, clip_text, prompt_rgb_tuples
from normlift_ns.session.prompts import Prompt, is_click
from normlift_ns.session.state import BY_HAND, Addition, Layer, State


@dataclass(frozen=True, eq=False)
class PromptDiagnostics:
    """Histogram and warning of one prompt."""

    text: str
    """The prompt."""
    color: RGB
    """Color of the prompt."""
    histogram: Histogram
    """Histogram of the relevancies of the prompt."""
    warning: str
    """Warning about the prompt; empty if there is none, and for clicks. If the encoder ignores some words, the warning
    lists those that it uses. If the verdict is "weak match" or "probably not here", the warning gives the largest
    relevancy and the position of the best match. Otherwise, if no Gaussian is selected, it names the setting to
    change."""
    nearest_position: tuple[float, float, float] | None = None
    """Position of the best match, if there is a warning; see `Finding.nearest`."""


def diagnose_prompts(state: State, *, max_prompts: int = 3) -> tuple[PromptDiagnostics, ...]:
    """Return diagnostics of the first `max_prompts` prompts that define the selection.

    Return () without a query, for a selection made by hand, or if no Gaussian has a direction.
    """
    answer = state.answer
    if answer is None or not state.prompts_select:
        return ()
    colors = prompt_rgb_tuples(answer.texts)
    prompts = range(len(answer.texts)) if state.shown is None else [state.shown]
    results = []
    for index in prompts[:max_prompts]:
        finding = Finding(answer, index)
        if finding.histogram is not None:
            warning = _warning(finding)
            x = finding.nearest if warning else None
            position = None if x is None else (x[0], x[1], x[2])
            results.append(PromptDiagnostics(finding.text, colors[index], finding.histogram, warning, position))
    return tuple(results)


def _warning(finding: Finding) -> str:
    if is_click(finding.text):
        return ""
    position = "" if finding.nearest is None else f", near {' '.join(f'{x:.2f}' for x in finding.nearest)}"
    read_as = "" if finding.read_as is None else f'{finding.text}: read as "{finding.read_as}". '
    if finding.verdict in ("weak match", "probably not here"):
        return read_as + f"{finding.text}: {finding.verdict}. The largest relevancy is {finding.peak:.2f}{position}."
    if finding.peak is None or bool(finding.mask.any()):
        return read_as.strip()
    question = finding.answer.question
    if question.min_reliability > 0 and finding.peak > question.threshold:
        return read_as + (
            f"{finding.text}: no Gaussian above the threshold of {question.threshold:.2f} has a reliability of at "
            f"least {question.min_reliability:.2f}. Lower the minimum reliability."
        )
    return read_as + (
        f"{finding.text}: no Gaussian is above the threshold of {question.threshold:.2f}. "
        f"The largest relevancy is {finding.peak:.2f}{position}. Lower the threshold, or press Use suggested."
    )


def threshold_suggestion(state: State) -> float | None:
    """Return the suggested threshold of the prompt `state.shown`, or of all prompts together if it is None.

    Return None without a query, or if no Gaussian has a direction.
    """
    if state.answer is None:
        return None
    result = state.answer if state.shown is None else Finding(state.answer, state.shown)
    return result.suggested_threshold


def carry_threshold(state: State, question: Query) -> Query:
    """Return `question` with the threshold of the current query, if both queries use the same rule.

    A query of clicks alone does not pass its threshold to a query with texts, or vice versa. If `question` asks for the
    suggested threshold and the current threshold is a suggested one, `question` is returned unchanged.
    """
    previous = state.query
    if previous is None or (previous.rule, _only_clicks(previous)) != (question.rule, _only_clicks(question)):
        return question
    if question.suggest_threshold and previous.threshold in (
        threshold_suggestion(state),
        threshold_suggestion(replace(state, shown=None)),
    ):
        return question
    return replace(question, threshold=previous.threshold, suggest_threshold=False, gated=previous.gated)


def _only_clicks(question: Query) -> bool:
    return all(is_click(text) for text in question.texts)


# User actions: each function takes a state and returns a new one, or the same state if nothing changes.
#
# An action that is not possible raises ValueError (`InputError`) with a message for the user.


ClickMode = Literal["select", "add", "remove"]
"""Effect of a click: select only the clicked object, add it to the selection, or remove it from the selection."""
MAX_LAYERS = 32
MAX_GROW_STEPS = 10
"""Maximum number of steps for growing or shrinking a selection."""
MIN_THRESHOLD, MAX_THRESHOLD = -0.2, 1.0
"""Range of the threshold slider."""
FLOATERS_HINT = "Likely floaters are selected. Check them, then press Hide. Undo shows them again."


def ask(state: State, prompts: Sequence[Prompt], question: Query | None) -> State:
    """Replace the query and the selection. Hidden Gaussians stay hidden.

    Args:
        prompts: All prompts, including those with errors.
        question: Query of these prompts, from `build_query`; None if no prompt has a vector. Nothing is then selected.
    Raises:
        ValueError: As in `run_query`.
    """
    did = f"Ask {join_prompts([prompt.text for prompt in prompts])}"
    return _with_suggested_threshold(replace(_unasked(state), prompts=tuple(prompts), query=question, action=did))


def update_query(state: State, question: Query | None, did: str) -> State:
    """Apply a query with the same prompts but different settings; return the same state if `question` is None.

    Changes that were made to the selection by hand are kept.
    """
    return state if question is None else _with_suggested_threshold(replace(state, query=question, action=did))


def _with_suggested_threshold(state: State) -> State:
    """Apply the suggested threshold if the query asks for it; raise ValueError if the query is not valid."""
    if state.answer is None or state.query is None or not state.query.suggest_threshold:
        return state
    return replace(state, query=state.answer.question)


def clear(state: State) -> State:
    """Remove the query and the selection. Hidden Gaussians stay hidden."""
    return replace(_unasked(state), action="Clear")


def _unasked(state: State) -> State:
    """Return the state without its query and selection."""
    state = replace(state, prompts=(), query=None, shown=None, prompts_select=True)
    return replace(state, added=None, removed=None, additions=(), grow_steps=0)


def set_threshold(state: State, value: float) -> State:
    """Set the threshold, the relevancy above which Gaussians are selected; clamp it to the range of the slider."""
    value = min(MAX_THRESHOLD, max(MIN_THRESHOLD, value))
    if state.query is None or value == state.query.threshold:
        return state
    question = replace(state.query, threshold=value, suggest_threshold=False, gated=False)
    return replace(state, query=question, action=f"Threshold {value:.3g}")


def use_suggested_threshold(state: State) -> State:
    """Set the threshold to the result of `threshold_suggestion`.

    Raises:
        ValueError: There is no suggestion.
    """
    value = threshold_suggestion(state)
    if value is None:
        raise InputError("There are no relevancies to suggest a threshold from. Type a prompt and press Ask.")
    return set_threshold(state, value)


def set_min_reliability(state: State, value: float) -> State:
    """Set the minimum reliability R of Gaussians that prompts select; clamp it to 0..1."""
    value = min(1.0, max(0.0, value))
    if state.query is None or value == state.query.min_reliability:
        return state
    return replace(state, query=replace(state.query, min_reliability=value), action=f"Reliability {value:.2g}")


def remove_weak(state: State) -> State:
    """Remove Gaussians with weak evidence from the selection, including those added by hand."""
    poor = state.selection & (state.space.field.scalars.reliability < WEAK_RELIABILITY)
    return remove(state, poor, "Leave out Gaussians with weak evidence")


def show_prompt(state: State, shown: int | None) -> State:
    """Select Gaussians by one prompt of the query, or by all prompts; this replaces a selection made by hand.

    Args:
        shown: Index of the prompt; None for all prompts. An index out of range changes nothing.
    """
    count = 0 if state.query is None else len(state.query.texts)
    if (shown == state.shown and state.prompts_select) or not 0 <= (shown or 0) < count:
        return state
    text = "all prompts" if shown is None or state.query is None else state.query.texts[shown]
    if not state.prompts_select:
        state = replace(state, prompts_select=True, added=None, removed=None, additions=(), grow_steps=0)
    return replace(state, shown=shown, action=f"Show {text}")


def set_color_mode(state: State, name: str) -> State:
    """Set the color mode of the viewer."""
    return state if name == state.color_mode else replace(state, color_mode=name, action=f"Draw {name}")


def pick_gaussian(state: State, weights: Float[Tensor, " n"]) -> int:
    """Return the index of the Gaussian with the largest weight on a ray, among drawn Gaussians with a direction.

    Raises:
        ValueError: The ray hits no such Gaussian.
    """
    weights = weights.where(state.space.field.valid(refined=state.refined) & state.drawn, 0.0)
    index = int(weights.argmax()) if len(weights) > 0 else 0
    if len(weights) == 0 or not float(weights[index]) > 0:
        raise InputError("This position has no Gaussian with semantics. Choose another position.")
    return index


def object_under(state: State, gaussian: int) -> Bool[Tensor, " n"]:
    """Return the mask of the object that contains a Gaussian.

    If an earlier step added the Gaussian with an object, the mask contains all Gaussians that this step added. Else, if
    a prompt selects the Gaussian, the object is a connected component of the selection of its most relevant prompt.
    This separates touching objects of different prompts. Otherwise, the mask is that of `SelectionContext.object_at`.
    """
    for one in reversed(state.additions):
        if bool(one.mask[gaussian]):
            return one.mask
    selection, answer = state.selection, state.answer
    if answer is not None and state.prompts_select and bool(selection[gaussian]):
        relevancy = answer.relevancy[gaussian].where(answer.selected[gaussian], -torch.inf)
        best = int(relevancy.argmax()) if state.shown is None else state.shown
        if bool(answer.selected[gaussian, best]):
            selection = selection & answer.selected[:, best]
    return state.space.object_at(gaussian, selection, refined=state.refined)


def click(state: State, weights: Float[Tensor, " n"], mode: ClickMode = "select") -> State:
    """Select, add or remove the clicked object; see `object_under`.

    Args:
        weights: Weights of the Gaussians on the ray of the click, from `rasterization.rasterize.ray_weights`.
    Raises:
        ValueError: As in `pick_gaussian`.
    """
    return change_objects(state, object_under(state, pick_gaussian(state, weights)), mode)


def change_objects(state: State, mask: Bool[Tensor, " n"], mode: ClickMode, text: str = BY_HAND) -> State:
    """Select, add or remove an object. A click that removes it later removes only the Gaussians added by this step.

    Args:
        text: Prompt of the object, or `BY_HAND`.
    """
    before = () if mode == "select" else state.additions
    new = mask if mode == "select" else mask & ~state.selection
    changed = change_selection(state, mask, mode, "an object" if text == BY_HAND else text)
    if mode == "remove" or not bool(new.any()):
        return changed
    return replace(changed, additions=(*before, Addition(text, new)))


def change_selection(state: State, mask: Bool[Tensor, " n"], mode: ClickMode, what: str) -> State:
    """Select Gaussians, add them to the selection, or remove them from it.

    Args:
        what: Description of the Gaussians for the history.
    """
    change = {"select": select, "add": add, "remove": remove}[mode]
    return change(state, mask, f"{mode.capitalize()} {what}")


def picked_direction(state: State, weights: Float[Tensor, " n"]) -> Float[np.ndarray, " d"]:
    """Return the direction of the clicked Gaussian, as the vector of a prompt whose text is from `click_name`.

    Args:
        weights: Weights of the Gaussians on the ray of the click.
    Raises:
        ValueError: As in `pick_gaussian`.
    """
    row = torch.tensor([pick_gaussian(state, weights)], device=state.space.means.device)
    return state.space.field.directions(row, refined=state.refined)[0].cpu().numpy()


def select(state: State, chosen: Bool[Tensor, " n"], did: str = "Select") -> State:
    """Select these Gaussians and no others."""
    change: dict[str, Any] = {"prompts_select": False, "removed": None, "grow_steps": 0}
    return replace(state, added=chosen, additions=(), action=did, **change)


def add(state: State, chosen: Bool[Tensor, " n"], did: str = "Add") -> State:
    """Add Gaussians to the selection. If it was grown or shrunk, the result no longer depends on prompts."""
    if state.grow_steps != 0:
        return replace(select(state, state.selection | chosen, did), additions=state.additions)
    removed = None if state.removed is None else state.removed & ~chosen
    added = chosen if state.added is None else state.added | chosen
    return replace(state, added=added, removed=removed, action=did)


def remove(state: State, chosen: Bool[Tensor, " n"], did: str = "Remove") -> State:
    """Remove Gaussians from the selection. If it was grown or shrunk, the result no longer depends on prompts."""
    additions = tuple(replace(one, mask=one.mask & ~chosen) for one in state.additions)
    additions = tuple(one for one in additions if bool(one.mask.any()))
    if state.grow_steps != 0:
        return replace(select(state, state.selection & ~chosen, did), additions=additions)
    removed = chosen if state.removed is None else state.removed | chosen
    return replace(state, removed=removed, additions=additions, action=did)


def invert(state: State) -> State:
    """Select all drawn Gaussians that are not selected."""
    return select(state, state.drawn & ~state.selection, "Invert the selection")


def select_floaters(state: State, floaters: Bool[Tensor, " n"]) -> State:
    """Select likely floaters.

    Args:
        floaters: Mask of the floaters, from `analysis.objects.find_floaters`.
    Raises:
        ValueError: The mask contains no Gaussian.
    """
    if not bool(floaters.any()):
        raise InputError("The scene has no likely floaters.")
    return select(state, floaters, "Select likely floaters")


def resize(state: State, steps: int) -> State:
    """Set the number of steps for growing (> 0) or shrinking (< 0) the selection, clamped to -10..10."""
    steps = max(-MAX_GROW_STEPS, min(MAX_GROW_STEPS, int(steps)))
    return state if steps == state.grow_steps else replace(state, grow_steps=steps, action=f"Grow {steps:+d}")


def hide(state: State, chosen: Bool[Tensor, " n"] | None = None) -> State:
    """Hide Gaussians in addition to those that are already hidden.

    Args:
        chosen: Mask of the Gaussians (default: the selection).
    Raises:
        ValueError: The mask contains no Gaussian.
    """
    chosen = state.selection if chosen is None else chosen
    if not bool(chosen.any()):
        raise InputError("Nothing is selected. First select the Gaussians to hide.")
    hidden = chosen if state.hidden is None else state.hidden | chosen
    return replace(state, hidden=hidden, action=f"Hide {int(chosen.sum()):,}")


def show_only(state: State, chosen: Bool[Tensor, " n"] | None = None) -> State:
    """Draw only these Gaussians, including hidden ones, but not those in hidden layers.

    Args:
        chosen: Mask of the Gaussians (default: the selection).
    Raises:
        ValueError: The mask contains no Gaussian.
    """
    chosen = state.selection if chosen is None else chosen
    if not bool(chosen.any()):
        raise InputError("Nothing is selected, so there is nothing to isolate.")
    return replace(state, hidden=~chosen, action=f"Only {int(chosen.sum()):,}")


def show_all(state: State) -> State:
    """Show all hidden Gaussians again, except those in hidden layers."""
    return state if state.hidden is None else replace(state, hidden=None, action="Show everything")


def add_layer(state: State, name: str) -> State:
    """Save the selection as a layer, replacing any layer with the same name.

    Raises:
        ValueError: Nothing is selected, the name is empty, or there are too many layers.
    """
    name = clip_text(name, 60)
    layers = tuple(layer for layer in state.layers if layer.name != name)
    if name == "":
        raise InputError("The layer has no name. Type a name.")
    if not bool(state.selection.any()):
        raise InputError("Nothing is selected. First select the Gaussians of the layer.")
    if len(layers) >= MAX_LAYERS:
        raise InputError(f"The maximum number of layers is {MAX_LAYERS}. First remove a layer.")
    return replace(state, layers=(*layers, Layer(name, state.selection)), action=f"Save layer {name}")


def show_layer(state: State, name: str, *, visible: bool) -> State:
    """Show or hide the Gaussians of a layer."""
    layer = find_layer(state, name)
    layers = tuple(replace(one, visible=visible) if one is layer else one for one in state.layers)
    return replace(state, layers=layers, action=f"{'Show' if visible else 'Hide'} layer {name}")


def remove_layer(state: State, name: str) -> State:
    """Remove a layer. If it was hidden, its Gaussians are drawn again, unless they are hidden for another reason."""
    layer = find_layer(state, name)
    return replace(state, layers=tuple(one for one in state.layers if one is not layer), action=f"Remove layer {name}")


def find_layer(state: State, name: str) -> Layer:
    """Return the layer with this name.

    Raises:
        ValueError: No layer has this name.
    """
    layer = next((layer for layer in state.layers if layer.name == name), None)
    if layer is None:
        raise InputError(f"This session has no layer {clip_text(name, 60)!r}. Choose one of the listed layers.")
    return layer
