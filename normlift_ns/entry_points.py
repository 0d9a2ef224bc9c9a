"""Objects that other packages add by an entry point, such as encoders and readers of splats.

This module imports nothing heavy; a package is imported only when its object is requested.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.metadata import EntryPoint, distributions
from typing import Any

from normlift_ns.errors import InputError, summarize_error

PACKAGE_PREFIX = "normlift_ns."


@dataclass(frozen=True)
class EntryPoints:
    """An entry point group: its built-in objects, and those of other packages."""

    group: str
    built_in: Mapping[str, str]
    """Built-in objects by name, as in pyproject.toml. Other packages cannot take these names."""
    what: str
    """Noun for the objects, for messages."""
    expected: Any
    """Class of the objects."""
    remedy: str
    """Advice about an object that cannot be loaded."""

    def names(self) -> list[str]:
        """Return all names in alphabetical order, including those that fail to load."""
        return sorted({point.name for point in self._points()})

    def load(self, name: str) -> Any:
        """Return the object of one of the `names`.

        Raises:
            InputError: If two packages claim the name, or the object of another package cannot be loaded.
        """
        points = {point.value: point for point in self._points() if point.name == name}
        built_in = [value for value in points if value.startswith(PACKAGE_PREFIX)]
        if len(points) > 1 and len(built_in) == 0:
            packages = " and ".join(f"{_package(point)} ({value})" for value, point in points.items())
            raise InputError(f"{self.what} {name!r} is claimed by {packages}; uninstall one of the two")
        point = points[built_in[0] if len(built_in) > 0 else next(iter(points))]
        try:
            loaded = point.load()
        except (Exception, SystemExit) as error:  # importing a third-party module may raise anything
            raise InputError(
                f"{self.what} {name!r} of {_package(point)} cannot be loaded ({summarize_error(error)}); repair or "
                f"uninstall that package, or {self.remedy}"
            ) from error
        if not isinstance(loaded, self.expected):
            raise InputError(
                f"{self.what} {name!r} of {_package(point)} is invalid: {point.value} is of type "
                f"{type(loaded).__name__}, expected {self.expected.__name__}; {self.remedy}"
            )
        return loaded

    def _points(self) -> Iterator[EntryPoint]:
        """Yield the entry points of the group, the built-in ones first."""
        yield from (EntryPoint(name, value, self.group) for name, value in self.built_in.items())
        yield from _points_on(tuple(sys.path), self.group)


@cache
def _points_on(path: tuple[str, ...], group: str) -> Sequence[EntryPoint]:
    """Cache the entry points per `sys.path`: a search through hundreds of packages takes 20 ms, and a command needs it
    often."""
    return tuple(_discover(path, group))


def _discover(path: Sequence[str], group: str) -> Iterator[EntryPoint]:
    """Yield the entry points of the packages on a path, without packages whose metadata is damaged."""
    names: set[str] = set()
    for package in distributions(path=list(path)):
        try:
            text = package.read_text("entry_points.txt")
            if text is None or group not in text or package.name in names:
                continue
            names.add(package.name)  # the first on the path is the one that Python imports
            yield from [point for point in package.entry_points if point.group == group]
        except Exception:  # reading third-party metadata may raise anything
            continue


def _package(point: EntryPoint) -> str:
    return f"package {point.dist.name}" if point.dist is not None else "an unnamed package"
