"""Registry of encoders, and the lookup of weight files of all networks.

This module imports nothing heavy.
"""

from __future__ import annotations

import ast
import importlib
import os
import pickle
import struct
import urllib.error
import urllib.request
import zipfile
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Protocol

from safetensors import SafetensorError

from normlift_ns.entry_points import PACKAGE_PREFIX, EntryPoints
from normlift_ns.errors import InputError, truncate_text
from normlift_ns.options import CANONICAL_NEGATIVES, RelevancyRule, SourceOptions

if TYPE_CHECKING:
    import numpy as np
    from jaxtyping import Float32
    from torch import Tensor

    from normlift_ns.encoders.base import Encoder


_PROBE_SECONDS = 10
_HUB = "https://huggingface.co"
_FILE_SUFFIXES = (".safetensors", ".bin", ".pt", ".pth", ".ckpt")
_CLIP_FILES = ("open_clip_model.safetensors", "open_clip_pytorch_model.bin")
"""Names of the weight files of OpenCLIP models in hub repositories."""
_SAM_FILES = ("model.safetensors", "pytorch_model.bin")
THIRD_PARTY_ERRORS = (
    OSError, RuntimeError, ValueError, TypeError, LookupError, AttributeError, AssertionError, ArithmeticError,
    ImportError, EOFError, SyntaxError, pickle.UnpicklingError, struct.error, zlib.error, zipfile.BadZipFile,
    SafetensorError,
)  # fmt: skip
"""Exceptions that torch, safetensors and open_clip raise for a bad file or name. Out-of-memory errors are not among
them."""


def has_local_clip_weights(model: str, pretrained: str) -> bool | None:
    """Return whether the weights of an OpenCLIP model are on this machine.

    Return None if that cannot be determined without importing open_clip, as for weights that are not on the Hugging
    Face hub.

    >>> has_local_clip_weights("ViT-B-16", __file__)
    True
    """
    if os.path.isfile(pretrained):
        return True
    repository = _hub_location(model, pretrained)
    if not repository:
        return None
    owner_and_name, _, file = repository.rpartition("/")
    return any(is_in_hub_cache(owner_and_name, name) for name in ([file] if file else _CLIP_FILES))


def has_local_sam_weights(checkpoint: str) -> bool:
    """Return whether a SAM checkpoint, given as a path or a hub name, is on this machine."""
    cached = is_in_hub_cache(checkpoint, "config.json") and any(
        is_in_hub_cache(checkpoint, name) for name in _SAM_FILES
    )
    return os.path.exists(checkpoint) or cached


def is_in_hub_cache(repository: str, file: str) -> bool:
    """Return whether the Hugging Face hub cache holds a file in its main revision. Needs no network."""
    constants = importlib.import_module("huggingface_hub.constants")
    folder = Path(constants.HF_HUB_CACHE) / f"models--{repository.replace('/', '--')}"
    try:
        revision = (folder / "refs" / "main").read_text("utf8").strip()
        return os.path.isfile(folder / "snapshots" / revision / file)
    except (OSError, ValueError):
        return False


def find_in_hub_cache(published: Mapping[str, Any], constants: Any) -> Path | None:
    """Return the path of the weights in the Hugging Face hub cache, or None. Needs no network.

    Args:
        published: Entry of open_clip's table of pretrained weights.
        constants: open_clip's module of file names.
    """
    hub = importlib.import_module("huggingface_hub")
    repository, name = os.path.split(published.get("hf_hub", ""))
    for file in [name] if name else [constants.HF_SAFE_WEIGHTS_NAME, constants.HF_WEIGHTS_NAME]:
        path = hub.try_to_load_from_cache(repository, file) if repository else None
        if isinstance(path, str):
            return Path(path)
    return None


def _hub_location(model: str, tag: str) -> str | None:
    """Return the hub location of weights, "OWNER/NAME/" or "OWNER/NAME/FILE".

    The location is parsed from the source of open_clip, which takes seconds to import. None: the weights are not on the
    hub, or the source has an unexpected form.
    """
    try:
        spec = find_spec("open_clip")  # does not import the package
        assert spec is not None and spec.origin is not None
        source = Path(spec.origin).with_name("pretrained.py").read_text("utf8")
        tables = {
            node.targets[0].id: node.value
            for node in ast.parse(source).body
            if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name)
        }
        models = tables["_PRETRAINED"]
        assert isinstance(models, ast.Dict)
        names = [ast.literal_eval(key) for key in models.keys if key is not None]
        entry = models.values[names.index(model.removesuffix("-quickgelu"))]
        entry = tables[entry.id] if isinstance(entry, ast.Name) else entry
        call = _argument(entry, tag.lower().replace("-", "_"))
        return ast.literal_eval(_argument(call, "hf_hub"))
    except (OSError, ValueError, LookupError, AttributeError, TypeError, AssertionError, SyntaxError, StopIteration):
        return None


def _argument(call: ast.AST, name: str) -> ast.expr:
    """Return the value of a keyword argument of a call."""
    return next(keyword.value for keyword in vars(call)["keywords"] if keyword.arg == name)


def check_server(address: str) -> None:
    """Raise OSError if a server does not respond; the hub's own client would retry for most of a minute."""
    try:
        urllib.request.urlopen(urllib.request.Request(address, method="HEAD"), timeout=_PROBE_SECONDS).close()
    except urllib.error.HTTPError:  # the server responded
        pass
    except OSError as error:
        raise ConnectionError(f"{address} cannot be reached: {error}") from error


def check_hub_access() -> None:
    """Raise OSError if the Hugging Face hub is not available for downloads."""
    if os.environ.get("HF_HUB_OFFLINE", "").lower() in ("1", "true", "yes", "on"):
        raise ConnectionError("HF_HUB_OFFLINE forbids downloads")
    check_server(os.environ.get("HF_ENDPOINT", _HUB))


def is_local_path(name: str, parts: int) -> bool:
    """Return whether a name can only be a local path.

    Args:
        parts: Largest number of parts that names of other kinds have.

    >>> is_local_path("google/siglip2-base-patch16-224", 2), is_local_path("a/b/c", 2), is_local_path("clip.pt", 2)
    (False, True, True)
    """
    path = Path(name)
    return path.is_absolute() or len(path.parts) > parts or path.suffix in _FILE_SUFFIXES


# Registry of encoders by their `--encoder` names.
#
# Every encoder, built-in or from another package, is an entry point of the group `normlift_ns.encoders`. This module
# imports nothing heavy; a package is imported only when its encoder is requested.


ENTRY_POINT_GROUP = "normlift_ns.encoders"
"""Entry point group of encoders."""
BUILT_IN_ENCODERS = {
    "open_clip": "normlift_ns.encoders.builtin:OPEN_CLIP",
    "siglip": "normlift_ns.encoders.builtin:SIGLIP",
    "siglip2": "normlift_ns.encoders.builtin:SIGLIP2",
    "metaclip2": "normlift_ns.encoders.builtin:METACLIP2",
    "colour": "normlift_ns.encoders.builtin:COLOR",
}
"""The built-in encoders, as pyproject.toml registers them. Listed here for source trees that are not installed, or were
installed before an encoder was added."""


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


def _accept_all(options: SourceOptions) -> None:
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
    check: Callable[[SourceOptions], None] = _accept_all
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


_ENCODERS = EntryPoints(
    ENTRY_POINT_GROUP,
    BUILT_IN_ENCODERS,
    what="encoder",
    expected=EncoderKind,
    remedy="use another encoder, such as --encoder open_clip",
)


def encoder_names() -> list[str]:
    """Return the names of all registered encoders in alphabetical order, including those that fail to load."""
    return _ENCODERS.names()


def encoder_kind(name: str) -> EncoderKind:
    """Return the encoder kind of a name. Other packages cannot take the name of a built-in encoder.

    Raises:
        InputError: If the name is unknown, two packages claim it, or the encoder of another package cannot be loaded.
    """
    names = encoder_names()
    if name not in names:
        known = ", ".join(names) or "none: normlift_ns is not installed (pip install -e .)"
        raise InputError(f"unknown encoder {truncate_text(name)!r}; --encoder is one of {known}")
    return _ENCODERS.load(name)


def find_encoder_kind(name: object) -> EncoderKind | None:
    """Return the encoder kind of a name; None if it is unknown or cannot be loaded."""
    try:
        return encoder_kind(name) if isinstance(name, str) else None
    except InputError:
        return None


def is_built_in(kind: EncoderKind) -> bool:
    """Return whether an encoder kind is built in."""
    return kind.make.__module__.startswith(PACKAGE_PREFIX)


def absolute_paths(options: SourceOptions) -> dict[str, str]:
    """Return the encoder's options that may be paths. The path of an existing file or folder is made absolute."""
    kind = find_encoder_kind(options.encoder)
    values = {name: getattr(options, name) for name in (() if kind is None else kind.paths)}
    return {name: os.path.abspath(value) if os.path.exists(value) else value for name, value in values.items()}
