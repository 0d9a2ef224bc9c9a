"""2D features of images and text embeddings in one space: the `FeatureSource` protocol and `make_source`, which builds
one.

Names are loaded on first use, so that `encoders.weights` can be imported without torch.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from normlift_ns.encoders.build import SourceOptions as SourceOptions
    from normlift_ns.encoders.build import make_encoder as make_encoder
    from normlift_ns.encoders.build import make_regions as make_regions
    from normlift_ns.encoders.build import make_source as make_source
    from normlift_ns.encoders.build import make_texts as make_texts
    from normlift_ns.encoders.cache import cached as cached
    from normlift_ns.encoders.images import read_image as read_image
    from normlift_ns.encoders.kinds import EncoderKind as EncoderKind
    from normlift_ns.encoders.langsplat.source import LangSplat as LangSplat
    from normlift_ns.encoders.langsplat.source import write_langsplat as write_langsplat
    from normlift_ns.encoders.source import Encoder as Encoder
    from normlift_ns.encoders.source import FeatureSource as FeatureSource
    from normlift_ns.encoders.source import RegionFeatures as RegionFeatures
    from normlift_ns.encoders.source import Regions as Regions
    from normlift_ns.encoders.source import TextEncoder as TextEncoder
    from normlift_ns.encoders.source import ViewFeatures as ViewFeatures

_EXPORTS = {
    "build": ("SourceOptions", "make_encoder", "make_regions", "make_source", "make_texts"),
    "cache": ("cached",),
    "images": ("read_image",),
    "kinds": ("EncoderKind",),
    "langsplat.source": ("LangSplat", "write_langsplat"),
    "source": ("Encoder", "FeatureSource", "RegionFeatures", "Regions", "TextEncoder", "ViewFeatures"),
}
"""The names that each module defines."""
_MODULE_OF = {name: module for module, names in _EXPORTS.items() for name in names}

__all__ = list(_MODULE_OF)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'normlift_ns.encoders' has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(f"normlift_ns.encoders.{_MODULE_OF[name]}"), name)
    return value
