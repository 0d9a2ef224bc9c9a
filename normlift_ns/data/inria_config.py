"""Reader for cfg_args, the settings that Inria's trainer stores next to point_cloud/."""

from __future__ import annotations

import ast
from pathlib import Path
from typing import NamedTuple

from normlift_ns.errors import InputError
from normlift_ns.io.guard import read_text

_NAME, _START = "cfg_args", "Namespace("
_MAX_BYTES = 2**16
TEST_EVERY = 8
"""Interval of the images that Inria's trainer holds out of a COLMAP project with --eval."""


class InriaConfig(NamedTuple):
    """Settings in a cfg_args file that affect rendering or the choice of training images."""

    path: Path
    white_background: bool
    has_test_images: bool
    antialiased: bool


def find_inria_config(splat: Path) -> InriaConfig | None:
    """Read the cfg_args of the training run that contains a splat file.

    Returns:
        The settings, or None if there is no cfg_args of Inria's trainer. Missing settings have the trainer's defaults.
    Raises:
        ValueError: The file is damaged.
    """
    folder = splat.parents[2] if len(splat.parents) > 2 and splat.parents[1].name == "point_cloud" else splat.parent
    path = folder / _NAME
    if not path.is_file():
        return None
    try:
        text = read_text(path).strip() if path.stat().st_size <= _MAX_BYTES else ""
        call = ast.parse(text, mode="eval").body if text.startswith(_START) else None
    except (SyntaxError, ValueError, RecursionError, MemoryError, OSError) as error:
        raise _damaged(path, f"{type(error).__name__}") from error
    if not isinstance(call, ast.Call):
        return None  # another program wrote the file
    flags = {item.arg: ast.unparse(item.value) for item in call.keywords}
    for name in ("white_background", "eval", "antialiasing"):
        if flags.get(name) not in (None, "True", "False"):
            raise _damaged(path, f"{name} is {flags[name][:40]}")
    return InriaConfig(path, *(flags.get(name) == "True" for name in ("white_background", "eval", "antialiasing")))


def _damaged(path: Path, problem: str) -> InputError:
    return InputError(
        f"{path} is damaged ({problem}), expected Namespace(…) with True or False for white_background, eval and "
        "antialiasing. Copy it from the training run again, or move the splat to a separate folder."
    )
