"""What an answer says of itself: how relevancies are spread, where to cut, and whether a prompt is in the scene."""

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
    """What the relevancies of one prompt say."""

    text: str
    colour: Colour
    """Of the prompt."""
    histogram: Histogram
    words: str
    """That it is probably not in the scene, or that nothing reaches the threshold, and where the scene is most like it;
    empty: something is selected that stands out, or nobody can tell."""
    nearest: tuple[float, float, float] | None = None
    """Where the scene is most like it, if there are words."""


def verdicts(state: State, *, most: int = 3) -> tuple[Verdict, ...]:
    """Of the prompts that select, the first `most` of them; none where the selection was made by hand."""
    answer = state.answer
    if answer is None or not state.from_answer:
        return ()
    colours = prompt_colours(answer.texts)
    which = range(len(answer.texts)) if state.shown is None else [state.shown]
    found = []
    for index in which[:most]:
        finding = Finding(answer, index)
        if finding.histogram is not None:
            words = _words(finding, finding.histogram)
            x = finding.nearest if words else None
            place = None if x is None else (x[0], x[1], x[2])
            found.append(Verdict(finding.text, colours[index], finding.histogram, words, place))
    return tuple(found)


def _words(finding: Finding, histogram: Histogram) -> str:
    if is_click(finding.text) or histogram.stands_out is None:
        return ""
    place = "" if finding.nearest is None else f" at {' '.join(f'{x:.2f}' for x in finding.nearest)}"
    if not histogram.stands_out:
        return (
            f"{finding.text}: probably not in this scene. The nearest match{place} has relevancy {histogram.top:.2f}; "
            f"things that are in a scene reach {histogram.limit:.2g} or more."
        )
    if finding.peak is None or bool(finding.mask.any()):
        return ""
    return (
        f"{finding.text}: nothing is above the threshold of {finding.answer.question.threshold:.2f}. "
        f"The nearest match{place} has relevancy {finding.peak:.2f}; lower the threshold, or press Suggested."
    )


def suggested(state: State) -> float | None:
    """The threshold that the histogram of the prompts that select suggests; None where there is none."""
    answer = state.answer
    if answer is None:
        return None
    if state.shown is not None:
        return Finding(answer, state.shown).suggested_threshold
    return suggested_threshold(answer.relevancy.cpu().numpy(), answer.valid.cpu().numpy())


def carried(state: State, question: Question) -> Question:
    """The next question with the threshold of the one before, where both go by the same rule.

    A question that asks for a suggested threshold gets one of its own, unless the person has chosen the one before.
    """
    before = state.question
    if before is None or (before.rule, _clicked(before)) != (question.rule, _clicked(question)):
        return question
    if question.suggest and before.threshold in (suggested(state), suggested(replace(state, shown=None))):
        return question
    return replace(question, threshold=before.threshold, suggest=False)


def _clicked(question: Question) -> bool:
    return all(is_click(text) for text in question.texts)
