"""The values of a config.yml, checked before nerfstudio uses them."""

from __future__ import annotations

import types
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from normlift_ns.errors import InputError
from normlift_ns.options import LiftOptions, RefineConfig
from normlift_ns.scenes.nerfstudio.allowed import PAIRS
from normlift_ns.scenes.nerfstudio.classes import NAMES, SplatfactoModelConfig, TrainerConfig
from normlift_ns.scenes.nerfstudio.data_classes import DataParser, FullImageDatamanagerConfig
from normlift_ns.scenes.nerfstudio.optimizer_classes import OptimizerConfig, SchedulerConfig

_PARTS = {
    "pipeline": ("VanillaPipelineConfig", "NormLiftPipelineConfig"),
    "pipeline.datamanager": ("FullImageDatamanagerConfig",),
    "pipeline.datamanager.dataparser": tuple(cls.__name__ for cls in get_args(DataParser)),
    "pipeline.model": ("SplatfactoModelConfig", "NormLiftModelConfig"),
}
_PASSED_OVER = ("_target", "vis")
"""The loader compares the one; the other is for trainings alone, and programs set it to what the flag does not know."""
_DEEPEST, _LARGEST_INT = 12, 2**53
_REMEDY = "Restore the config.yml that ns-train wrote, or train the capture again with: ns-train splatfacto --data ..."


def check_config(config: Any, path: Path) -> None:
    """Refuses values that stock splatfacto could not have been trained with.

    Raises:
        ValueError: a value of another type than its field, a number out of its range, a name that is no name of a
            folder, or a part that is not splatfacto's.
    """
    if type(config) is not TrainerConfig:
        raise InputError(f"{path} is a {type(config).__name__}, expected a TrainerConfig. {_REMEDY}")
    check_parts(config, path)
    for name, value, expected in _wrong(config, TrainerConfig, "", 0):
        raise InputError(f"{path}: {name} is {_shown(value)}, expected {expected}. {_REMEDY}")
    _check_names(config, path)
    pipeline: Any = config.pipeline
    for name, value, fits, expected in _ranges(pipeline.model, pipeline.datamanager):
        if not fits:
            raise InputError(f"{path}: {name} is {_shown(value)}, expected {expected}. {_REMEDY}")
    if hasattr(pipeline, "lift"):
        check_options(pipeline.lift, f"{path}: pipeline.lift")


def check_parts(config: Any, path: Path) -> None:
    """Refuses pipelines, data managers, data parsers and models other than those that are tested here.

    Raises:
        ValueError: one of them is of another class; the message names both.
    """
    for name, classes in _PARTS.items():
        part: Any = config
        for step in name.split("."):
            part = getattr(part, step)
        found = type(part)
        if found.__name__ not in classes or NAMES.get(found, f"{found.__module__}.{found.__qualname__}") not in PAIRS:
            raise InputError(
                f"{path} says method {str(config.method_name)!r}, but its {name} is a {found.__name__}, expected "
                f"{' or '.join(classes)}; only stock splatfacto runs can be lifted. "
                "Train the capture with: ns-train splatfacto --data ..."
            )


def _shown(value: Any) -> str:
    """Short, whatever it is."""
    if value is None or isinstance(value, str | bool | int | float | Path):
        try:
            text = "null" if value is None else repr(str(value) if isinstance(value, Path) else value)
        except ValueError:  # an integer of thousands of digits
            text = "a huge number"
        return text if len(text) <= 60 else f"{text[:60]}…"
    return f"a {type(value).__name__}"


def _wrong(value: Any, hint: Any, name: str, depth: int) -> Iterator[tuple[str, Any, str]]:
    """Values that their type hints do not allow: where, what was found, what was expected."""
    origin, parts = get_origin(hint), get_args(hint)
    if depth > _DEEPEST:
        yield name, value, "no more than a few levels"
    elif hint is Any:
        yield from _wrong_optimizer(value, name) if name.startswith("optimizers.") else ()
    elif origin in (Union, types.UnionType):
        classes = [part for part in parts if is_dataclass(part) and type(value) is part]
        tried = [list(_wrong(value, part, name, depth)) for part in classes or parts]
        if all(tried):
            yield tried[0][0] if classes else (name, value, " or ".join(map(_called, parts)))
    elif origin is Literal:
        if not any(type(value) is type(part) and value == part for part in parts):
            yield name, value, " or ".join(map(repr, parts))
    elif is_dataclass(hint):
        if not isinstance(value, hint):  # type: ignore[arg-type]
            yield name, value, _called(hint)
            return
        hints = get_type_hints(type(value))
        for item in fields(value):
            if item.name not in _PASSED_OVER:
                below = f"{name}.{item.name}" if name else item.name
                yield from _wrong(getattr(value, item.name), hints[item.name], below, depth + 1)
    elif origin is tuple:
        if not isinstance(value, tuple | list) or (parts[-1] is not Ellipsis and len(value) != len(parts)):
            yield name, value, _called(hint)
        else:
            each = parts[:1] * len(value) if parts[-1] is Ellipsis else parts
            for i, (item, part) in enumerate(zip(value, each)):
                yield from _wrong(item, part, f"{name}[{i}]", depth + 1)
    elif origin is dict:
        if not isinstance(value, dict) or not all(isinstance(key, str) for key in value):
            yield name, value, _called(hint)
        else:
            for key, item in value.items():
                yield from _wrong(item, parts[1], f"{name}.{key[:40]}", depth + 1)
    elif hint is float:
        if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= 1e300:
            yield name, value, "a finite number"
    elif hint is int:
        if type(value) is not int or abs(value) > _LARGEST_INT:
            yield name, value, "a whole number"
    elif hint is str or hint is Path:
        if not isinstance(value, hint) or "\0" in str(value):
            yield name, value, "text" if hint is str else "a path"
    elif isinstance(hint, type) and not isinstance(value, hint):
        yield name, value, _called(hint)


def _wrong_optimizer(value: Any, name: str) -> Iterator[tuple[str, Any, str]]:
    """One of `optimizers`, which nerfstudio does not describe."""
    if not isinstance(value, dict) or set(value) != {"optimizer", "scheduler"}:
        yield name, value, "an optimizer and a scheduler"
        return
    yield from _wrong(value["optimizer"], OptimizerConfig, f"{name}.optimizer", 2)
    yield from _wrong(value["scheduler"], SchedulerConfig | None, f"{name}.scheduler", 2)


def _called(hint: Any) -> str:
    names = {float: "a number", int: "a whole number", str: "text", Path: "a path", type(None): "null"}
    return names.get(hint) or getattr(hint, "__name__", None) or str(hint).replace("typing.", "")


def _check_names(config: TrainerConfig, path: Path) -> None:
    """Runs lie in folders of these names: none of them may lead elsewhere."""
    for name in ("experiment_name", "method_name", "timestamp"):
        value = getattr(config, name)
        if (
            not isinstance(value, str)
            or value.strip() in ("", ".", "..")
            or {"/", "\\", "\0", "\n"} & set(value)
            or len(value) > 255
        ):
            raise InputError(f"{path}: {name} is {_shown(value)}, expected the name of one folder. {_REMEDY}")
    below = {
        "viewer.relative_log_filename": Path(config.viewer.relative_log_filename),
        "logging.relative_log_dir": config.logging.relative_log_dir,
        "relative_model_dir": config.relative_model_dir,
    }
    for name, place in below.items():
        if place.is_absolute() or ".." in place.parts:
            raise InputError(f"{path}: {name} is {_shown(place)}, expected a place in the folder of the run. {_REMEDY}")


def _ranges(
    model: SplatfactoModelConfig, datamanager: FullImageDatamanagerConfig
) -> Iterator[tuple[str, Any, bool, str]]:
    """Numbers that a lift depends on: name, value, whether it fits, and what would."""
    yield "pipeline.model.sh_degree", model.sh_degree, 0 <= model.sh_degree <= 4, "0 to 4"
    every = model.sh_degree_interval
    yield "pipeline.model.sh_degree_interval", every, every >= 1, "at least 1"
    scale = datamanager.camera_res_scale_factor
    yield "pipeline.datamanager.camera_res_scale_factor", scale, 0 < scale <= 1, "above 0 and at most 1"
    parser: Any = datamanager.dataparser
    limits = {
        "scale_factor": (lambda value: value > 0, "above 0"),
        "downscale_factor": (lambda value: value is None or 1 <= value <= 2**10, "1 to 1024, or null"),
        "train_split_fraction": (lambda value: 0 < value <= 1, "above 0 and at most 1"),
        "eval_interval": (lambda value: value >= 1, "at least 1"),
    }
    for name, (fits, expected) in limits.items():
        value = getattr(parser, name, None)
        if hasattr(parser, name):
            yield f"pipeline.datamanager.dataparser.{name}", value, fits(value), expected


def check_options(options: LiftOptions, name: str) -> None:
    """What the constructors check, which neither a config.yml nor `ns-train --load-config` calls.

    Raises:
        ValueError: an option out of its range.
    """
    try:
        RefineConfig(**vars(options.vote))
        LiftOptions(**vars(options))
    except ValueError as error:
        raise InputError(f"{name}: {error}. {_REMEDY}") from error
