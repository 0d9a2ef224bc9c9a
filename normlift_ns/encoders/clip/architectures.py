"""Parts of open_clip without importing the whole package. That import takes ten seconds, mostly for torchvision and
transformers, and only networks need it."""

from __future__ import annotations

import importlib
import json
import sys
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Any

from normlift_ns.errors import InputError

_PARTIAL_PACKAGE = "_normlift_ns_open_clip"
_REQUIRED_KEYS = {"embed_dim", "vision_cfg", "text_cfg"}


def open_clip_part(name: str) -> ModuleType:
    """Import a module of open_clip without the rest of the package, unless that has been imported already.

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


def model_names() -> list[str]:
    """Return the architectures that open_clip can build."""
    if "open_clip" in sys.modules:  # it also lists architectures added by the user
        return importlib.import_module("open_clip").list_models()
    return sorted(path.stem for path in (_folder() / "model_configs").glob("*.json"))


def model_config(model: str) -> dict[str, Any] | None:
    """Return the configuration of an architecture; None if open_clip does not know it."""
    if "open_clip" in sys.modules:
        return importlib.import_module("open_clip").get_model_config(model)
    if model not in model_names():
        return None
    config = json.loads((_folder() / "model_configs" / f"{model}.json").read_text("utf8"))
    return config if set(config) >= _REQUIRED_KEYS else None


def _folder() -> Path:
    """Return the folder of the open_clip package."""
    spec = find_spec("open_clip")
    if spec is None or spec.origin is None:
        raise InputError("open_clip is not installed (pip install open_clip_torch); --encoder colour works without it")
    return Path(spec.origin).parent
