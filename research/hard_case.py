"""What a hard case is, and the rule by which its errors pass or fail: written down before anything was measured."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple


class Quantity(NamedTuple):
    """An error, and the most that it may be where a case names no other bound."""

    bound: float
    unit: str
    """What the number is, in the words of the page."""


QUANTITIES = {
    "evidence": Quantity(1e-4, "share of the largest entry"),
    "evidence_double": Quantity(1e-12, "share of the largest entry"),
    "direction": Quantity(1e-5, "length, which bounds every cosine"),
    "direction_double": Quantity(1e-12, "length, which bounds every cosine"),
    "scalars": Quantity(1e-5, "absolute; relative for N_eff and W"),
    "scalars_double": Quantity(1e-12, "absolute; relative for N_eff and W"),
    "wrong": Quantity(0.0, "answers that are not the expected ones"),
}
"""float32 keeps seven digits. Five of a cosine, and four of a sum over pixels that a threshold may gain or lose, are
asked of it; twelve of the sixteen digits of float64.
"""
DOUBLE = "_double"


@dataclass(frozen=True)
class Setting:
    """Where and how large a case is run."""

    device: str = "cpu"
    small: bool = False
    """For the tests: the same case, with fewer numbers where there are many."""

    @property
    def backends(self) -> tuple[str, ...]:
        """All backends of the device."""
        return ("torch", "numba") if self.device == "cpu" else ("torch", "gsplat", "triton")


@dataclass(frozen=True)
class Case:
    """A case with what is expected of it. `measure` gives its errors against float64, by the names of QUANTITIES."""

    key: str
    title: str
    expected: str
    seen: str
    """What a person sees who has such a scene."""
    measure: Callable[[Setting], Mapping[str, float]]
    bounds: Mapping[str, float] = field(default_factory=dict)
    """Bounds other than those of QUANTITIES, for the reason that `expected` gives."""

    def bound(self, quantity: str) -> float:
        """The most that an error may be."""
        return self.bounds.get(quantity, QUANTITIES[quantity].bound)

    def failures(self, errors: Mapping[str, float]) -> list[str]:
        """What is not within its bound, NaN among it."""
        return [
            f"{self.key}: {quantity} {error:.1e}, at most {self.bound(quantity):.1e}"
            for quantity, error in errors.items()
            if not error <= self.bound(quantity)
        ]
