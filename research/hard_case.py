"""Definition of a hard case, and the bounds on its errors, which were fixed before anything was measured."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple


class Quantity(NamedTuple):
    """An error and its default bound, for cases without a bound of their own."""

    bound: float
    unit: str
    """Meaning of the number, in the words of the page."""


QUANTITIES = {
    "evidence": Quantity(1e-4, "share of the largest entry"),
    "evidence_double": Quantity(1e-12, "share of the largest entry"),
    "direction": Quantity(1e-5, "length, which bounds every cosine"),
    "direction_double": Quantity(1e-12, "length, which bounds every cosine"),
    "scalars": Quantity(1e-5, "absolute; relative for N_eff and W"),
    "scalars_double": Quantity(1e-12, "absolute; relative for N_eff and W"),
    "wrong": Quantity(0.0, "answers that are not the expected ones"),
}
"""Bounds for float32, which has seven digits: five digits of a cosine, and four of a sum over pixels, because a
threshold may include or exclude pixels. Of the sixteen digits of float64, twelve are required."""
DOUBLE = "_double"


@dataclass(frozen=True)
class Setting:
    """Device and size of a run."""

    device: str = "cpu"
    small: bool = False
    """True for the same cases with fewer numbers, for the tests."""

    @property
    def backends(self) -> tuple[str, ...]:
        """All backends of the device."""
        return ("torch", "numba") if self.device == "cpu" else ("torch", "gsplat", "triton")


@dataclass(frozen=True)
class Case:
    """A case with its expected result. `measure` returns its errors against float64, by the names of `QUANTITIES`."""

    key: str
    title: str
    expected: str
    seen: str
    """Effect that a user with such a scene sees."""
    measure: Callable[[Setting], Mapping[str, float]]
    bounds: Mapping[str, float] = field(default_factory=dict)
    """Bounds that differ from those of `QUANTITIES`, for the reason in `expected`."""

    def bound(self, quantity: str) -> float:
        """Return the largest accepted error."""
        return self.bounds.get(quantity, QUANTITIES[quantity].bound)

    def failures(self, errors: Mapping[str, float]) -> list[str]:
        """Return messages for the errors that exceed their bounds or are NaN."""
        return [
            f"{self.key}: {quantity} {error:.1e}, at most {self.bound(quantity):.1e}"
            for quantity, error in errors.items()
            if not error <= self.bound(quantity)
        ]
