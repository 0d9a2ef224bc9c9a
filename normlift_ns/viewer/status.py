"""What the panel says about an answer, as text that the viewer compiles as MDX."""

from __future__ import annotations

from collections.abc import Sequence

from normlift_ns.asking import Answer
from normlift_ns.colors import prompt_colors
from normlift_ns.errors import visible
from normlift_ns.viewer.display import color_scale, selection
from normlift_ns.viewer.legend import clipped


def as_text(text: str) -> str:
    """Text that MDX shows as it is: whatever could be markup or code becomes a character reference, and what is not
    printed an escape.

    >>> as_text("a {b}")
    'a &#123;b&#125;'
    """
    return "".join(c if c.isalnum() or c == " " else f"&#{ord(c)};" for c in visible(text, keep="\n"))


def swatch(colour: Sequence[float]) -> str:
    """A square of a colour, RGB in 0..1, as MDX."""
    red, green, blue = (round(255 * x) for x in colour)
    return f'<span style={{{{color: "rgb({red},{green},{blue})"}}}}>■</span>'


def report(answer: Answer | None, shown: int | None) -> str:
    """How many Gaussians are selected, by each prompt with its colour in the segmentation, and the overlay's scale."""
    chosen = selection(answer, shown)
    if answer is None or chosen is None:
        return "No query yet."
    question, valid = answer.question, answer.valid
    relevancy = answer.relevancy.amax(dim=1) if shown is None else answer.relevancy[:, shown]
    low, high = color_scale(relevancy[valid], question.threshold)
    counts, colors = answer.selected.sum(dim=0).tolist(), prompt_colors(answer.texts).tolist()
    peaks = answer.relevancy[valid].amax(dim=0).tolist() if bool(valid.any()) else [0.0] * len(counts)
    total = len(chosen)
    lines = [
        f"**{int(chosen.sum()):,}** of {total:,} Gaussians selected",
        "",
        f"{question.rule} above {question.threshold:g}, overlay colours {low:.2f} to {high:.2f}",
        "",
        "| | prompt | selected | peak |",
        "|---|---|---|---|",
    ]
    for text, count, peak, color in zip(answer.texts, counts, peaks, colors):
        lines.append(f"| {swatch(color)} | {as_text(clipped(text, 40))} | {count:,} | {peak:.2f} |")
    return "\n".join(lines)
