"""Validation of tensor arguments: invalid input raises an error instead of producing a wrong result."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from normlift_ns.core.sparse import CHUNK_ELEMENTS
from normlift_ns.errors import InputError

_LENGTH_TOLERANCE = 1e-2
"""Accepted deviation of the length of a unit row from 1, which half precision and files need."""


def check_tensors(**arguments: Any) -> None:
    """Raise if an argument is not a tensor.

    Raises:
        ValueError: if one is not; the message names it.

    >>> try:
    ...     check_tensors(means=[[0.0, 0.0, 0.0]])
    ... except ValueError as error:
    ...     print(error)
    means must be a torch tensor, got list; torch.as_tensor makes one
    """
    for name, value in arguments.items():
        if not isinstance(value, Tensor):
            raise InputError(f"{name} must be a torch tensor, got {type(value).__name__}; torch.as_tensor makes one")


def check_unit_rows(
    rows: Float[Tensor, "m d"], name: str, advice: str, *, allow_zeros: bool = False
) -> Float64[Tensor, " m"]:
    """Return the lengths of rows, and raise unless all are unit vectors.

    Args:
        name: name of the rows in the message, for example "feature rows".
        advice: remedy that the message suggests.
        allow_zeros: accept rows of zeros too.
    Raises:
        ValueError: if rows have another length or are not finite; the message counts them and shows three.

    >>> check_unit_rows(torch.tensor([[0.6, 0.8]]), "feature rows", "normalize them").round(decimals=6)
    tensor([1.], dtype=torch.float64)
    """
    blocks = rows.split(max(1, CHUNK_ELEMENTS // max(1, rows.shape[1])))  # rows in float64 would double the memory
    length = torch.cat([torch.linalg.vector_norm(block, dim=1, dtype=torch.float64) for block in blocks])
    good = (length - 1).abs() < _LENGTH_TOLERANCE
    bad = (~(good | (length == 0) if allow_zeros else good)).nonzero().squeeze(1)
    if bad.numel() > 0:
        examples = ", ".join(f"row {i} has length {length[i]:.3g}" for i in bad[:3].tolist())
        raise InputError(f"{bad.numel():,} of {len(rows):,} {name} are not unit vectors ({examples}); {advice}")
    return length


def check_not_negative(name: str, values: Tensor) -> None:
    """Raise if a value is negative or not finite.

    Raises:
        ValueError: if there are such values; the message counts them and shows the first.

    >>> check_not_negative("reliability", torch.tensor([0.0, 1.0]))
    """
    bad = (~((values >= 0) & values.isfinite())).nonzero()
    if len(bad) > 0:
        first = int(bad[0, 0])
        raise InputError(
            f"{len(bad):,} of {values.numel():,} values of {name} are negative or not finite: {name}[{first}] is "
            f"{float(values[first]):g}"
        )
