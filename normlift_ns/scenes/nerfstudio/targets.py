"""What a config.yml names and nothing here needs: classes and functions, known by their names alone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class Target:
    """A class or function that a config names, which is neither imported nor called."""

    name: str

    def __deepcopy__(self, memo: object) -> Target:
        """Itself, as a class is."""
        return self


TARGETS: dict[str, Target] = {}
"""One object per name, so that a dump refers to it as to one class."""


def named(name: str) -> Target:
    """The target of that name."""
    return TARGETS.setdefault(name, Target(name))


def target(name: str) -> Callable[[], Target]:
    """Makes the default of a field that names it."""
    return lambda: named(name)
