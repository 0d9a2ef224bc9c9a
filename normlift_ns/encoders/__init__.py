"""2D semantics of images and texts in one space: `FeatureSource` is the protocol, `make_source` builds one."""

from normlift_ns.encoders.build import SourceOptions, make_encoder, make_regions, make_source, make_texts
from normlift_ns.encoders.cache import cached
from normlift_ns.encoders.images import read_image
from normlift_ns.encoders.langsplat.source import LangSplat, write_langsplat
from normlift_ns.encoders.source import Encoder, FeatureSource, RegionFeatures, Regions, TextEncoder, ViewFeatures

__all__ = [
    "Encoder",
    "FeatureSource",
    "LangSplat",
    "RegionFeatures",
    "Regions",
    "SourceOptions",
    "TextEncoder",
    "ViewFeatures",
    "cached",
    "make_encoder",
    "make_regions",
    "make_source",
    "make_texts",
    "read_image",
    "write_langsplat",
]
