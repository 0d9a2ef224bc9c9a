"""Relevancy of Gaussians or pixels to text, in the three forms that people use."""

from __future__ import annotations

from typing import Literal

import torch
from jaxtyping import Bool, Float, Int32
from torch import Tensor

RelevancyForm = Literal["cosine", "lerf", "margin"]

CANONICAL_NEGATIVES = ("object", "things", "stuff", "texture")
"""Negative prompts of LERF."""
BACKGROUND_WORDS = ("floor", "wall", "ceiling", "background", "object", "things", "stuff", "texture")
"""Background prompts of the LERF-OVS protocol (section "Mask thresholding" of the paper)."""


def relevancy(
    positive: Float[Tensor, "*n q"],
    negative: Float[Tensor, "*n b"] | None = None,
    *,
    form: RelevancyForm = "cosine",
    temperature: float = 10.0,
) -> Float[Tensor, "*n q"]:
    """Relevancy of Q prompts from cosines.

    Args:
        positive: cosine to each prompt.
        negative: cosine to each negative (form "lerf") or background (form "margin") prompt.
        form: "cosine": the cosine itself, in -1..1. "lerf": softmax of prompt against one negative, the least over
            the negatives, in 0..1;
            0.5 is a draw (LERF, section 3.4). "margin": cosine minus the largest background cosine, in -2..2.
        temperature: factor of the cosines inside the softmax.
    Raises:
        ValueError: an unknown form, or no negatives where the form needs them.

    >>> relevancy(torch.tensor([[0.3]]), torch.tensor([[0.1, 0.2]]), form="margin")
    tensor([[0.1000]])
    """
    if form == "cosine":
        return positive
    if form not in ("lerf", "margin"):
        raise ValueError(f'form must be "cosine", "lerf" or "margin", got {form!r}')
    if negative is None or negative.shape[-1] == 0:
        raise ValueError(
            f'relevancy form "{form}" compares with negative prompts; '
            f"give at least one, for example {', '.join(CANONICAL_NEGATIVES)}"
        )
    rival = negative.max(dim=-1, keepdim=True).values
    # A softmax over two is a sigmoid of the difference; it falls as the negative rises, so the minimum is at the
    # largest negative.
    return positive - rival if form == "margin" else torch.sigmoid(temperature * (positive - rival))


def strongest(relevancy: Float[Tensor, "n q"], selected: Bool[Tensor, "n q"]) -> Int32[Tensor, " n"]:
    """Index of the selected prompt of largest relevancy, the first of equals; -1 where none is selected.

    >>> strongest(torch.tensor([[0.3, 0.9], [0.1, 0.2]]), torch.tensor([[True, True], [False, False]]))
    tensor([ 1, -1], dtype=torch.int32)
    """
    if relevancy.shape[1] == 0:
        return torch.full((len(relevancy),), -1, dtype=torch.int32, device=relevancy.device)
    best = relevancy.where(selected, -torch.inf).argmax(dim=1)
    return best.where(selected.any(dim=1), -1).int()
