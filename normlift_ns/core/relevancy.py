"""Relevancy of Gaussians or pixels to text, by three common rules."""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Bool, Float, Int32
from torch import Tensor

from normlift_ns.errors import InputError
from normlift_ns.options import CANONICAL_NEGATIVES, RELEVANCY_RULES, RelevancyRule


def _margin(positive: Tensor, negative: Tensor) -> Tensor:
    return positive - negative.max(dim=-1, keepdim=True).values


RELEVANCY_FORMULAS: dict[RelevancyRule, Callable[[Tensor, Tensor, float], Tensor]] = {
    "cosine": lambda positive, negative, temperature: positive,
    # A softmax over two values is a sigmoid of their difference. It falls as the negative rises, so the minimum is at
    # the largest negative.
    "lerf": lambda positive, negative, temperature: torch.sigmoid(temperature * _margin(positive, negative)),
    "margin": lambda positive, negative, temperature: _margin(positive, negative),
}
"""Relevancy from cosines to prompts [..., Q] and to negatives [..., B]; `query.arrays` has them for NumPy."""


def relevancy(
    positive: Float[Tensor, "*n q"],
    negative: Float[Tensor, "*n b"] | None = None,
    *,
    rule: RelevancyRule = "cosine",
    temperature: float = 10.0,
) -> Float[Tensor, "*n q"]:
    """Compute the relevancy of Q prompts from cosines.

    Args:
        positive: cosine to each prompt.
        negative: cosine to each negative (rule "lerf") or background (rule "margin") prompt.
        rule: "cosine" is the cosine itself, in -1..1. "lerf" is the softmax of the prompt against one negative, in
            0..1, at its minimum over the negatives; 0.5 is a draw (LERF, section 3.4). "margin" is the cosine minus
            the largest background cosine, in -2..2.
        temperature: factor of the cosines inside the softmax.
    Raises:
        ValueError: if the rule is unknown, or needs negatives and there are none.

    >>> import torch
    >>> from normlift_ns import relevancy
    >>> relevancy(torch.tensor([[0.3]]), torch.tensor([[0.1, 0.2]]), rule="margin")
    tensor([[0.1000]])
    """
    if rule not in RELEVANCY_FORMULAS:
        raise InputError(f"rule must be one of {', '.join(RELEVANCY_FORMULAS)}; got {rule!r}")
    negative = positive[..., :0] if negative is None else negative
    if RELEVANCY_RULES[rule].compares and negative.shape[-1] == 0:
        raise InputError(
            f'rule "{rule}" compares with negative prompts; '
            f"give at least one, for example {', '.join(CANONICAL_NEGATIVES)}"
        )
    return RELEVANCY_FORMULAS[rule](positive, negative, temperature)


def best_prompt(relevancy: Float[Tensor, "n q"], selected: Bool[Tensor, "n q"]) -> Int32[Tensor, " n"]:
    """Return the index of the selected prompt with the largest relevancy, or -1 if none is selected.

    Ties go to the first prompt.

    >>> best_prompt(torch.tensor([[0.3, 0.9], [0.1, 0.2]]), torch.tensor([[True, True], [False, False]]))
    tensor([ 1, -1], dtype=torch.int32)
    """
    if relevancy.shape[1] == 0:
        return torch.full((len(relevancy),), -1, dtype=torch.int32, device=relevancy.device)
    best = relevancy.where(selected, -torch.inf).argmax(dim=1)
    return best.where(selected.any(dim=1), -1).int()
