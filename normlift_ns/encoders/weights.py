"""Weight files on this machine and on the hub. Imports nothing heavy."""

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
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from safetensors import SafetensorError

_PROBE_SECONDS = 10
_HUB = "https://huggingface.co"
_FILE_SUFFIXES = (".safetensors", ".bin", ".pt", ".pth", ".ckpt")
_CLIP_FILES = ("open_clip_model.safetensors", "open_clip_pytorch_model.bin")
"""Names of the weight files of OpenCLIP models in hub repositories."""
SAM_WEIGHT_FILES = ("model.safetensors", "pytorch_model.bin")
"""Names of the weight files of SAM in the format of transformers."""
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
        is_in_hub_cache(checkpoint, name) for name in SAM_WEIGHT_FILES
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
