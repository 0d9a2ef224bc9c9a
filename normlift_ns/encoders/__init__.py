"""Encoders of image regions and prompts into a joint embedding space.

Names are imported at first use, so that importing `encoders.registry` does not import torch.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

_MODULES = {
    **dict.fromkeys(("Encoder", "FeatureSource", "RegionFeatures", "Regions", "ViewFeatures"), "encoders.base"),
    "make_source": "encoders.build",
    "cached": "encoders.cache",
    **dict.fromkeys(("LangSplat", "write_langsplat"), "encoders.langsplat"),
    **dict.fromkeys(("EncoderKind", "make_encoder", "make_texts"), "encoders.registry"),
    "TextEncoder": "encoders.text_files",
    "SourceOptions": "options",
    "read_image": "segmentation.regions",
}
"""Module that defines each public name of this package."""


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module 'normlift_ns.encoders' has no attribute {name!r}")
    return getattr(import_module(f"normlift_ns.{_MODULES[name]}"), name)
