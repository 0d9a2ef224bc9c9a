"""What open_clip knows of its models, without importing all of it: that takes ten seconds, of torchvision and
transformers for the most part, and is left to those who need a network.
"""

from __future__ import annotations

import importlib
import json
import sys
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Any

from normlift_ns.errors import InputError

_PARTS = "_normlift_ns_open_clip"
_COMPLETE = {"embed_dim", "vision_cfg", "text_cfg"}


def open_clip_part(name: str) -> ModuleType:
    """A module of open_clip without the rest of the package, unless that has been imported already.

    Raises:
        ImportError: this module of it is not there, or needs the rest.
        ValueError: open_clip is not installed.
    """
    if "open_clip" in sys.modules:
        return importlib.import_module(f"open_clip.{name}")
    if _PARTS not in sys.modules:
        package = ModuleType(_PARTS)
        package.__path__ = [str(_folder())]
        sys.modules[_PARTS] = package
    return importlib.import_module(f"{_PARTS}.{name}")


def model_names() -> list[str]:
    """Architectures that open_clip can build."""
    if "open_clip" in sys.modules:  # to which people may have added their own
        return importlib.import_module("open_clip").list_models()
    return sorted(path.stem for path in (_folder() / "model_configs").glob("*.json"))


def model_config(model: str) -> dict[str, Any] | None:
    """The configuration of an architecture; None where open_clip does not know it."""
    if "open_clip" in sys.modules:
        return importlib.import_module("open_clip").get_model_config(model)
    if model not in model_names():
        return None
    config = json.loads((_folder() / "model_configs" / f"{model}.json").read_text("utf8"))
    return config if set(config) >= _COMPLETE else None


def _folder() -> Path:
    spec = find_spec("open_clip")
    if spec is None or spec.origin is None:
        raise InputError("open_clip is not installed (pip install open_clip_torch); --encoder colour does without")
    return Path(spec.origin).parent
