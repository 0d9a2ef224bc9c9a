"""What tensors must be: nonsense is refused where it is given, and not found in an answer later."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from normlift_ns.core.sparse import CHUNK_ELEMENTS
from normlift_ns.errors import InputError

_OFF = 1e-2
"""How far the length of a unit row may be off, which half precision and files need."""


def check_tensors(**given: Any) -> None:
    """Every argument must be a tensor.

    Raises:
        ValueError: one is not; the message names it.

    >>> try:
    ...     check_tensors(means=[[0.0, 0.0, 0.0]])
    ... except ValueError as error:
    ...     print(error)
    means must be a torch tensor, got list; torch.as_tensor makes one
    """
    for name, value in given.items():
        if not isinstance(value, Tensor):
            raise InputError(f"{name} must be a torch tensor, got {type(value).__name__}; torch.as_tensor makes one")


def check_unit_rows(
    rows: Float[Tensor, "m d"], what: str, advice: str, *, zeros: bool = False
) -> Float64[Tensor, " m"]:
    """The lengths of unit rows.

    Args:
        what: names the rows in the message, "feature rows".
        advice: what to do about others.
        zeros: rows of zeros are allowed too.
    Raises:
        ValueError: rows of another length, or that are not finite; the message tells how many and shows three.

    >>> check_unit_rows(torch.tensor([[0.6, 0.8]]), "feature rows", "normalise them").round(decimals=6)
    tensor([1.], dtype=torch.float64)
    """
    blocks = rows.split(max(1, CHUNK_ELEMENTS // max(1, rows.shape[1])))  # rows in float64 would double the memory
    length = torch.cat([torch.linalg.vector_norm(block, dim=1, dtype=torch.float64) for block in blocks])
    good = (length - 1).abs() < _OFF
    bad = (~(good | (length == 0) if zeros else good)).nonzero().squeeze(1)
    if bad.numel() > 0:
        shown = ", ".join(f"row {i} has length {length[i]:.3g}" for i in bad[:3].tolist())
        raise InputError(f"{bad.numel():,} of {len(rows):,} {what} are not unit vectors ({shown}); {advice}")
    return length


def check_not_negative(name: str, values: Tensor) -> None:
    """All values must be finite and at least 0.

    Raises:
        ValueError: some are not; the message shows the first.

    >>> check_not_negative("reliability", torch.tensor([0.0, 1.0]))
    """
    bad = (~((values >= 0) & values.isfinite())).nonzero()
    if len(bad) > 0:
        first = int(bad[0, 0])
        raise InputError(
            f"{len(bad):,} of {values.numel():,} values of {name} are not finite and >= 0: {name}[{first}] is "
            f"{float(values[first]):g}"
        )
