"""Relevancy of Gaussians or pixels to text, by the three rules that people use."""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Bool, Float, Int32
from torch import Tensor

from normlift_ns.errors import InputError
from normlift_ns.options import CANONICAL_NEGATIVES, RULES, Rule


def _lead(positive: Tensor, negative: Tensor) -> Tensor:
    return positive - negative.max(dim=-1, keepdim=True).values


FORMULAS: dict[Rule, Callable[[Tensor, Tensor, float], Tensor]] = {
    "cosine": lambda positive, negative, temperature: positive,
    # A softmax over two is a sigmoid of the difference; it falls as the negative rises, so the minimum is at the
    # largest negative.
    "lerf": lambda positive, negative, temperature: torch.sigmoid(temperature * _lead(positive, negative)),
    "margin": lambda positive, negative, temperature: _lead(positive, negative),
}
"""Relevancy from cosines to prompts [..., Q] and to negatives [..., B]; `quick` has the same for numpy."""


def relevancy(
    positive: Float[Tensor, "*n q"],
    negative: Float[Tensor, "*n b"] | None = None,
    *,
    rule: Rule = "cosine",
    temperature: float = 10.0,
) -> Float[Tensor, "*n q"]:
    """Relevancy of Q prompts from cosines.

    Args:
        positive: cosine to each prompt.
        negative: cosine to each negative (rule "lerf") or background (rule "margin") prompt.
        rule: "cosine": the cosine itself, in -1..1. "lerf": softmax of prompt against one negative, the least over
            the negatives, in 0..1;
            0.5 is a draw (LERF, section 3.4). "margin": cosine minus the largest background cosine, in -2..2.
        temperature: factor of the cosines inside the softmax.
    Raises:
        ValueError: an unknown rule, or no negatives where the rule needs them.

    >>> import torch
    >>> from normlift_ns import relevancy
    >>> relevancy(torch.tensor([[0.3]]), torch.tensor([[0.1, 0.2]]), rule="margin")
    tensor([[0.1000]])
    """
    if rule not in FORMULAS:
        raise InputError(f"rule must be one of {', '.join(FORMULAS)}; got {rule!r}")
    negative = positive[..., :0] if negative is None else negative
    if RULES[rule].compares and negative.shape[-1] == 0:
        raise InputError(
            f'rule "{rule}" compares with negative prompts; '
            f"give at least one, for example {', '.join(CANONICAL_NEGATIVES)}"
        )
    return FORMULAS[rule](positive, negative, temperature)


def strongest(relevancy: Float[Tensor, "n q"], selected: Bool[Tensor, "n q"]) -> Int32[Tensor, " n"]:
    """Index of the selected prompt of largest relevancy, the first of equals; -1 where none is selected.

    >>> strongest(torch.tensor([[0.3, 0.9], [0.1, 0.2]]), torch.tensor([[True, True], [False, False]]))
    tensor([ 1, -1], dtype=torch.int32)
    """
    if relevancy.shape[1] == 0:
        return torch.full((len(relevancy),), -1, dtype=torch.int32, device=relevancy.device)
    best = relevancy.where(selected, -torch.inf).argmax(dim=1)
    return best.where(selected.any(dim=1), -1).int()
