"""What nerfstudio's entry points name: the methods, or None and a line on standard error where one cannot be loaded.

Every ns-* command loads all entry points without a try, so that an error in one of them would end all methods of all
packages. nerfstudio passes over what is no MethodSpecification.
"""

from __future__ import annotations

import sys
from importlib import import_module
from typing import Any


def _method(name: str) -> Any:
    try:
        return getattr(import_module(f"normlift_ns.method_configs.{name}"), f"{name}_method")
    except Exception as error:  # whatever is missing or broken
        if sys.stderr is not None:
            reason = f"{type(error).__name__}: {error}"
            sys.stderr.write(f"normlift_ns: the method {name} cannot be used ({reason}). Other methods work.\n")
        return None


normlift_method = _method("normlift")
lerf_ovs_method = _method("lerf_ovs")
scannet_method = _method("scannet")
