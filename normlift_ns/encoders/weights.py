"""Weight files on this machine and on the hub. Imports nothing heavy."""

from __future__ import annotations

import ast
import importlib
import json
import os
import pickle
import struct
import urllib.error
import urllib.request
import zipfile
import zlib
from collections.abc import Callable, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from safetensors import SafetensorError

from normlift_ns.errors import InputError

CONFIG_FILE = "config.json"
_MAX_JSON_BYTES = 2**27
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
    location = _hub_location(model, pretrained)
    return find_cached_clip_weights(location) is not None if location else None


def find_local_sam(checkpoint: str) -> Path | None:
    """Return the path of a SAM checkpoint on this machine, given as a path or a hub name; None if there is none."""
    if os.path.exists(checkpoint):
        return Path(checkpoint).resolve()
    config, weights = find_in_hub_cache(checkpoint, CONFIG_FILE), find_in_hub_cache(checkpoint, *SAM_WEIGHT_FILES)
    return None if config is None or weights is None else weights.parent


def find_in_hub_cache(repository: str, *names: str) -> Path | None:
    """Return the path of the first of these files that the Hugging Face hub cache holds in the main revision of a
    repository, or None. Needs no network."""
    constants = importlib.import_module("huggingface_hub.constants")
    folder = Path(constants.HF_HUB_CACHE) / f"models--{repository.replace('/', '--')}"
    try:
        snapshot = folder / "snapshots" / (folder / "refs" / "main").read_text("utf8").strip()
        return next((snapshot / name for name in names if os.path.isfile(snapshot / name)), None)
    except (OSError, ValueError):
        return None


def find_cached_clip_weights(location: str) -> Path | None:
    """Return the path of the weights of an OpenCLIP model in the hub cache, or None.

    Args:
        location: "OWNER/NAME/" or "OWNER/NAME/FILE", as in open_clip's table of pretrained weights.
    """
    repository, name = os.path.split(location)
    return find_in_hub_cache(repository, *([name] if name else _CLIP_FILES))


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


def check_hub_access() -> None:
    """Raise OSError if the Hugging Face hub is not available for downloads; its own client would retry for most of a
    minute."""
    if os.environ.get("HF_HUB_OFFLINE", "").lower() in ("1", "true", "yes", "on"):
        raise ConnectionError("HF_HUB_OFFLINE forbids downloads")
    address = os.environ.get("HF_ENDPOINT", _HUB)
    try:
        urllib.request.urlopen(urllib.request.Request(address, method="HEAD"), timeout=_PROBE_SECONDS).close()
    except urllib.error.HTTPError:  # the server responded
        pass
    except OSError as error:
        raise ConnectionError(f"{address} cannot be reached: {error}") from error


def download_model(name: str, choose_files: Callable[[dict[str, Any]], Sequence[str]]) -> Path:
    """Download a model from the hub and return its folder: config.json first, then the files chosen by its content.

    Args:
        choose_files: Returns patterns of further files; errors that it raises are passed on.
    Raises:
        Exception: Download clients raise exceptions without a common base class.
    """
    check_hub_access()
    download = importlib.import_module("huggingface_hub").snapshot_download
    config = read_json(Path(download(name, allow_patterns=[CONFIG_FILE])) / CONFIG_FILE)
    return Path(download(name, allow_patterns=[CONFIG_FILE, *choose_files(config)]))


def is_local_path(name: str, parts: int) -> bool:
    """Return whether a name can only be a local path.

    Args:
        parts: Largest number of parts that names of other kinds have.

    >>> is_local_path("google/siglip2-base-patch16-224", 2), is_local_path("a/b/c", 2), is_local_path("clip.pt", 2)
    (False, True, True)
    """
    path = Path(name)
    return path.is_absolute() or len(path.parts) > parts or path.suffix in _FILE_SUFFIXES


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON file that holds an object.

    Raises:
        InputError: If the file does not exist, is not JSON, or holds anything but an object.
    """
    if not path.is_file():
        raise InputError(f"{path.name} is missing" if not os.path.lexists(path) else f"{path.name} is not a file")
    if path.stat().st_size > _MAX_JSON_BYTES:
        raise InputError(f"{path.name} has {path.stat().st_size:,} bytes, more than {_MAX_JSON_BYTES:,}")
    try:
        content = json.loads(path.read_text("utf8"))
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{path.name} is damaged ({type(error).__name__})") from None
    if not isinstance(content, dict):
        raise InputError(f"{path.name} holds {type(content).__name__}, expected an object")
    return content
