"""A name that config.yml files of `ns-train normlift` of version 0.1 use."""

from normlift_ns.options import LiftOptions

__all__ = ["LiftOptions"]
