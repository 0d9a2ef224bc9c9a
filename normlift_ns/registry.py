"""Registry of the plugins of this package and of other packages.

Every plugin is an entry point, whose package is imported only when the plugin is requested. This module imports no
heavy package.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from importlib.metadata import EntryPoint, distributions
from typing import Generic, TypeVar

from normlift_ns.errors import InputError, summarize_error, truncate_text

Plugin = TypeVar("Plugin")


@dataclass(frozen=True)
class Registry(Generic[Plugin]):
    """Plugins of one type, by name. Built-in plugins take precedence over plugins of other packages."""

    group: str
    """Entry point group."""
    built_in: Mapping[str, str]
    """Entry points of built-in plugins by name, as in pyproject.toml. They are repeated here for source trees that are
    not installed, or whose installation is older than a plugin."""
    plugin: type[Plugin]
    noun: str
    """Noun for a plugin in messages, such as "encoder"."""
    flag: str
    """Command-line option that selects a plugin."""
    default: str
    """Value of `flag` that messages suggest as an alternative."""

    def names(self) -> list[str]:
        """Return the names of all plugins in alphabetical order, including those that fail to load."""
        return sorted({*self.built_in, *installed_names(self.group)})

    def load(self, name: str) -> Plugin:
        """Import and return the plugin with this name.

        Raises:
            InputError: The name is unknown, two packages register it, or its entry point cannot be loaded or is not a
                plugin of this type.
        """
        point = self._find(name)
        advice = f"such as {self.flag} {self.default}"
        try:
            plugin = point.load()
        except (Exception, SystemExit) as error:  # importing a third-party module may raise anything
            raise InputError(
                f"{self.noun} {name!r} of {_package(point)} cannot be loaded ({summarize_error(error)}); repair "
                f"that package, or use another {self.noun}, {advice}"
            ) from error
        if not isinstance(plugin, self.plugin):
            raise InputError(
                f"{self.noun} {name!r} of {_package(point)} is invalid: {point.value} is of type "
                f"{type(plugin).__name__}, expected {self.plugin.__name__}; use another {self.noun}, {advice}"
            )
        return plugin

    def _find(self, name: str) -> EntryPoint:
        """Return the entry point with this name; raise InputError if there is none, or more than one."""
        if name in self.built_in:
            return EntryPoint(name, self.built_in[name], self.group)
        points = {point.value: point for point in _entry_points(self.group, tuple(sys.path)) if point.name == name}
        if len(points) == 0:
            known = ", ".join(self.names())
            raise InputError(f"unknown {self.noun} {truncate_text(name)!r}; {self.flag} must be one of {known}")
        if len(points) > 1:
            packages = " and ".join(f"{_package(point)} ({value})" for value, point in points.items())
            raise InputError(f"{self.noun} {name!r} is registered by {packages}; uninstall all but one of them")
        return next(iter(points.values()))


def installed_names(group: str) -> list[str]:
    """Return the names that installed packages register in an entry point group, in alphabetical order."""
    return sorted({point.name for point in _entry_points(group, tuple(sys.path))})


@cache
def _entry_points(group: str, path: tuple[str, ...]) -> Sequence[EntryPoint]:
    """Return the entry points of a group from all packages on an import path; skip packages with damaged metadata.

    The result is cached, because a search through hundreds of packages takes 20 ms, and commands need the result often.
    """
    points: list[EntryPoint] = []
    names: set[str] = set()
    for package in distributions(path=list(path)):
        with suppress(Exception):  # reading third-party metadata may raise anything
            text = package.read_text("entry_points.txt")
            if text is not None and group in text and package.name not in names:
                names.add(package.name)  # Python imports the first package on the path
                points += [point for point in package.entry_points if point.group == group]
    return tuple(points)


def _package(point: EntryPoint) -> str:
    return f"package {'normlift_ns' if point.dist is None else point.dist.name}"  # built-in plugins have no `dist`
