"""Reader for cfg.yml, the settings file that gsplat's trainer stores next to ckpts/ and ply/."""

from __future__ import annotations

import math
from pathlib import Path
from typing import NamedTuple, cast

import yaml

from normlift_ns.data.nerfstudio.config import config_string, describe_yaml_error
from normlift_ns.errors import InputError
from normlift_ns.io.guard import read_text
from normlift_ns.options import Primitive, RasterizeMode

_NAMES = ("cfg.yml", "cfg.json")
"""Possible names of the settings file. simple_trainer_2dgs.py writes a .json file, which is also valid YAML."""
_MAX_BYTES = 2**18
_FOLDERS = ("ckpts", "ply")
_OF_3DGUT = ("with_ut", "with_eval3d")
_ADVICE = "Copy it from the training run again, or move the splat to a separate folder."


class GsplatConfig(NamedTuple):
    """Settings in a cfg.yml that affect the world, the rendering or the training images; None for missing settings."""

    path: Path
    rasterize_mode: RasterizeMode | None
    normalize_world_space: bool | None
    test_every: int | None
    primitive: Primitive | None
    clip_planes: tuple[float, float] | None
    """Near and far planes in world units."""


def find_gsplat_config(splat: Path) -> GsplatConfig | None:
    """Read the cfg.yml of the training run that contains a checkpoint or PLY file.

    Returns:
        The settings, or None without a cfg.yml of gsplat's trainer.
    Raises:
        ValueError: The file is damaged, a setting is not valid, or the splat was not trained as 3D or 2D Gaussians with
            pinhole cameras.
    """
    folder = splat.parent.parent if splat.parent.name in _FOLDERS else splat.parent
    path = next((folder / name for name in _NAMES if (folder / name).is_file()), None)
    root = None if path is None else _parse(path)
    if path is None or config_string(root, "result_dir") is None or config_string(root, "data_dir") is None:
        return None  # another program wrote the file
    primitive, antialiased = _primitive(path, root), _flag(path, root, "antialiased")
    mode = None if antialiased is None else "antialiased" if antialiased else "classic"
    near, far = (_number(path, root, name) for name in ("near_plane", "far_plane"))
    return GsplatConfig(
        path,
        "classic" if primitive == "2dgs" else mode,
        _flag(path, root, "normalize_world_space"),
        _test_every(path, root),
        primitive,
        None if near is None or far is None else (near, far),
    )


def _parse(path: Path) -> yaml.Node | None:
    if path.stat().st_size > _MAX_BYTES:
        raise InputError(f"{path} has {path.stat().st_size:,} bytes, expected at most {_MAX_BYTES:,}. {_ADVICE}")
    try:
        return yaml.compose(read_text(path), Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError, OSError) as error:
        raise InputError(f"{path} cannot be read as YAML ({describe_yaml_error(error)}). {_ADVICE}") from error


def _test_every(path: Path, root: yaml.Node | None) -> int | None:
    text = config_string(root, "test_every")
    if text is not None and not (text.isdecimal() and 1 < int(text) < 10**9):
        raise InputError(f"{path} has test_every {text[:40]!r}, expected a whole number above 1. {_ADVICE}")
    return None if text is None else int(text)


def _number(path: Path, root: yaml.Node | None, name: str) -> float | None:
    text = config_string(root, name)
    if text is None:
        return None
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not 0 < number < math.inf:
        raise InputError(f"{path} has {name} {text[:40]!r}, expected a number above 0. {_ADVICE}")
    return number


def _flag(path: Path, root: yaml.Node | None, name: str) -> bool | None:
    text = config_string(root, name)
    if text not in (None, "true", "false"):
        raise InputError(f"{path} has {name} {text[:40]!r}, expected true or false. {_ADVICE}")
    return None if text is None else text == "true"


def _primitive(path: Path, root: yaml.Node | None) -> Primitive | None:
    model_type, camera_model = config_string(root, "model_type"), config_string(root, "camera_model")
    of_3dgut = [name for name in _OF_3DGUT if _flag(path, root, name)]
    if len(of_3dgut) > 0:
        problem = f"{of_3dgut[0]}: true (3DGUT), which renders Gaussians differently"
    elif model_type not in (None, "3dgs", "2dgs"):
        problem = f"model_type: {model_type[:40]}, which renders Gaussians differently"
    elif camera_model not in (None, "pinhole"):
        problem = f"camera_model: {camera_model[:40]}"
    else:
        return cast("Primitive | None", model_type)
    raise InputError(
        f"According to {path}, the splat was trained with the setting {problem}. Expected 3D or 2D Gaussians "
        "and pinhole cameras. Train the scene again with simple_trainer.py or simple_trainer_2dgs.py and undistorted "
        "images."
    )
