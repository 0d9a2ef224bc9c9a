"""Detection and loading of networks from model folders in the format of transformers.

Only the sizes of the parts are read from config.json, so it cannot name code, kernels or other weights.
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
_MAX_PARTS, _MAX_SIZE, _MAX_DEPTH = 512, 2**16, 8
"""Upper bounds of layers, labels and entries; of every other number in a config; and of the nesting depth."""
_MIN_TORCH = (2, 6)
_ALTERNATIVE = (
    "the first SAM works with this version: --regions sam --sam-model sam_vit_h_4b8939.pth, a file published by Meta"
)
_SAM_CONFIGS = ("vision_config", "prompt_encoder_config", "mask_decoder_config")
_NOT_SIZES = ("auto_map", "quantization_config", "architectures", "dtype", "torch_dtype", "transformers_version")


@dataclass(frozen=True)
class Kind:
    """Network that transformers implements."""

    name: str
    model: str
    """Name of its model class in transformers."""
    config: str
    """Name of its config class in transformers."""
    parts: tuple[str, ...]
    """Names of the configs in its config."""
    nested: tuple[tuple[str, str], ...] = ()
    """Dotted paths of more deeply nested configs, with the model type that each must have."""
    within: str | None = None
    """Entry of config.json that holds its config; None: the whole file."""
    since: str = "4.50"
    """First version of transformers that has it."""


_SAM2_NESTED = (("vision_config.backbone_config", "sam2_hiera_det_model"),)
_SAM3_CONFIGS = ("vision_config", "text_config", "geometry_encoder_config", "detr_encoder_config",
                 "detr_decoder_config", "mask_decoder_config")  # fmt: skip
_SAM3_NESTED = (("vision_config.backbone_config", "sam3_vit_model"), ("text_config", "clip_text_model"))
SAM = Kind("SAM", "SamModel", "SamConfig", _SAM_CONFIGS)
_SAM2 = Kind("SAM 2", "Sam2Model", "Sam2Config", _SAM_CONFIGS, _SAM2_NESTED, since="4.56")
MASK_KINDS: dict[str, Kind] = {
    "sam": SAM,
    "sam2": _SAM2,
    "sam2_video": _SAM2,  # in the checkpoints of SAM 2 and 2.1, which contain the image model
    "sam_hq": Kind("HQ-SAM", "SamHQModel", "SamHQConfig", _SAM_CONFIGS, since="4.52"),
}
"""Networks that turn points into masks, by the model type of config.json."""
TEXT_KINDS: dict[str, Kind] = {
    "sam3": Kind("SAM 3", "Sam3Model", "Sam3Config", _SAM3_CONFIGS, _SAM3_NESTED, since="5.0"),
    "sam3_video": Kind("SAM 3", "Sam3Model", "Sam3Config", _SAM3_CONFIGS, _SAM3_NESTED, "detector_config", since="5.0"),
}
"""Networks that turn text prompts into masks, by the model type of config.json."""


def import_transformers() -> Any:
    """Import transformers at the first use, because this takes seconds.

    Raises:
        ValueError: If transformers is not installed.
    """
    try:
        return importlib.import_module("transformers")
    except ImportError as error:
        raise InputError(
            f"--regions sam needs the package transformers ({first_line(error)}); install it with: "
            'pip install "normlift-ns[sam]", or segment without SAM: --regions patches or superpixel'
        ) from None


def kind_of(folder: Path, kinds: Mapping[str, Kind]) -> Kind:
    """Return the network that the config.json of a folder describes.

    Raises:
        ValueError: If it is not one of `kinds`, or if the installed torch or transformers cannot run it.
        OSError: If config.json is missing.
    """
    model_type = _config(folder).get("model_type")
    kind = kinds.get(model_type) if isinstance(model_type, str) else None
    if kind is None:
        other = (TEXT_KINDS if kinds is MASK_KINDS else MASK_KINDS).get(str(model_type))
        hint = "" if other is None else f" ({other.name} takes {'text prompts' if kinds is MASK_KINDS else 'points'}: "
        hint += "" if other is None else f"--regions {'sam3' if kinds is MASK_KINDS else 'sam'})"
        expected = ", ".join(f"{name!r}" for name in kinds)
        raise InputError(f"config.json has the model type {model_type!r:.60}{hint}, expected one of {expected}")
    _check_supported(kind)
    return kind


def _check_supported(kind: Kind) -> None:
    """Raise InputError if the installed torch or transformers cannot run a network."""
    if kind is SAM:
        return
    installed = tuple(int(part) for part in torch.__version__.split("+")[0].split(".")[:2])
    if installed < _MIN_TORCH:
        raise InputError(
            f"{kind.name} needs torch {'.'.join(map(str, _MIN_TORCH))} or newer, found {torch.__version__}; "
            f"{_ALTERNATIVE}"
        )
    transformers = import_transformers()
    if not hasattr(transformers, kind.model):
        raise InputError(
            f"{kind.name} needs transformers {kind.since} or newer, found {transformers.__version__}; {_ALTERNATIVE}"
        )


def load_folder(folder: Path, kind: Kind) -> Any:
    """Return the transformers model with the weights of a folder, in float32 on the CPU.

    Raises:
        ValueError: If weights are missing or do not fit, or if the config does not fit the network. Other damage can
            raise other exceptions of the libraries that read the folder.
    """
    transformers = import_transformers()
    if not (folder / WEIGHTS).is_file():
        raise InputError(f"the folder has no {WEIGHTS}")
    config = getattr(transformers, kind.config)(**_sizes(_config(folder), kind))
    with _quiet(transformers):
        model, report = getattr(transformers, kind.model).from_pretrained(
            None,
            config=config,
            state_dict=load_file(folder / WEIGHTS),
            dtype=torch.float32,
            attn_implementation="sdpa",
            output_loading_info=True,
        )
    missing = sorted(map(str, [*report["missing_keys"], *report["mismatched_keys"]]))
    if len(missing) > 0:
        raise InputError(f"{WEIGHTS} lacks {len(missing)} parameters, the first is {missing[0]}")
    return model.eval().requires_grad_(False)


@contextmanager
def _quiet(transformers: Any) -> Iterator[None]:
    """Silence the progress bar of transformers and its report on every parameter."""
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
    config = json.loads((folder / "config.json").read_text("utf8"))
    if not isinstance(config, dict):
        raise InputError(f"config.json holds {type(config).__name__}, expected an object")
    return config


def _sizes(config: dict[str, Any], kind: Kind) -> dict[str, Any]:
    """Return the parts of a config without the entries that are not sizes."""
    own = config if kind.within is None else config.get(kind.within)
    parts = {name: own.get(name) for name in kind.parts} if isinstance(own, Mapping) else {}
    for name, part in parts.items():
        if not isinstance(part, Mapping):
            raise InputError(f"{name} of config.json is {type(part).__name__}, expected an object")
    check_sizes(parts)
    sizes = _drop_other_entries(parts)
    for path, expected in kind.nested:
        part: Any = sizes
        for name in path.split("."):
            part = part.get(name) if isinstance(part, Mapping) else None
        model_type = part.get("model_type", expected) if isinstance(part, Mapping) else None
        if model_type != expected:
            raise InputError(f"{path} of config.json has the model type {model_type!r:.60}, expected {expected!r}")
    return sizes


def _drop_other_entries(value: Any) -> Any:
    if isinstance(value, Mapping):
        dropped = [name for name in value if str(name).startswith("_") or "attn_impl" in str(name)]
        return {name: _drop_other_entries(x) for name, x in value.items() if name not in (*_NOT_SIZES, *dropped)}
    return [_drop_other_entries(x) for x in value] if isinstance(value, list) else value


def check_sizes(values: Any, name: str = "config.json", depth: int = 0) -> None:
    """Raise InputError for implausible sizes, because transformers builds a network of any size from its config."""
    if depth > _MAX_DEPTH or (isinstance(values, Mapping | list) and len(values) > _MAX_PARTS):
        raise InputError(f"{name} is nested too deeply, or has more than {_MAX_PARTS} entries")
    if isinstance(values, Mapping):
        for key, value in values.items():
            check_sizes(value, str(key), depth + 1)
    elif isinstance(values, list):
        for value in values:
            check_sizes(value, name, depth + 1)
    elif isinstance(values, int | float):
        limit = _MAX_PARTS if name.startswith("num_") or name.endswith("depth") else _MAX_SIZE
        if not -1 <= values <= limit:
            raise InputError(f"{name} of config.json is {values!r:.40}, expected at most {limit:,}")
