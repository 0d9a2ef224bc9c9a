"""Old import path of `LiftOptions`, in config.yml files that `ns-train normlift` of version 0.1 wrote."""

from normlift_ns.options import LiftOptions

__all__ = ["LiftOptions"]
