"""Model folders of transformers: config.json, safetensors weights, tokenizer.json and image preprocessing.

Files are untrusted until checked. Of a configuration, only the sizes of the network are used, each within bounds,
because configurations may name code, kernels to download and quantized formats. Needs no torch.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from normlift_ns.encoders.hub.families import Family, of_tokenizer
from normlift_ns.errors import InputError, shortened

CONFIG, WEIGHTS, INDEX, TOKENS = "config.json", "model.safetensors", "model.safetensors.index.json", "tokenizer.json"
_TOKENIZER_CONFIG, _SPECIAL_TOKENS = "tokenizer_config.json", "special_tokens_map.json"
_PREPROCESSING_FILES = ("preprocessor_config.json", "processor_config.json")
"""The second file holds the contents of the first under "image_processor", among other entries."""
SMALL_FILES = (CONFIG, INDEX, TOKENS, _TOKENIZER_CONFIG, _SPECIAL_TOKENS, *_PREPROCESSING_FILES)
_MAX_JSON_BYTES, _MAX_SHARDS = 2**27, 256
_MAX_SIZES = {
    "vocab_size": 2**21, "hidden_size": 2**14, "intermediate_size": 2**17, "num_hidden_layers": 256,
    "num_attention_heads": 256, "max_position_embeddings": 2**12, "projection_size": 2**14, "projection_dim": 2**14,
    "image_size": 2**12, "patch_size": 2**8, "num_patches": 2**16, "eos_token_id": 2**21, "num_channels": 3,
}  # fmt: skip
"""Configuration entries that are used, and their largest accepted values."""
_ACTIVATIONS = ("gelu", "gelu_fast", "gelu_new", "gelu_pytorch_tanh", "quick_gelu", "relu", "silu")


@dataclass(frozen=True)
class Pixels:
    """Normalization of pixels, 0..255, for the network: (factor x - mean) / std."""

    factor: float
    mean: tuple[float, ...]
    std: tuple[float, ...]
    side: int | None
    """Height and width of input images; None: unknown, or not equal."""
    patches: int | None
    """Largest number of patches of an image, if images keep their aspect ratio; else None."""


@dataclass(frozen=True)
class Tokens:
    """Padding of tokenized texts."""

    pad: str
    """Padding token."""
    side: str
    """left or right."""
    masked: bool
    """True if an attention mask hides padding from the network; SigLIP was trained without one."""


@dataclass(frozen=True)
class Folder:
    """The checked contents of a model folder."""

    path: Path
    model_type: str
    text: dict[str, Any]
    vision: dict[str, Any]
    whole: dict[str, Any]
    """Network sizes, by their names in the configurations of transformers: of the text part, the vision part, and the
    whole network."""
    pixels: Pixels
    tokens: Tokens
    weights: tuple[Path, ...]
    """safetensors files."""

    @property
    def files(self) -> tuple[Path, ...]:
        """All files that change the embeddings, in a fixed order."""
        small = (self.path / name for name in SMALL_FILES)
        return (*(file for file in small if file.is_file()), *self.weights)


def read_folder(path: Path, family: Family) -> Folder:
    """Read and check a model folder; weights and vocabulary are not read.

    Raises:
        InputError: If the folder is of another architecture, incomplete or damaged.
    """
    remedy = f"give --encoder-model the folder of a {family.title} network, or a name such as {family.default}"
    try:
        return _read(path, family)
    except InputError as error:
        raise InputError(f"{path}: {error}; {remedy}, or use --encoder open_clip") from None


def _read(path: Path, family: Family) -> Folder:
    """Read a model folder; error messages do not name it."""
    config = read_json(path / CONFIG)
    kind = config.get("model_type")
    if kind not in family.model_types:
        expected = " or ".join(map(repr, family.model_types))
        raise InputError(f"{CONFIG} has the architecture {kind!r:.60}, expected that of {family.title}, {expected}")
    text, vision = (_sizes(config.get(f"{part}_config"), f"{part}_config") for part in ("text", "vision"))
    whole = {key: value for key, value in _sizes(config, CONFIG).items() if key == "projection_dim"}
    if vision.pop("vision_use_head", True) is not True:
        raise InputError(f"the network has no pooling head according to {CONFIG}, and thus no joint space")
    tokens = _tokens(path, family)
    return Folder(path, kind, text, vision, whole, _pixels(path, family, kind), tokens, _weights(path))


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON file that holds an object.

    Raises:
        InputError: If the file does not exist, is not JSON, or holds anything but an object.
    """
    if not path.is_file():
        raise InputError(f"{path.name} is missing" if not os.path.lexists(path) else f"{path.name} is not a file")
    if path.stat().st_size > _MAX_JSON_BYTES:
        raise InputError(f"{path.name} has {path.stat().st_size:,} bytes, more than {_MAX_JSON_BYTES:,}")
    try:
        content = json.loads(path.read_text("utf8"))
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{path.name} is damaged ({type(error).__name__})") from None
    if not isinstance(content, dict):
        raise InputError(f"{path.name} holds {type(content).__name__}, expected an object")
    return content


def _sizes(values: object, where: str) -> dict[str, Any]:
    """Return the checked sizes of a configuration that are present and not null."""
    if values is None:
        return {}
    if not isinstance(values, Mapping):
        raise InputError(f"{where} of {CONFIG} is {type(values).__name__}, expected an object")
    sizes = {}
    for key, maximum in _MAX_SIZES.items():
        value = values.get(key)
        if value is None:
            continue
        if type(value) is not int or not (0 if key.endswith("_id") else 1) <= value <= maximum:
            raise InputError(f"{key} of {where} is {value!r:.40}, expected an integer, at most {maximum:,}")
        sizes[key] = value
    if (activation := values.get("hidden_act")) is not None:
        if activation not in _ACTIVATIONS:
            raise InputError(f"hidden_act of {where} is {activation!r:.40}, expected one of {', '.join(_ACTIVATIONS)}")
        sizes["hidden_act"] = activation
    if (epsilon := values.get("layer_norm_eps")) is not None:
        sizes["layer_norm_eps"] = _number(epsilon, f"layer_norm_eps of {where}", 1e-12, 1.0)
    if "vision_use_head" in values:
        sizes["vision_use_head"] = values["vision_use_head"]
    return sizes


def _number(value: object, name: str, minimum: float, maximum: float) -> float:
    """Return a number as float; raise InputError unless it is in minimum..maximum."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not minimum <= value <= maximum:
        raise InputError(f"{name} is {value!r:.40}, expected a number in {minimum:g}..{maximum:g}")
    return float(value)


def _pixels(path: Path, family: Family, kind: str) -> Pixels:
    """Read the normalization of pixels."""
    names = [name for name in _PREPROCESSING_FILES if (path / name).is_file()]
    if len(names) == 0:
        raise InputError(f"{_PREPROCESSING_FILES[0]}, which describes image preprocessing, is missing")
    file = names[0]
    settings = read_json(path / file)
    settings = settings.get("image_processor", settings)
    if not isinstance(settings, Mapping):
        raise InputError(f"image_processor of {file} is {type(settings).__name__}, expected an object")

    def three(key: str, default: tuple[float, ...], minimum: float) -> tuple[float, ...]:
        values = settings.get(key, list(default))
        if not isinstance(values, list) or len(values) != 3:
            raise InputError(f"{key} of {file} is {values!r:.40}, expected three numbers")
        return tuple(_number(value, f"{key} of {file}", minimum, 1e3) for value in values)

    normalize = settings.get("do_normalize", True) is not False
    factor = _number(settings.get("rescale_factor", 1 / 255), f"rescale_factor of {file}", 1e-6, 1e3)
    patches = settings.get("max_num_patches", 256)
    if kind == "siglip2" and (type(patches) is not int or not 1 <= patches <= _MAX_SIZES["num_patches"]):
        raise InputError(f"max_num_patches of {file} is {patches!r:.40}, expected an integer")
    return Pixels(
        factor if settings.get("do_rescale", True) is not False else 1.0,
        three("image_mean", family.mean, -1e3) if normalize else (0.0, 0.0, 0.0),
        three("image_std", family.std, 1e-6) if normalize else (1.0, 1.0, 1.0),
        None if kind == "siglip2" else _side(settings),
        patches if kind == "siglip2" else None,
    )


def _side(settings: Mapping[str, Any]) -> int | None:
    """Return the side of square input images; None if unknown or not square."""
    cropped = settings.get("do_center_crop", "crop_size" in settings) is True
    size = settings.get("crop_size" if cropped else "size")
    if isinstance(size, Mapping):
        size = size.get("height", size.get("shortest_edge")) if size.get("height") == size.get("width") else None
    return size if type(size) is int else None


def _tokens(path: Path, family: Family) -> Tokens:
    """Read the padding of texts; raise InputError if the tokenizer is missing or of another family."""
    if not (path / TOKENS).is_file():
        older = "; there is only an older spiece.model" if (path / "spiece.model").is_file() else ""
        raise InputError(f"{TOKENS}, which encodes texts, is missing{older}")
    files = [path / name for name in (_SPECIAL_TOKENS, _TOKENIZER_CONFIG) if (path / name).is_file()]
    settings = {key: value for file in files for key, value in read_json(file).items()}
    name = settings.get("tokenizer_class")
    owner = of_tokenizer(name) if isinstance(name, str) else None
    if owner is not None and owner != family:
        raise InputError(
            f"its tokenizer {shortened(str(name))} belongs to {owner.title}, not {family.title}: use "
            f"--encoder {owner.name}"
        )
    pad = settings.get("pad_token") or family.pad
    pad = pad.get("content") if isinstance(pad, Mapping) else pad
    side = settings.get("padding_side", "right")
    if not isinstance(pad, str) or side not in ("left", "right"):
        raise InputError(f"{_TOKENIZER_CONFIG} has the unknown pad_token {pad!r:.40} or padding_side {side!r:.40}")
    inputs = settings.get("model_input_names", ["input_ids"])
    return Tokens(pad, side, isinstance(inputs, list) and "attention_mask" in inputs)


def _weights(path: Path) -> tuple[Path, ...]:
    """Return the weight files: one, or the shards that the index names."""
    if (path / WEIGHTS).is_file():
        return (path / WEIGHTS,)
    if not (path / INDEX).is_file():
        pickled = "; pickles such as pytorch_model.bin are not read" if any(path.glob("*.bin")) else ""
        raise InputError(f"{WEIGHTS} is missing{pickled}")
    shards = read_json(path / INDEX).get("weight_map")
    names = sorted({*shards.values()} if isinstance(shards, Mapping) and all(map(_is_shard, shards.values())) else ())
    if not 0 < len(names) <= _MAX_SHARDS:
        raise InputError(f"weight_map of {INDEX} is invalid, expected file names like model-00001-of-00002.safetensors")
    missing = [name for name in names if not (path / name).is_file()]
    if len(missing) > 0:
        raise InputError(f"{missing[0]}, which {INDEX} names, is missing")
    return tuple(path / name for name in names)


def _is_shard(name: object) -> bool:
    """Return whether a name is that of a safetensors file in the same folder."""
    return isinstance(name, str) and name.endswith(".safetensors") and name == os.path.basename(name)


def patch_side(count: int) -> int:
    """Return the number of patches along the side of a square image that has at most `count` patches.

    >>> patch_side(256), patch_side(300)
    (16, 17)
    """
    return max(1, math.isqrt(count))
