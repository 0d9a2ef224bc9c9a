"""Targets of nerfstudio's entry points: each method, or None and a line on standard error if it cannot be loaded.

Every ns-* command loads all entry points without a try block. An error in one of them would therefore disable the
methods of all packages. nerfstudio ignores anything that is not a MethodSpecification.
"""

from __future__ import annotations

import sys
from importlib import import_module
from typing import Any


def _load_method(name: str) -> Any:
    try:
        return getattr(import_module("normlift_ns.method_configs.normlift"), f"{name}_method")
    except Exception as error:  # any missing or broken dependency
        if sys.stderr is not None:
            reason = f"{type(error).__name__}: {error}"
            sys.stderr.write(f"normlift_ns: the method {name} cannot be used ({reason}). Other methods work.\n")
        return None


normlift_method = _load_method("normlift")
lerf_ovs_method = _load_method("lerf_ovs")
scannet_method = _load_method("scannet")
