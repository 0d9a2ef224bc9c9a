"""2D features of images and text embeddings in one space: the `FeatureSource` protocol and `make_source`, which builds
one.

Names are loaded on first use, so that `encoders.registry` can be imported without torch.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from normlift_ns.encoders.base import Encoder as Encoder
    from normlift_ns.encoders.base import FeatureSource as FeatureSource
    from normlift_ns.encoders.base import RegionFeatures as RegionFeatures
    from normlift_ns.encoders.base import Regions as Regions
    from normlift_ns.encoders.base import ViewFeatures as ViewFeatures
    from normlift_ns.encoders.build import make_encoder as make_encoder
    from normlift_ns.encoders.build import make_regions as make_regions
    from normlift_ns.encoders.build import make_source as make_source
    from normlift_ns.encoders.build import make_texts as make_texts
    from normlift_ns.encoders.cache import cached as cached
    from normlift_ns.encoders.langsplat import LangSplat as LangSplat
    from normlift_ns.encoders.langsplat import write_langsplat as write_langsplat
    from normlift_ns.encoders.registry import EncoderKind as EncoderKind
    from normlift_ns.encoders.text_files import TextEncoder as TextEncoder
    from normlift_ns.options import SourceOptions as SourceOptions
    from normlift_ns.segmentation.regions import read_image as read_image


_EXPORTS = {
    "normlift_ns.encoders.base": (
        "Encoder",
        "FeatureSource",
        "RegionFeatures",
        "Regions",
        "ViewFeatures",
    ),
    "normlift_ns.encoders.build": (
        "make_encoder",
        "make_regions",
        "make_source",
        "make_texts",
    ),
    "normlift_ns.encoders.cache": ("cached",),
    "normlift_ns.encoders.langsplat": (
        "LangSplat",
        "write_langsplat",
    ),
    "normlift_ns.encoders.registry": ("EncoderKind",),
    "normlift_ns.encoders.text_files": ("TextEncoder",),
    "normlift_ns.options": ("SourceOptions",),
    "normlift_ns.segmentation.regions": ("read_image",),
}
"""The names that each module defines."""
_MODULE_OF = {name: module for module, names in _EXPORTS.items() for name in names}

__all__ = list(_MODULE_OF)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'normlift_ns.encoders' has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(_MODULE_OF[name]), name)
    return value
