"""Plugins of this package and of other packages, by name.

Every plugin is an entry point. This module imports nothing heavy; a package is imported only when its plugin is
requested.
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
    """Plugins of one type by name. Other packages cannot take the name of a built-in plugin."""

    group: str
    """Entry point group."""
    built_in: Mapping[str, str]
    """Built-in plugins, as pyproject.toml registers them. Listed here for source trees that are not installed, or were
    installed before a plugin was added."""
    plugin: type[Plugin]
    noun: str
    """Name of a plugin in messages."""
    flag: str
    """Option that selects a plugin."""
    default: str
    """A plugin that always works, for messages."""

    def names(self) -> list[str]:
        """Return the names of all plugins in alphabetical order, including those that fail to load."""
        return sorted({*self.built_in, *installed_names(self.group)})

    def load(self, name: str) -> Plugin:
        """Return the plugin of a name.

        Raises:
            InputError: If the name is unknown, two packages claim it, or the plugin of another package cannot be
                loaded.
        """
        point = self._find(name)
        advice = f"such as {self.flag} {self.default}"
        try:
            plugin = point.load()
        except (Exception, SystemExit) as error:  # importing a third-party module may raise anything
            raise InputError(
                f"{self.noun} {name!r} of {_package(point)} cannot be loaded ({summarize_error(error)}); repair or "
                f"uninstall that package, or use another {self.noun}, {advice}"
            ) from error
        if not isinstance(plugin, self.plugin):
            raise InputError(
                f"{self.noun} {name!r} of {_package(point)} is invalid: {point.value} is of type "
                f"{type(plugin).__name__}, expected {self.plugin.__name__}; use another {self.noun}, {advice}"
            )
        return plugin

    def _find(self, name: str) -> EntryPoint:
        """Return the entry point of a name."""
        if name in self.built_in:
            return EntryPoint(name, self.built_in[name], self.group)
        points = {point.value: point for point in _entry_points(self.group, tuple(sys.path)) if point.name == name}
        if len(points) == 0:
            known = ", ".join(self.names())
            raise InputError(f"unknown {self.noun} {truncate_text(name)!r}; {self.flag} is one of {known}")
        if len(points) > 1:
            packages = " and ".join(f"{_package(point)} ({value})" for value, point in points.items())
            raise InputError(f"{self.noun} {name!r} is claimed by {packages}; uninstall one of the two")
        return next(iter(points.values()))


def installed_names(group: str) -> list[str]:
    """Return the names in an entry point group of the installed packages, in alphabetical order."""
    return sorted({point.name for point in _entry_points(group, tuple(sys.path))})


@cache
def _entry_points(group: str, path: tuple[str, ...]) -> Sequence[EntryPoint]:
    """Return the entry points of the packages on a path. Packages with damaged metadata are skipped.

    Cached, because a search through hundreds of packages takes 20 ms, and a command needs it often.
    """
    points: list[EntryPoint] = []
    names: set[str] = set()
    for package in distributions(path=list(path)):
        with suppress(Exception):  # reading third-party metadata may raise anything
            text = package.read_text("entry_points.txt")
            if text is not None and group in text and package.name not in names:
                names.add(package.name)  # the first on the path is the one that Python imports
                points += [point for point in package.entry_points if point.group == group]
    return tuple(points)


def _package(point: EntryPoint) -> str:
    return f"package {point.dist.name}" if point.dist is not None else "an unnamed package"
