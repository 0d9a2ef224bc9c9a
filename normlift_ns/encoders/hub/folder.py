"""Folders as transformers writes them: config.json, weights in safetensors, tokenizer.json, how pixels are prepared.

Every file is a stranger's until it is checked. Nothing of a configuration is handed on but the sizes of the network,
each within bounds: configurations may name code, kernels to download and quantized formats. Needs no torch.
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
_TOKENS_CONFIG, _TOKENS_MAP = "tokenizer_config.json", "special_tokens_map.json"
_PIXELS = ("preprocessor_config.json", "processor_config.json")
"""The second holds what the first does, among others, under "image_processor"."""
SMALL_FILES = (CONFIG, INDEX, TOKENS, _TOKENS_CONFIG, _TOKENS_MAP, *_PIXELS)
_LARGEST_JSON, _MOST_SHARDS = 2**27, 256
_SIZES = {
    "vocab_size": 2**21, "hidden_size": 2**14, "intermediate_size": 2**17, "num_hidden_layers": 256,
    "num_attention_heads": 256, "max_position_embeddings": 2**12, "projection_size": 2**14, "projection_dim": 2**14,
    "image_size": 2**12, "patch_size": 2**8, "num_patches": 2**16, "eos_token_id": 2**21, "num_channels": 3,
}  # fmt: skip
"""What is taken from a configuration, and how large it may be."""
_ACTIVATIONS = ("gelu", "gelu_fast", "gelu_new", "gelu_pytorch_tanh", "quick_gelu", "relu", "silu")


@dataclass(frozen=True)
class Pixels:
    """How pixels, 0..255, become what the network sees: (factor x - mean) / std."""

    factor: float
    mean: tuple[float, ...]
    std: tuple[float, ...]
    side: int | None
    """Height and width of the images that it is fed with; None: unknown, or they differ."""
    patches: int | None
    """Patches of an image at most, where images keep their shape."""


@dataclass(frozen=True)
class Tokens:
    """How the tokenizer fills up texts."""

    pad: str
    side: str
    """left or right."""
    masked: bool
    """Whether the network is told which tokens fill up; SigLIP was trained to see them."""


@dataclass(frozen=True)
class Folder:
    """What a folder says, checked."""

    path: Path
    model_type: str
    text: dict[str, Any]
    vision: dict[str, Any]
    whole: dict[str, Any]
    """Sizes, by the names that the configurations of transformers give them."""
    pixels: Pixels
    tokens: Tokens
    weights: tuple[Path, ...]
    """safetensors files."""

    @property
    def files(self) -> tuple[Path, ...]:
        """All that changes what the network makes of images and texts, in a fixed order."""
        small = (self.path / name for name in SMALL_FILES)
        return (*(file for file in small if file.is_file()), *self.weights)


def read_folder(path: Path, family: Family) -> Folder:
    """What a folder says; weights and vocabulary are not read.

    Raises:
        InputError: it is of another architecture, incomplete or damaged.
    """
    remedy = f"give --encoder-model the folder of a {family.title} network, or a name such as {family.default}"
    try:
        return _read(path, family)
    except InputError as error:
        raise InputError(f"{path}: {error}; {remedy}, or use --encoder open_clip") from None


def _read(path: Path, family: Family) -> Folder:
    config = read_json(path / CONFIG)
    kind = config.get("model_type")
    if kind not in family.model_types:
        wanted = " or ".join(map(repr, family.model_types))
        raise InputError(f"{CONFIG} is of the architecture {kind!r:.60}, expected {wanted}, which {family.title} has")
    text, vision = (_sizes(config.get(f"{part}_config"), f"{part}_config") for part in ("text", "vision"))
    whole = {key: value for key, value in _sizes(config, CONFIG).items() if key == "projection_dim"}
    if vision.pop("vision_use_head", True) is not True:
        raise InputError(f"{CONFIG} says that the network has no pooling head, without which it has no joint space")
    tokens = _tokens(path, family)
    return Folder(path, kind, text, vision, whole, _pixels(path, family, kind), tokens, _weights(path))


def read_json(path: Path) -> dict[str, Any]:
    """An object in a JSON file.

    Raises:
        InputError: no file, no JSON, or anything but an object.
    """
    if not path.is_file():
        raise InputError(f"there is no {path.name}" if not os.path.lexists(path) else f"{path.name} is no file")
    if path.stat().st_size > _LARGEST_JSON:
        raise InputError(f"{path.name} has {path.stat().st_size:,} bytes, at most {_LARGEST_JSON:,}")
    try:
        found = json.loads(path.read_text("utf8"))
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{path.name} is damaged ({type(error).__name__})") from None
    if not isinstance(found, dict):
        raise InputError(f"{path.name} holds {type(found).__name__}, expected an object")
    return found


def _sizes(values: object, where: str) -> dict[str, Any]:
    """The sizes of a network that are there and not null."""
    if values is None:
        return {}
    if not isinstance(values, Mapping):
        raise InputError(f"{where} of {CONFIG} is {type(values).__name__}, expected an object")
    found = {}
    for key, most in _SIZES.items():
        value = values.get(key)
        if value is None:
            continue
        if type(value) is not int or not (0 if key.endswith("_id") else 1) <= value <= most:
            raise InputError(f"{key} of {where} is {value!r:.40}, expected a whole number, at most {most:,}")
        found[key] = value
    if (activation := values.get("hidden_act")) is not None:
        if activation not in _ACTIVATIONS:
            raise InputError(f"hidden_act of {where} is {activation!r:.40}, expected one of {', '.join(_ACTIVATIONS)}")
        found["hidden_act"] = activation
    if (epsilon := values.get("layer_norm_eps")) is not None:
        found["layer_norm_eps"] = _number(epsilon, f"layer_norm_eps of {where}", 1e-12, 1.0)
    if "vision_use_head" in values:
        found["vision_use_head"] = values["vision_use_head"]
    return found


def _number(value: object, name: str, least: float, most: float) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not least <= value <= most:
        raise InputError(f"{name} is {value!r:.40}, expected a number in {least:g}..{most:g}")
    return float(value)


def _pixels(path: Path, family: Family, kind: str) -> Pixels:
    there = [name for name in _PIXELS if (path / name).is_file()]
    if len(there) == 0:
        raise InputError(f"there is no {_PIXELS[0]}, which says how pixels are prepared")
    found = read_json(path / there[0])
    found = found.get("image_processor", found)
    if not isinstance(found, Mapping):
        raise InputError(f"image_processor of {there[0]} is {type(found).__name__}, expected an object")

    def three(key: str, default: tuple[float, ...], least: float) -> tuple[float, ...]:
        values = found.get(key, list(default))
        if not isinstance(values, list) or len(values) != 3:
            raise InputError(f"{key} of {there[0]} is {values!r:.40}, expected three numbers")
        return tuple(_number(value, f"{key} of {there[0]}", least, 1e3) for value in values)

    normal = found.get("do_normalize", True) is not False
    factor = _number(found.get("rescale_factor", 1 / 255), f"rescale_factor of {there[0]}", 1e-6, 1e3)
    patches = found.get("max_num_patches", 256)
    if kind == "siglip2" and (type(patches) is not int or not 1 <= patches <= _SIZES["num_patches"]):
        raise InputError(f"max_num_patches of {there[0]} is {patches!r:.40}, expected a whole number")
    return Pixels(
        factor if found.get("do_rescale", True) is not False else 1.0,
        three("image_mean", family.mean, -1e3) if normal else (0.0, 0.0, 0.0),
        three("image_std", family.std, 1e-6) if normal else (1.0, 1.0, 1.0),
        None if kind == "siglip2" else _side(found),
        patches if kind == "siglip2" else None,
    )


def _side(found: Mapping[str, Any]) -> int | None:
    cropped = found.get("do_center_crop", "crop_size" in found) is True
    size = found.get("crop_size" if cropped else "size")
    if isinstance(size, Mapping):
        size = size.get("height", size.get("shortest_edge")) if size.get("height") == size.get("width") else None
    return size if type(size) is int else None


def _tokens(path: Path, family: Family) -> Tokens:
    if not (path / TOKENS).is_file():
        older = "; it has an older spiece.model only" if (path / "spiece.model").is_file() else ""
        raise InputError(f"there is no {TOKENS}, without which no text can be read{older}")
    named = [path / name for name in (_TOKENS_MAP, _TOKENS_CONFIG) if (path / name).is_file()]
    found = {key: value for file in named for key, value in read_json(file).items()}
    name = found.get("tokenizer_class")
    owner = of_tokenizer(name) if isinstance(name, str) else None
    if owner is not None and owner != family:
        raise InputError(
            f"its tokenizer {shortened(str(name))} is of {owner.title}, expected {family.title}: --encoder {owner.name}"
        )
    pad = found.get("pad_token") or family.pad
    pad = pad.get("content") if isinstance(pad, Mapping) else pad
    side = found.get("padding_side", "right")
    if not isinstance(pad, str) or side not in ("left", "right"):
        raise InputError(f"{_TOKENS_CONFIG} has pad_token {pad!r:.40} and padding_side {side!r:.40}")
    inputs = found.get("model_input_names", ["input_ids"])
    return Tokens(pad, side, isinstance(inputs, list) and "attention_mask" in inputs)


def _weights(path: Path) -> tuple[Path, ...]:
    if (path / WEIGHTS).is_file():
        return (path / WEIGHTS,)
    if not (path / INDEX).is_file():
        pickled = "; pickles such as pytorch_model.bin are not read" if any(path.glob("*.bin")) else ""
        raise InputError(f"there is no {WEIGHTS}{pickled}")
    shards = read_json(path / INDEX).get("weight_map")
    names = sorted({*shards.values()} if isinstance(shards, Mapping) and all(map(_is_shard, shards.values())) else ())
    if not 0 < len(names) <= _MOST_SHARDS:
        raise InputError(f"weight_map of {INDEX} names no files of the form model-00001-of-00002.safetensors")
    missing = [name for name in names if not (path / name).is_file()]
    if len(missing) > 0:
        raise InputError(f"there is no {missing[0]}, which {INDEX} names")
    return tuple(path / name for name in names)


def _is_shard(name: object) -> bool:
    return isinstance(name, str) and name.endswith(".safetensors") and name == os.path.basename(name)


def patch_side(count: int) -> int:
    """Patches along the side of a square image that has `count` at most.

    >>> patch_side(256), patch_side(300)
    (16, 17)
    """
    return max(1, math.isqrt(count))
