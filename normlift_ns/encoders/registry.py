"""Encoders by their `--encoder` names.

Every encoder, built-in or from another package, is an entry point of the group `normlift_ns.encoders`. Imports nothing
heavy.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Protocol

from normlift_ns.errors import InputError
from normlift_ns.options import CANONICAL_NEGATIVES, RelevancyRule, SourceOptions
from normlift_ns.registry import Registry

if TYPE_CHECKING:
    import numpy as np
    from jaxtyping import Float32
    from torch import Tensor

    from normlift_ns.encoders.base import Encoder


class LazyTextEncoder(Protocol):
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


def accept_all_options(options: SourceOptions) -> None:
    """Accept all options."""


def _no_patches(options: SourceOptions) -> bool:
    return False


@dataclass(frozen=True)
class EncoderKind:
    """An encoder and its query defaults; the object that an entry point of the group `normlift_ns.encoders` names.

    The module that defines it should import torch only inside `make`, so that queries and error messages stay fast.

    >>> from normlift_ns.encoders.registry import encoder_kind
    >>> encoder_kind("colour").negatives, encoder_kind("open_clip").rule
    ((), 'lerf')
    """

    make: Callable[[SourceOptions, str], Encoder]
    """Makes the encoder from the options and a device such as "cuda". It should load weights at their first use."""
    rule: RelevancyRule = "lerf"
    """Relevancy rule of queries that set none."""
    negatives: tuple[str, ...] = CANONICAL_NEGATIVES
    """Negative prompts of queries that set none; (): no negatives."""
    threshold: float | Literal["auto"] = 0.5
    """Relevancy by `rule` above which a Gaussian is selected; "auto": chosen from the histogram."""
    check: Callable[[SourceOptions], None] = accept_all_options
    """Raises InputError or FileNotFoundError for options that cannot work, without importing torch."""
    texts: Callable[[SourceOptions, str, Path | None, Mapping[str, Any]], LazyTextEncoder] | None = None
    """Makes the text encoder of a lifted run. Its arguments: the options, the device, the folder in which to cache
    embeddings, and the encoder's identity recorded at the lift ({} if unknown). None: the encoder itself embeds the
    prompts, and the embeddings are cached."""
    has_patches: Callable[[SourceOptions], bool] = _no_patches
    """Returns whether the encoder is a `DenseEncoder`, which has features of patches."""
    learned: bool = True
    """True if a network processes the images, so that better regions improve its features."""
    paths: tuple[str, ...] = ()
    """Options that may be the path of a file or folder; they are stored as absolute paths."""


ENCODERS = Registry(
    "normlift_ns.encoders",
    {
        "open_clip": "normlift_ns.encoders.builtin:OPEN_CLIP",
        "siglip": "normlift_ns.encoders.builtin:SIGLIP",
        "siglip2": "normlift_ns.encoders.builtin:SIGLIP2",
        "metaclip2": "normlift_ns.encoders.builtin:METACLIP2",
        "colour": "normlift_ns.encoders.builtin:COLOR",
    },
    EncoderKind,
    "encoder",
    "--encoder",
    "open_clip",
)
"""Encoders by their `--encoder` names."""


def encoder_kind(name: str) -> EncoderKind:
    """Return the encoder kind of a name; raises as `Registry.load`."""
    return ENCODERS.load(name)


def find_encoder_kind(name: object) -> EncoderKind | None:
    """Return the encoder kind of a name; None if it is unknown or cannot be loaded."""
    try:
        return encoder_kind(name) if isinstance(name, str) else None
    except InputError:
        return None


def absolute_paths(options: SourceOptions) -> dict[str, str]:
    """Return the encoder's options that may be paths. The path of an existing file or folder is made absolute."""
    kind = find_encoder_kind(options.encoder)
    values = {name: getattr(options, name) for name in (() if kind is None else kind.paths)}
    return {name: os.path.abspath(value) if os.path.exists(value) else value for name, value in values.items()}
