"""Status text of the panel as MDX, which the viewer compiles."""

from __future__ import annotations

from jaxtyping import Bool, Float
from torch import Tensor

from normlift_ns.colors import prompt_colors
from normlift_ns.runs.splats import LEAST_OPACITY
from normlift_ns.session.state import State
from normlift_ns.viewer.legend import clipped
from normlift_ns.viewer.status import as_text, swatch

_MAX_TABLE_ROWS = 8


def drawable(opacities: Float[Tensor, "n 1"]) -> Bool[Tensor, " n"]:
    """Return the mask of Gaussians that are opaque enough to be drawn.

    Args:
        opacities: logits.
    """
    return opacities.detach()[:, 0] >= LEAST_OPACITY


def said(state: State, message: str, busy: str, drawn: Bool[Tensor, " n"]) -> str:
    """Return the status: running work, message, size of the selection, reasons for differing counts, and warnings.

    Args:
        busy: description of the running work; empty: none.
        drawn: mask of Gaussians, as from `drawable`.
    """
    lines = [as_text(text) for text in (busy, clipped(message, 400)) if text]
    selection = state.selection
    count, hidden = int(selection.sum()), 0 if state.hidden is None else int(state.hidden.sum())
    if state.question is None and count == 0:
        lines.append("No query yet.")
    else:
        lines.append(f"**{count:,}** of {len(state.space):,} Gaussians selected{state.by_hand}")
    faint = int((selection & ~drawn.to(selection.device)).sum())
    if faint > 0:
        lines.append(f"{faint:,} of them are never drawn or exported (opacity below 1/255).")
    if state.answer is not None and state.from_answer and state.shown is None:
        several = int((state.answer.selected.sum(dim=1) > 1).sum())
        if several > 0:
            lines.append(f"{several:,} of them are selected by several prompts.")
    if hidden > 0:
        lines.append(f"{hidden:,} Gaussians are hidden.")
    if state.remark:
        lines.append(as_text(state.remark))
    return "\n\n".join(lines)


def found_table(state: State) -> str:
    """Return a table with the color, count and highest relevancy of each prompt, or with the prompt's error."""
    answer = state.answer
    if len(state.prompts) == 0 or answer is None:
        return ""
    counts, valid = answer.selected.sum(dim=0).tolist(), answer.valid
    peaks = answer.relevancy[valid].amax(dim=0).tolist() if bool(valid.any()) else [0.0] * len(counts)
    colors = prompt_colors(answer.texts).tolist()
    rows = {text: (counts[i], peaks[i], colors[i]) for i, text in enumerate(answer.texts)}
    lines = [
        f"{as_text(answer.question.rule)} above {answer.question.threshold:g}",
        "",
        "| | prompt | selected | peak |",
        "|---|---|---|---|",
    ]
    failed = [prompt for prompt in state.prompts if prompt.problem]  # listed first, to be noticed
    listed = [*failed, *(prompt for prompt in state.prompts if not prompt.problem)][:_MAX_TABLE_ROWS]
    for prompt in listed:
        name = as_text(clipped(prompt.text, 40))
        if prompt.problem or prompt.text not in rows:
            lines.append(f"| ⚠ | {name} | {as_text(clipped(prompt.problem, 120))} | |")
            continue
        count, peak, color = rows[prompt.text]
        lines.append(f"| {swatch(color)} | {name} | {count:,} | {peak:.2f} |")
    if len(state.prompts) > len(listed):
        lines.append(f"| | and {len(state.prompts) - len(listed)} more | | |")
    return "\n".join(lines)
