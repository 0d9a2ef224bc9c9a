"""Diagnostics of a query: relevancy histograms, suggested thresholds, and prompts that may not be in the scene."""

from __future__ import annotations

from dataclasses import dataclass, replace

from normlift_ns.asking import Finding
from normlift_ns.insight.histogram import Histogram, suggested_threshold
from normlift_ns.question import Question
from normlift_ns.session.colours import Colour, prompt_colours
from normlift_ns.session.prompts import is_click
from normlift_ns.session.state import State


@dataclass(frozen=True, eq=False)
class Verdict:
    """Diagnostics of one prompt."""

    text: str
    """The prompt."""
    colour: Colour
    """Color of the prompt."""
    histogram: Histogram
    """Histogram of its relevancies."""
    words: str
    """Warning that the prompt is probably not in the scene, or that nothing reaches the threshold, with the nearest
    match; empty if a selected match stands out, or if presence cannot be judged."""
    nearest: tuple[float, float, float] | None = None
    """Position of the nearest match, if there is a warning."""


def verdicts(state: State, *, most: int = 3) -> tuple[Verdict, ...]:
    """Return the diagnostics of the first `most` prompts that select; none if the selection was made by hand."""
    answer = state.answer
    if answer is None or not state.from_answer:
        return ()
    colors = prompt_colours(answer.texts)
    prompts = range(len(answer.texts)) if state.shown is None else [state.shown]
    results = []
    for index in prompts[:most]:
        finding = Finding(answer, index)
        if finding.histogram is not None:
            warning = _warning(finding, finding.histogram)
            x = finding.nearest if warning else None
            position = None if x is None else (x[0], x[1], x[2])
            results.append(Verdict(finding.text, colors[index], finding.histogram, warning, position))
    return tuple(results)


def _warning(finding: Finding, histogram: Histogram) -> str:
    if is_click(finding.text) or histogram.stands_out is None:
        return ""
    position = "" if finding.nearest is None else f" at {' '.join(f'{x:.2f}' for x in finding.nearest)}"
    if not histogram.stands_out:
        return (
            f"{finding.text}: probably not in this scene. The nearest match{position} has relevancy "
            f"{histogram.top:.2f}; objects in a scene reach {histogram.limit:.2g} or more."
        )
    if finding.peak is None or bool(finding.mask.any()):
        return ""
    return (
        f"{finding.text}: nothing is above the threshold of {finding.answer.question.threshold:.2f}. "
        f"The nearest match{position} has relevancy {finding.peak:.2f}; lower the threshold, or press Suggested."
    )


def suggested(state: State) -> float | None:
    """Return the threshold suggested by the histogram of the prompts that select; None without a suggestion."""
    answer = state.answer
    if answer is None:
        return None
    if state.shown is not None:
        return Finding(answer, state.shown).suggested_threshold
    return suggested_threshold(answer.relevancy.cpu().numpy(), answer.valid.cpu().numpy())


def carried(state: State, question: Question) -> Question:
    """Return a new query with the threshold of the previous one, if both use the same rule.

    A query that asks for a suggested threshold keeps its own, unless the user has chosen the previous one.
    """
    previous = state.question
    if previous is None or (previous.rule, _only_clicks(previous)) != (question.rule, _only_clicks(question)):
        return question
    if question.suggest and previous.threshold in (suggested(state), suggested(replace(state, shown=None))):
        return question
    return replace(question, threshold=previous.threshold, suggest=False)


def _only_clicks(question: Question) -> bool:
    return all(is_click(text) for text in question.texts)
