"""Folders as transformers writes them: of which network they are, and its model.

Of config.json only the sizes of the parts are taken, so that it can name no code, no kernels and no other weights.
"""

from __future__ import annotations

import importlib
import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file

from normlift_ns.encoders.weights import first_line
from normlift_ns.errors import InputError

WEIGHTS = "model.safetensors"
_MOST_PARTS, _LARGEST_SIZE, _DEEPEST = 512, 2**16, 8
"""Of layers, labels and entries; of every other number in a config; and of values within values."""
_LEAST_TORCH = (2, 6)
_WORKS = (
    "the first SAM works with this one: --regions sam --sam-model sam_vit_h_4b8939.pth, a file as Meta publishes it"
)
_PROMPTED = ("vision_config", "prompt_encoder_config", "mask_decoder_config")
_NOT_SIZES = ("auto_map", "quantization_config", "architectures", "dtype", "torch_dtype", "transformers_version")


@dataclass(frozen=True)
class Kind:
    """A network that transformers has."""

    name: str
    model: str
    """Names of the classes in transformers."""
    config: str
    parts: tuple[str, ...]
    """The configs within its config."""
    nested: tuple[tuple[str, str], ...] = ()
    """Configs further within, as paths with dots, and the network that each must be of."""
    within: str | None = None
    """The entry of config.json that its config is in; None: config.json is it."""
    since: str = "4.50"
    """Version of transformers that brought it."""


_HIERA = (("vision_config.backbone_config", "sam2_hiera_det_model"),)
_SAM3 = ("vision_config", "text_config", "geometry_encoder_config", "detr_encoder_config", "detr_decoder_config",
         "mask_decoder_config")  # fmt: skip
_SAM3_NESTED = (("vision_config.backbone_config", "sam3_vit_model"), ("text_config", "clip_text_model"))
SAM = Kind("SAM", "SamModel", "SamConfig", _PROMPTED)
_SAM2 = Kind("SAM 2", "Sam2Model", "Sam2Config", _PROMPTED, _HIERA, since="4.56")
MASK_KINDS: dict[str, Kind] = {
    "sam": SAM,
    "sam2": _SAM2,
    "sam2_video": _SAM2,  # what the checkpoints of SAM 2 and 2.1 say, of which the model for images is a part
    "sam_hq": Kind("HQ-SAM", "SamHQModel", "SamHQConfig", _PROMPTED, since="4.52"),
}
"""Networks that answer points with masks, by the model type of config.json."""
TEXT_KINDS: dict[str, Kind] = {
    "sam3": Kind("SAM 3", "Sam3Model", "Sam3Config", _SAM3, _SAM3_NESTED, since="5.0"),
    "sam3_video": Kind("SAM 3", "Sam3Model", "Sam3Config", _SAM3, _SAM3_NESTED, "detector_config", since="5.0"),
}
"""Networks that answer texts with masks."""


def import_transformers() -> Any:
    """transformers, imported at the first use because that takes seconds.

    Raises:
        ValueError: it is not installed.
    """
    try:
        return importlib.import_module("transformers")
    except ImportError as error:
        raise InputError(
            f"--regions sam needs the package transformers ({first_line(error)}); install it with: "
            'pip install "normlift-ns[sam]", or cut the images without SAM: --regions patches or superpixel'
        ) from None


def kind_of(folder: Path, known: Mapping[str, Kind]) -> Kind:
    """Which network the config.json of a folder is of.

    Raises:
        ValueError: none of those known, or one that the installed torch or transformers cannot run.
        OSError: there is no config.json.
    """
    found = _config(folder).get("model_type")
    kind = known.get(found) if isinstance(found, str) else None
    if kind is None:
        other = (TEXT_KINDS if known is MASK_KINDS else MASK_KINDS).get(str(found))
        hint = "" if other is None else f" ({other.name} answers {'texts' if known is MASK_KINDS else 'points'}: "
        hint += "" if other is None else f"--regions {'sam3' if known is MASK_KINDS else 'sam'})"
        expected = ", ".join(f"{name!r}" for name in known)
        raise InputError(f"config.json is of model type {found!r:.60}{hint}, expected one of {expected}")
    check_runs(kind)
    return kind


def check_runs(kind: Kind) -> None:
    """Raises InputError for a network that the installed torch or transformers cannot run."""
    if kind is SAM:
        return
    have = tuple(int(part) for part in torch.__version__.split("+")[0].split(".")[:2])
    if have < _LEAST_TORCH:
        raise InputError(
            f"{kind.name} needs torch {'.'.join(map(str, _LEAST_TORCH))} or newer, this is {torch.__version__}; "
            f"{_WORKS}"
        )
    transformers = import_transformers()
    if not hasattr(transformers, kind.model):
        raise InputError(
            f"{kind.name} needs transformers {kind.since} or newer, this is {transformers.__version__}; {_WORKS}"
        )


def load_folder(folder: Path, kind: Kind) -> Any:
    """transformers' model with the weights of a folder, in float32 on the CPU.

    Raises:
        ValueError: weights that are missing or do not fit, or a config that no such network has. Other types of errors
            of foreign libraries, for whatever else is damaged.
    """
    transformers = import_transformers()
    if not (folder / WEIGHTS).is_file():
        raise InputError(f"the folder has no {WEIGHTS}")
    config = getattr(transformers, kind.config)(**_sizes(_config(folder), kind))
    with _quiet(transformers):
        model, told = getattr(transformers, kind.model).from_pretrained(
            None,
            config=config,
            state_dict=load_file(folder / WEIGHTS),
            dtype=torch.float32,
            attn_implementation="sdpa",
            output_loading_info=True,
        )
    missing = sorted(map(str, [*told["missing_keys"], *told["mismatched_keys"]]))
    if len(missing) > 0:
        raise InputError(f"{WEIGHTS} lacks {len(missing)} parameters, {missing[0]} the first")
    return model.eval().requires_grad_(False)


@contextmanager
def _quiet(transformers: Any) -> Iterator[None]:
    """Without transformers' bar and its report on every parameter."""
    logging = transformers.utils.logging
    level, bar = logging.get_verbosity(), logging.is_progress_bar_enabled()
    logging.set_verbosity_error()
    logging.disable_progress_bar()
    try:
        yield
    finally:
        logging.set_verbosity(level)
        if bar:
            logging.enable_progress_bar()


def _config(folder: Path) -> dict[str, Any]:
    found = json.loads((folder / "config.json").read_text("utf8"))
    if not isinstance(found, dict):
        raise InputError(f"config.json holds {type(found).__name__}, expected an object")
    return found


def _sizes(config: dict[str, Any], kind: Kind) -> dict[str, Any]:
    """The parts of a config, without what is no size."""
    within = config if kind.within is None else config.get(kind.within)
    parts = {name: within.get(name) for name in kind.parts} if isinstance(within, Mapping) else {}
    for name, part in parts.items():
        if not isinstance(part, Mapping):
            raise InputError(f"{name} of config.json is {type(part).__name__}, expected an object")
    check_sizes(parts)
    sizes = _without(parts)
    for path, expected in kind.nested:
        part: Any = sizes
        for name in path.split("."):
            part = part.get(name) if isinstance(part, Mapping) else None
        found = part.get("model_type", expected) if isinstance(part, Mapping) else None
        if found != expected:
            raise InputError(f"{path} of config.json is of model type {found!r:.60}, expected {expected!r}")
    return sizes


def _without(value: Any) -> Any:
    if isinstance(value, Mapping):
        dropped = [name for name in value if str(name).startswith("_") or "attn_impl" in str(name)]
        return {name: _without(x) for name, x in value.items() if name not in (*_NOT_SIZES, *dropped)}
    return [_without(x) for x in value] if isinstance(value, list) else value


def check_sizes(values: Any, name: str = "config.json", depth: int = 0) -> None:
    """Raises InputError for numbers that no network has: transformers builds what a config says, however large."""
    if depth > _DEEPEST or (isinstance(values, Mapping | list) and len(values) > _MOST_PARTS):
        raise InputError(f"{name} is nested too deeply, or has more than {_MOST_PARTS} entries")
    if isinstance(values, Mapping):
        for key, value in values.items():
            check_sizes(value, str(key), depth + 1)
    elif isinstance(values, list):
        for value in values:
            check_sizes(value, name, depth + 1)
    elif isinstance(values, int | float):
        most = _MOST_PARTS if name.startswith("num_") or name.endswith("depth") else _LARGEST_SIZE
        if not -1 <= values <= most:
            raise InputError(f"{name} of config.json is {values!r:.40}, expected at most {most:,}")
