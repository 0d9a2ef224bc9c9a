"""Registry of encoders by their `--encoder` names.

Every encoder, built-in or from another package, is an entry point of the group `normlift_ns.encoders`. This module
imports nothing heavy; a package is imported only when its encoder is requested.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.metadata import EntryPoint, distributions
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Protocol

from normlift_ns.encoders.weights import first_line
from normlift_ns.errors import InputError, shortened
from normlift_ns.options import CANONICAL_NEGATIVES, Rule, SourceOptions

if TYPE_CHECKING:
    import numpy as np
    from jaxtyping import Float32
    from torch import Tensor

    from normlift_ns.encoders.source import Encoder

GROUP = "normlift_ns.encoders"
"""Entry point group of encoders."""
_PACKAGE_PREFIX = "normlift_ns."
BUILT_IN = {
    "open_clip": "normlift_ns.encoders.clip.kind:OPEN_CLIP",
    "siglip": "normlift_ns.encoders.hub.kinds:SIGLIP",
    "siglip2": "normlift_ns.encoders.hub.kinds:SIGLIP2",
    "metaclip2": "normlift_ns.encoders.hub.kinds:METACLIP2",
    "colour": "normlift_ns.encoders.texts.colour_kind:COLOUR",
}
"""The built-in encoders, as pyproject.toml registers them. Listed here for source trees that are not installed, or were
installed before an encoder was added."""


class Texts(Protocol):
    """A text encoder that imports torch only if it has to run a network."""

    @property
    def identity(self) -> dict[str, Any]:
        """Every setting that changes the vectors, as JSON-serializable values."""
        ...

    def rows(self, prompts: Sequence[str]) -> Float32[np.ndarray, "q d"]:
        """Return one unit row per prompt; raise ValueError for a prompt that the encoder does not understand."""
        ...

    def text(self, prompts: Sequence[str]) -> Float32[Tensor, "q d"]:
        """Return `rows` as a torch tensor."""
        ...


def _accept_all(options: SourceOptions) -> None:
    """Accept all options."""


def _no_patches(options: SourceOptions) -> bool:
    return False


@dataclass(frozen=True)
class EncoderKind:
    """An encoder and its query defaults; the object that an entry point of the group `normlift_ns.encoders` names.

    The module that defines it should import torch only inside `make`, so that queries and error messages stay fast.

    >>> from normlift_ns.encoders.kinds import encoder_kind
    >>> encoder_kind("colour").negatives, encoder_kind("open_clip").rule
    ((), 'lerf')
    """

    make: Callable[[SourceOptions, str], Encoder]
    """Makes the encoder from the options and a device such as "cuda". It should load weights at their first use."""
    rule: Rule = "lerf"
    """Relevancy rule of queries that set none."""
    negatives: tuple[str, ...] = CANONICAL_NEGATIVES
    """Negative prompts of queries that set none; (): no negatives."""
    threshold: float | Literal["auto"] = 0.5
    """Relevancy by `rule` above which a Gaussian is selected; "auto": chosen from the histogram."""
    check: Callable[[SourceOptions], None] = _accept_all
    """Raises InputError or FileNotFoundError for options that cannot work, without importing torch."""
    texts: Callable[[SourceOptions, str, Path | None, Mapping[str, Any]], Texts] | None = None
    """Makes the text encoder of a lifted run. Its arguments: the options, the device, the folder in which to cache
    embeddings, and the encoder's identity recorded at the lift ({} if unknown). None: the encoder itself embeds the
    prompts, and the embeddings are cached."""
    has_patches: Callable[[SourceOptions], bool] = _no_patches
    """Returns whether the encoder is a `DenseEncoder`, which has features of patches."""
    learned: bool = True
    """True if a network processes the images, so that better regions improve its features."""
    paths: tuple[str, ...] = ()
    """Options that may be the path of a file or folder; they are stored as absolute paths."""


def encoder_names() -> list[str]:
    """Return the names of all registered encoders in alphabetical order, including those that fail to load."""
    return sorted({point.name for point in _points()})


def encoder_kind(name: str) -> EncoderKind:
    """Return the encoder kind of a name. Other packages cannot take the name of a built-in encoder.

    Raises:
        InputError: If the name is unknown, two packages claim it, or the encoder of another package cannot be loaded.
    """
    points = {point.value: point for point in _points() if point.name == name}
    built_in = [value for value in points if value.startswith(_PACKAGE_PREFIX)]
    if len(points) == 0:
        known = ", ".join(encoder_names()) or "none: normlift_ns is not installed (pip install -e .)"
        raise InputError(f"unknown encoder {shortened(name)!r}; --encoder is one of {known}")
    if len(points) > 1 and len(built_in) == 0:
        packages = " and ".join(f"{_package(point)} ({value})" for value, point in points.items())
        raise InputError(f"encoder {name!r} is claimed by {packages}; uninstall one of the two")
    point = points[built_in[0] if len(built_in) > 0 else next(iter(points))]
    try:
        kind = point.load()
    except (Exception, SystemExit) as error:  # importing a third-party module may raise anything
        raise InputError(
            f"encoder {name!r} of {_package(point)} cannot be loaded ({first_line(error)}); repair or uninstall that "
            "package, or use another encoder, such as --encoder open_clip"
        ) from error
    if not isinstance(kind, EncoderKind):
        raise InputError(
            f"encoder {name!r} of {_package(point)} is invalid: {point.value} is of type {type(kind).__name__}, "
            "expected an EncoderKind; use another encoder, such as --encoder open_clip"
        )
    return kind


def known_kind(name: object) -> EncoderKind | None:
    """Return the encoder kind of a name; None if it is unknown or cannot be loaded."""
    try:
        return encoder_kind(name) if isinstance(name, str) else None
    except InputError:
        return None


def is_ours(kind: EncoderKind) -> bool:
    """Return whether an encoder kind is built in."""
    return kind.make.__module__.startswith(_PACKAGE_PREFIX)


def absolute_paths(options: SourceOptions) -> dict[str, str]:
    """Return the encoder's options that may be paths. The path of an existing file or folder is made absolute."""
    kind = known_kind(options.encoder)
    values = {name: getattr(options, name) for name in (() if kind is None else kind.paths)}
    return {name: os.path.abspath(value) if os.path.exists(value) else value for name, value in values.items()}


def _points() -> Sequence[EntryPoint]:
    """Return the entry points of the group. Packages with damaged metadata are skipped."""
    return _points_on(tuple(sys.path))


@cache
def _points_on(path: tuple[str, ...]) -> Sequence[EntryPoint]:
    """Cache the entry points per `sys.path`: a search through hundreds of packages takes 20 ms, and a command needs it
    often."""
    return tuple(_discover(path))


def _discover(path: Sequence[str]) -> Iterator[EntryPoint]:
    """Yield the built-in entry points, then those of the packages on a path."""
    names: set[str] = set()
    yield from [EntryPoint(name, value, GROUP) for name, value in BUILT_IN.items()]
    for package in distributions(path=list(path)):
        try:
            text = package.read_text("entry_points.txt")
            if text is None or GROUP not in text or package.name in names:
                continue
            names.add(package.name)  # the first on the path is the one that Python imports
            yield from [point for point in package.entry_points if point.group == GROUP]
        except Exception:  # reading third-party metadata may raise anything
            continue


def _package(point: EntryPoint) -> str:
    return f"package {point.dist.name}" if point.dist is not None else "an unnamed package"
