"""Rules for the relevancy of Gaussians or pixels to prompts, for torch tensors and NumPy arrays.

This module imports torch only if it is called with tensors.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar, cast

import numpy as np
from jaxtyping import Bool, Float

from normlift_ns.core.arguments import check_arguments
from normlift_ns.errors import InputError
from normlift_ns.options import CANONICAL_NEGATIVES, RelevancyRule

ArrayT = TypeVar("ArrayT", bound=Any)
"""torch.Tensor or numpy.ndarray."""
TEMPERATURE = 10.0
"""Factor of the cosines inside LERF's softmax."""
PROMPT_BLOCK = 32
"""Number of prompts that are compared with all Gaussians at a time, which bounds the memory of a query."""
_SAMPLED = 16
"""Sampling step of `_largest`, which takes every 16th value as a sample."""
TOP_QUANTILE = 0.999
"""Quantile over Gaussians that defines the top relevancy of a prompt. It is robust to outliers."""
_LARGEST_COSINE = 1.01
"""Largest accepted absolute value of a cosine. In half precision, rounding errors of cosines are about 0.001."""
_PRESENT = 0.62
"""Relevancy by the rule "lerf" that prompts for objects in the scene usually reach."""


class RuleSettings(NamedTuple):
    """Formula and constants of a relevancy rule."""

    formula: Callable[[Any, Any, float], Any]
    """Function that returns the relevancy [..., Q].

    The arguments are the cosines to prompts [..., Q], the cosines to negatives [..., B] or the null level
    [..., 1], and the temperature.
    """
    threshold: float
    """Relevancy above which a Gaussian is selected."""
    needs_negatives: bool
    """True if the rule needs negative prompts. "contrast" needs null levels instead (`core.field.with_null_level`)."""
    no_direction: float
    """Relevancy of a Gaussian without a direction, which is never selected."""
    display_min: float
    """Lower end of the color scale of relevancy maps, which show smaller relevancies in the same color."""
    presence_limit: float | None
    """Smallest top relevancy for the verdict "found" (see `query.threshold.judge`); None if the rule has no limit."""


def _sigmoid(values: Any) -> Any:
    return 1 / (1 + _namespace(values).exp(-values))


def _margin(positive: Any, negative: Any) -> Any:
    return positive - _namespace(negative).amax(negative, -1, keepdims=True)


def _namespace(array: Any) -> Any:
    """Return the module for an array, numpy or torch. Both modules have the functions that are called here."""
    if isinstance(array, np.ndarray):
        return np
    import torch  # noqa: PLC0415 (a command-line query does not need it)

    return torch


# A softmax over two values is a sigmoid of their difference. It falls as the negative rises, so the minimum is at the
# largest negative. At the threshold, prompt and negative are equally similar.
_LERF = RuleSettings(
    lambda positive, negative, temperature: _sigmoid(temperature * _margin(positive, negative)),
    0.5,
    True,
    no_direction=0.0,
    display_min=0.0,
    presence_limit=_PRESENT,
)

RELEVANCY_RULES: dict[RelevancyRule, RuleSettings] = {
    # The null level of the Gaussian is the only negative.
    "contrast": _LERF._replace(needs_negatives=False),
    # The threshold suits the color encoder, and queries of unknown encoders; see `query.question.make_query`.
    "cosine": RuleSettings(
        lambda positive, _, __: positive, 0.5, False, no_direction=0.0, display_min=0.0, presence_limit=None
    ),
    "lerf": _LERF,
    # The threshold is that of the paper. The presence limit is the same lead over the negatives as for "lerf".
    "margin": RuleSettings(
        lambda positive, negative, _: _margin(positive, negative),
        0.02,
        True,
        no_direction=-2.0,
        display_min=-0.1,
        presence_limit=math.log(_PRESENT / (1 - _PRESENT)) / TEMPERATURE,
    ),
}


@check_arguments
def relevancy(
    positive: Float[ArrayT, "*n q"],
    negative: Float[ArrayT, "*n b"] | None = None,
    *,
    rule: RelevancyRule = "cosine",
    temperature: float = TEMPERATURE,
) -> Float[ArrayT, "*n q"]:
    """Compute the relevancy of Q prompts from cosines.

    Args:
        positive: Cosine to each prompt, as a tensor or NumPy array.
        negative: Cosine to each negative prompt (rules "lerf" and "margin"), or the null level (rule "contrast").
        rule: "contrast" is "lerf" with a null level [..., 1] as the only negative. "cosine" is the cosine itself, in
            -1..1. "lerf" is the smallest softmax of the prompt against one negative, in 0..1 (LERF, section 3.4). At
            0.5, prompt and negative are equally similar. "margin" is the cosine minus the largest cosine to a
            negative, in -2..2.
        temperature: Factor of the cosines inside the softmax, > 0.
    Raises:
        ValueError: If a cosine is outside -1..1 by more than 0.01, `temperature` is out of range, the rule is unknown,
            or the rule needs negatives and none are given.

    >>> import torch
    >>> from normlift_ns import relevancy
    >>> relevancy(torch.tensor([[0.3]]), torch.tensor([[0.1, 0.2]]), rule="margin")
    tensor([[0.1000]])
    """
    if not 0 < temperature < math.inf:
        raise InputError(f"temperature must be positive and finite, got {temperature}")
    for name, cosines in (("positive", positive), ("negative", negative)):
        _check_cosines(name, cosines)
    return _relevancy(positive, negative, rule, temperature)


def _check_cosines(name: str, cosines: Any) -> None:
    """Raise InputError if a value is outside -1..1 by more than 0.01."""
    if cosines is None or 0 in cosines.shape:
        return
    largest = float(abs(cosines).max())
    if not largest <= _LARGEST_COSINE:
        raise InputError(
            f"{name} must be cosines in -1..1, got an absolute value of {largest:.6g}; for unit directions [N, D] "
            "and unit texts [Q, D], pass directions @ texts.T, or use SemanticField.query"
        )


def _relevancy(positive: Any, negative: Any, rule: RelevancyRule, temperature: float) -> Any:
    if negative is not None and type(negative) is not type(positive):  # lists, or an array of the other module
        convert = np.asarray if isinstance(positive, np.ndarray) else _namespace(positive).as_tensor
        negative = cast(Any, convert(negative))
    if rule == "contrast" and (negative is None or negative.shape[-1] == 0):
        raise InputError(
            'rule "contrast" needs the null levels of a lift that compared the scene with unrelated words, got none; '
            'choose rule "cosine", or lift again if the lift is from an earlier version'
        )
    if RELEVANCY_RULES[rule].needs_negatives and (negative is None or negative.shape[-1] == 0):
        raise InputError(
            f'rule "{rule}" needs negative prompts, got none; '
            f"give at least one, for example {', '.join(CANONICAL_NEGATIVES)}"
        )
    return RELEVANCY_RULES[rule].formula(positive, negative, temperature)


def gaussian_relevancy(
    positive: Float[ArrayT, "n q"], negative: Float[ArrayT, "n b"], valid: Bool[ArrayT, " n"], rule: RelevancyRule
) -> Float[ArrayT, "n q"]:
    """Compute the relevancy of Gaussians. Those without a direction (not `valid`) get the rule's `no_direction`.

    Raises:
        ValueError: If the rule needs negatives or null levels, and none are given.
    """
    values = _relevancy(positive, negative, rule, TEMPERATURE)
    return _namespace(values).where(valid[:, None], values, RELEVANCY_RULES[rule].no_direction)


def top_values(values: Float[ArrayT, "n q"]) -> list[float]:
    """Return the interpolated 99.9 % quantile of each column of a matrix with at least one row.

    On a GPU, only these numbers are copied to the CPU.

    >>> top_values(np.arange(2001.0)[:, None])
    [1998.0]
    """
    place = TOP_QUANTILE * (len(values) - 1)
    count = len(values) - math.floor(place)
    if isinstance(values, np.ndarray):
        largest = np.stack([_largest(column, count) for column in values.T], axis=1)
        low, high = largest[0].astype(np.float64), largest[min(1, count - 1)].astype(np.float64)
    else:
        largest = values.topk(count, dim=0).values  # torch.quantile allows 16 million values
        low, high = largest[-1].double(), largest[max(count - 2, 0)].double()
    return (low + (high - low) * (place - math.floor(place))).tolist()


def _largest(values: Float[np.ndarray, " m"], count: int) -> Float[np.ndarray, " count"]:
    """Return the `count` largest values in ascending order.

    A sample gives a probable lower bound for them, so that usually only a few values are sorted.
    """
    sample = np.sort(values[::_SAMPLED])
    bound = sample[-min(len(sample), 2 * count // _SAMPLED + 8)]
    candidates = values[values >= bound]
    return np.sort(candidates if len(candidates) >= count else values)[-count:]
