"""Method specifications for nerfstudio's entry points, or None if a method cannot be loaded.

nerfstudio's commands load all entry points without a try block. An error in one of them would therefore disable the
methods of all packages. Here, it is printed to standard error instead. nerfstudio ignores objects that are not a
MethodSpecification.
"""

from __future__ import annotations

import sys
from importlib import import_module
from pathlib import Path
from typing import Any


def _rename_flags(words: list[str]) -> list[str]:
    """Replace old option names in a command line of ns-train with a normlift method; leave others unchanged."""
    from normlift_ns.options import LiftOptions, SourceOptions, rename_flags, renamed_flags  # noqa: PLC0415 (may fail)

    if Path("".join(words[:1])).stem != "ns-train" or not "".join(words[1:2]).startswith("normlift"):
        return words
    flags = renamed_flags(LiftOptions, "--pipeline.lift.") | renamed_flags(SourceOptions, "--pipeline.source.")
    return rename_flags(words, flags)


def _load_method(name: str) -> Any:
    try:
        sys.argv[:] = _rename_flags(sys.argv)
        return getattr(import_module("normlift_ns.method_configs.normlift"), f"{name}_method")
    except Exception as error:  # any missing or broken dependency
        if sys.stderr is not None:
            method = "normlift" if name == "normlift" else f"normlift-{name.replace('_', '-')}"
            problem = f"the method {method} cannot be used ({type(error).__name__}: {error})"
            sys.stderr.write(f"normlift_ns: {problem}. Methods of other packages still work.\n")
        return None


normlift_method = _load_method("normlift")
lerf_ovs_method = _load_method("lerf_ovs")
scannet_method = _load_method("scannet")
