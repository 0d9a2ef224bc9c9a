"""2D features of images and text embeddings in one space.

Names are loaded on first use, so that `encoders.registry` can be imported without torch.
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
"""Module of each name that other packages may import from here."""


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module 'normlift_ns.encoders' has no attribute {name!r}")
    return getattr(import_module(f"normlift_ns.{_MODULES[name]}"), name)
