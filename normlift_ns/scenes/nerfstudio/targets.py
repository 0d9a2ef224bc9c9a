"""Placeholders for classes and functions that a config.yml names and this package does not need."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class Target:
    """Name of a class or function in a config, which is neither imported nor called."""

    name: str

    def __deepcopy__(self, memo: object) -> Target:
        """Return the object itself, as for a class."""
        return self


_TARGETS: dict[str, Target] = {}
"""One object per name, which a dump references like a single class."""


def named(name: str) -> Target:
    """Return the target of this name, always the same object."""
    return _TARGETS.setdefault(name, Target(name))


def target(name: str) -> Callable[[], Target]:
    """Return a default factory for a field that names a target."""
    return lambda: named(name)
