"""Kinds of encoders, by the names that `--encoder` takes. Each is an entry point of the group `normlift_ns.encoders`,
ours and those of other packages alike. Imports nothing heavy; a package is loaded when its encoder is asked for.
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
"""Of entry points."""
_OURS = "normlift_ns."
BUILT_IN = {
    "open_clip": "normlift_ns.encoders.clip.kind:OPEN_CLIP",
    "siglip": "normlift_ns.encoders.hub.kinds:SIGLIP",
    "siglip2": "normlift_ns.encoders.hub.kinds:SIGLIP2",
    "metaclip2": "normlift_ns.encoders.hub.kinds:METACLIP2",
    "colour": "normlift_ns.encoders.texts.colour_kind:COLOUR",
}
"""Ours, as pyproject.toml registers them: for a source tree that is not installed, or was before they were there."""


class Texts(Protocol):
    """A reader of texts that needs torch where it has to, and for nothing else."""

    @property
    def identity(self) -> dict[str, Any]:
        """Every setting that changes the vectors, ready for JSON."""
        ...

    def rows(self, prompts: Sequence[str]) -> Float32[np.ndarray, "q d"]:
        """One unit row per prompt; raises ValueError for what it does not understand."""
        ...

    def text(self, prompts: Sequence[str]) -> Float32[Tensor, "q d"]:
        """As `rows`, for torch."""
        ...


def _nothing(options: SourceOptions) -> None:
    """Every option is right."""


def _none(options: SourceOptions) -> bool:
    return False


@dataclass(frozen=True)
class EncoderKind:
    """What an entry point of the group `normlift_ns.encoders` names: how an encoder is made, and how it is asked.

    The module that holds it should import torch inside `make` only, so that questions and errors are quick.

    >>> from normlift_ns.encoders.kinds import encoder_kind
    >>> encoder_kind("colour").negatives, encoder_kind("open_clip").rule
    ((), 'lerf')
    """

    make: Callable[[SourceOptions, str], Encoder]
    """Options and device, such as "cuda", to the encoder. Weights should be loaded where they are first needed."""
    rule: Rule = "lerf"
    """How relevancy follows from cosines, unless a question says otherwise."""
    negatives: tuple[str, ...] = CANONICAL_NEGATIVES
    """Texts to compare with, unless a question names others; (): none."""
    threshold: float | Literal["auto"] = 0.5
    """Relevancy by that rule above which a Gaussian is selected; "auto": what the histogram suggests."""
    check: Callable[[SourceOptions], None] = _nothing
    """Raises InputError or FileNotFoundError for options that cannot work, without importing torch."""
    texts: Callable[[SourceOptions, str, Path | None, Mapping[str, Any]], Texts] | None = None
    """Makes what reads the texts of a lifted run, from its options, the device, the folder in which to keep vectors and
    the identity that the encoder had when the run was lifted ({} if nobody knows). None: the encoder does, and what it
    has read is kept."""
    has_patches: Callable[[SourceOptions], bool] = _none
    """Whether the encoder is a `DenseEncoder`, which has features of patches."""
    learned: bool = True
    """A network sees the images: it is worth the best regions that there are."""
    paths: tuple[str, ...] = ()
    """Options that may be the path of a file or folder; they are stored absolute."""


def encoder_names() -> list[str]:
    """The names that `encoder_kind` knows, in alphabetical order, whether they can be loaded or not."""
    return sorted({point.name for point in _points()})


def encoder_kind(name: str) -> EncoderKind:
    """A kind of encoder by its name. Other packages cannot take the name of one of ours.

    Raises:
        InputError: an unknown name, one that two packages claim, or an encoder of another package that cannot be
            loaded.
    """
    claims = {point.value: point for point in _points() if point.name == name}
    ours = [value for value in claims if value.startswith(_OURS)]
    if len(claims) == 0:
        known = ", ".join(encoder_names()) or "none: normlift_ns is not installed (pip install -e .)"
        raise InputError(f"unknown encoder {shortened(name)!r}; --encoder is one of {known}")
    if len(claims) > 1 and len(ours) == 0:
        who = " and ".join(f"{_package(point)} ({value})" for value, point in claims.items())
        raise InputError(f"encoder {name!r} is claimed by {who}; uninstall one of the two")
    point = claims[ours[0] if len(ours) > 0 else next(iter(claims))]
    try:
        kind = point.load()
    except (Exception, SystemExit) as error:  # whatever a foreign module does when it is imported
        raise InputError(
            f"encoder {name!r} of {_package(point)} cannot be loaded ({first_line(error)}); repair or uninstall that "
            "package, or use another encoder, such as --encoder open_clip"
        ) from error
    if not isinstance(kind, EncoderKind):
        raise InputError(
            f"encoder {name!r} of {_package(point)} is no encoder: {point.value} is of type {type(kind).__name__}, "
            "expected an EncoderKind; use another one, such as --encoder open_clip"
        )
    return kind


def known_kind(name: object) -> EncoderKind | None:
    """A kind of encoder; None where it is not known here, or cannot be loaded."""
    try:
        return encoder_kind(name) if isinstance(name, str) else None
    except InputError:
        return None


def is_ours(kind: EncoderKind) -> bool:
    """Whether a kind is made by this package."""
    return kind.make.__module__.startswith(_OURS)


def absolute_paths(options: SourceOptions) -> dict[str, str]:
    """The options of the encoder that may be paths, absolute where there is a file or folder, as they are elsewhere."""
    kind = known_kind(options.encoder)
    values = {name: getattr(options, name) for name in (() if kind is None else kind.paths)}
    return {name: os.path.abspath(value) if os.path.exists(value) else value for name, value in values.items()}


def _points() -> Sequence[EntryPoint]:
    """The entry points of the group. Packages whose metadata is damaged are passed over."""
    return _points_on(tuple(sys.path))


@cache
def _points_on(path: tuple[str, ...]) -> Sequence[EntryPoint]:
    """Found once for every `sys.path`: looking through hundreds of packages takes 20 ms, and a command asks often."""
    return tuple(_found(path))


def _found(path: Sequence[str]) -> Iterator[EntryPoint]:
    seen: set[str] = set()
    yield from [EntryPoint(name, value, GROUP) for name, value in BUILT_IN.items()]
    for package in distributions(path=list(path)):
        try:
            text = package.read_text("entry_points.txt")
            if text is None or GROUP not in text or package.name in seen:
                continue
            seen.add(package.name)  # the first on the path is the one that is imported
            yield from [point for point in package.entry_points if point.group == GROUP]
        except Exception:  # of any foreign package
            continue


def _package(point: EntryPoint) -> str:
    return f"package {point.dist.name}" if point.dist is not None else "an unnamed package"
