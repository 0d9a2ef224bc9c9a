"""Families, folders and hub names of Hugging Face networks. This module does not import torch."""

from __future__ import annotations

import os
import re
import string
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from normlift_ns.encoders import weights
from normlift_ns.encoders.weights import CONFIG_FILE, read_json
from normlift_ns.errors import InputError, json_type, truncate_text
from normlift_ns.options import DEFAULT_MODEL, DEFAULT_PRETRAINED, SourceOptions

_PUNCTUATION = str.maketrans("", "", string.punctuation)


def _canonicalize(text: str) -> str:
    """Convert a text to lower case without punctuation, like `SiglipTokenizer.canonicalize_text` of transformers.

    >>> _canonicalize("A red mug,  on the table!")
    'a red mug on the table'
    """
    return re.sub(r"\s+", " ", text.lower().translate(_PUNCTUATION)).strip()


@dataclass(frozen=True)
class ModelFamily:
    """A family of networks with the same training and preprocessing."""

    name: str
    """Value of `--encoder` that selects the family."""
    title: str
    """Name of the family in messages."""
    model_types: tuple[str, ...]
    """Accepted values of "model_type" in config.json. Fixed-resolution SigLIP 2 models have the architecture of SigLIP,
    and therefore its model type."""
    default_model: str
    """Hub name of the default model."""
    preprocess_text: Callable[[str], str]
    """Function that prepares a text for the tokenizer."""
    pad_token: str
    """Padding token for folders whose tokenizer configuration does not set one."""
    tokenizer_names: tuple[str, ...]
    """Substrings of the class names of the tokenizers."""
    mean: tuple[float, float, float] = (0.5, 0.5, 0.5)
    """Channel means of pixel values in 0..1, for folders whose configuration does not set them."""
    std: tuple[float, float, float] = (0.5, 0.5, 0.5)
    """Channel standard deviations of pixel values in 0..1, for folders whose configuration does not set them."""


MODEL_FAMILIES = {
    family.name: family
    for family in (
        ModelFamily(
            "siglip", "SigLIP", ("siglip",), "google/siglip-base-patch16-224", _canonicalize, "</s>", ("Siglip", "T5")
        ),
        ModelFamily(
            "siglip2",
            "SigLIP 2",
            ("siglip", "siglip2"),
            "google/siglip2-base-patch16-224",
            str.lower,  # as in training; not all published tokenizers convert to lower case
            "<pad>",
            ("Siglip2", "Gemma"),
        ),
        ModelFamily(
            "metaclip2",
            "MetaCLIP 2",
            ("metaclip_2",),
            "facebook/metaclip-2-worldwide-huge-quickgelu",
            str,  # texts stay unchanged
            "<pad>",
            ("XLMRoberta",),
            (0.48145466, 0.4578275, 0.40821073),
            (0.26862954, 0.26130258, 0.27577711),
        ),
    )
}
"""Families by `--encoder` name."""


def family_of_tokenizer(name: str) -> ModelFamily | None:
    """Return the family that the name of a tokenizer class identifies, or None if no family matches.

    >>> family_of_tokenizer("GemmaTokenizerFast").title, family_of_tokenizer("SiglipTokenizer").title
    ('SigLIP 2', 'SigLIP')
    """
    for family in (MODEL_FAMILIES["siglip2"], MODEL_FAMILIES["siglip"], MODEL_FAMILIES["metaclip2"]):
        if any(part in name for part in family.tokenizer_names):
            return family
    return None


# Model folders of transformers: config.json, safetensors weights, tokenizer.json and image preprocessing.
#
# Files are not trusted until they are checked. Configurations can refer to code, downloadable kernels and quantized
# formats. This module therefore uses only their network sizes, and limits each of them. It does not import torch.


WEIGHTS_FILE, WEIGHTS_INDEX_FILE, TOKENIZER_FILE = "model.safetensors", "model.safetensors.index.json", "tokenizer.json"
_TOKENIZER_CONFIG, _SPECIAL_TOKENS = "tokenizer_config.json", "special_tokens_map.json"
_PREPROCESSING_FILES = ("preprocessor_config.json", "processor_config.json")
"""Files with preprocessing settings. The second file has the content of the first under "image_processor"."""
METADATA_FILES = (
    CONFIG_FILE,
    WEIGHTS_INDEX_FILE,
    TOKENIZER_FILE,
    _TOKENIZER_CONFIG,
    _SPECIAL_TOKENS,
    *_PREPROCESSING_FILES,
)
_MAX_SHARDS = 256
_MAX_SIZES = {
    "vocab_size": 2**21, "hidden_size": 2**14, "intermediate_size": 2**17, "num_hidden_layers": 256,
    "num_attention_heads": 256, "max_position_embeddings": 2**12, "projection_size": 2**14, "projection_dim": 2**14,
    "image_size": 2**12, "patch_size": 2**8, "num_patches": 2**16, "eos_token_id": 2**21, "num_channels": 3,
}  # fmt: skip
"""Integer configuration entries that this module reads, with their largest accepted values."""
_ACTIVATIONS = ("gelu", "gelu_fast", "gelu_new", "gelu_pytorch_tanh", "quick_gelu", "relu", "silu")


@dataclass(frozen=True)
class PixelNormalization:
    """Image preprocessing of a network, which maps pixel values x in 0..255 to (rescale_factor x - mean) / std."""

    rescale_factor: float
    mean: tuple[float, ...]
    std: tuple[float, ...]
    image_size: int | None
    """Side of square input images in pixels, or None if it is unknown or images are not square."""
    max_patches: int | None
    """Largest number of patches per image if images keep their aspect ratio, else None."""


@dataclass(frozen=True)
class TokenPadding:
    """Padding of tokenized texts."""

    pad_token: str
    """Padding token."""
    padding_side: str
    """Side of the padding, "left" or "right"."""
    attention_mask: bool
    """True if an attention mask hides padding from the network; SigLIP was trained without one."""


@dataclass(frozen=True)
class ModelFolder:
    """Checked contents of a model folder."""

    path: Path
    model_type: str
    text: dict[str, Any]
    vision: dict[str, Any]
    sizes: dict[str, Any]
    """Dimension of the joint embedding space, if config.json sets it. `text`, `vision` and `sizes` have the same
    keys as the configurations of transformers."""
    pixels: PixelNormalization
    tokens: TokenPadding
    weights: tuple[Path, ...]
    """Weight files in the safetensors format."""

    @property
    def files(self) -> tuple[Path, ...]:
        """All files that affect the embeddings, in a fixed order."""
        small = (self.path / name for name in METADATA_FILES)
        return (*(file for file in small if file.is_file()), *self.weights)


def read_model_folder(path: Path, family: ModelFamily) -> ModelFolder:
    """Read and check a model folder, except for its weights and vocabulary.

    Raises:
        InputError: If the folder is incomplete, damaged or of a different architecture.
    """
    remedy = f"lift with --encoder-model set to a folder of a {family.title} network or to a name such as "
    remedy += f"{family.default_model}, or with --encoder open_clip"
    try:
        return _read(path, family)
    except InputError as error:
        raise InputError(f"{path}: {error}; {remedy}") from None


def _read(path: Path, family: ModelFamily) -> ModelFolder:
    """Read a model folder; raise InputError, without its path in the message, if it cannot be used."""
    config = read_json(path / CONFIG_FILE)
    kind = config.get("model_type")
    if kind not in family.model_types:
        raise InputError(_other_architecture(CONFIG_FILE, config, family))
    text, vision = (_sizes(config.get(f"{part}_config"), f"{part}_config") for part in ("text", "vision"))
    whole = {key: value for key, value in _sizes(config, CONFIG_FILE).items() if key == "projection_dim"}
    if vision.pop("vision_use_head", True) is not True:
        raise InputError(
            f"according to {CONFIG_FILE}, the network has no pooling head and cannot compare images with texts"
        )
    tokens = _tokens(path, family)
    return ModelFolder(path, kind, text, vision, whole, _pixels(path, family, kind), tokens, _weights(path))


def _other_architecture(origin: str, config: Mapping[str, Any], family: ModelFamily) -> str:
    """Return the error message for a network of another family."""
    expected = " or ".join(map(repr, family.model_types))
    kind = config.get("model_type")
    return f"{origin} has the model type {kind!r:.60}, expected a {family.title} network ({expected})"


def _sizes(values: object, where: str) -> dict[str, Any]:
    """Return the sizes and other settings of a network from a configuration; raise InputError if one is invalid."""
    if values is None:
        return {}
    if not isinstance(values, Mapping):
        raise InputError(f"{where} of {CONFIG_FILE} is {json_type(values)}, expected an object")
    sizes: dict[str, Any] = {}
    for key, maximum in _MAX_SIZES.items():
        value = values.get(key)
        if value is None:
            continue
        minimum = 0 if key.endswith("_id") else 1
        if type(value) is not int or not minimum <= value <= maximum:
            raise InputError(f"{key} of {where} is {value!r:.40}, expected an integer in {minimum}..{maximum:,}")
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
    """Return a value as a float; raise InputError unless it is a number in minimum..maximum."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not minimum <= value <= maximum:
        raise InputError(f"{name} is {value!r:.40}, expected a number in {minimum:g}..{maximum:g}")
    return float(value)


def _pixels(path: Path, family: ModelFamily, kind: str) -> PixelNormalization:
    """Read the pixel normalization of a model folder; raise InputError if it is missing or invalid."""
    names = [name for name in _PREPROCESSING_FILES if (path / name).is_file()]
    if len(names) == 0:
        raise InputError(f"{_PREPROCESSING_FILES[0]}, which describes image preprocessing, is missing")
    file = names[0]
    settings = read_json(path / file)
    settings = settings.get("image_processor", settings)
    if not isinstance(settings, Mapping):
        raise InputError(f"image_processor of {file} is {json_type(settings)}, expected an object")
    factor = _number(settings.get("rescale_factor", 1 / 255), f"rescale_factor of {file}", 1e-6, 1e3)
    factor = factor if settings.get("do_rescale", True) is not False else 1.0
    mean, std = (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)
    if settings.get("do_normalize", True) is not False:
        mean = _channels(settings, "image_mean", family.mean, -1e3, file)
        std = _channels(settings, "image_std", family.std, 1e-6, file)
    if kind != "siglip2":
        return PixelNormalization(factor, mean, std, _side(settings), None)
    patches, most = settings.get("max_num_patches", 256), _MAX_SIZES["num_patches"]
    if type(patches) is not int or not 1 <= patches <= most:
        raise InputError(f"max_num_patches of {file} is {patches!r:.40}, expected an integer in 1..{most:,}")
    return PixelNormalization(factor, mean, std, None, patches)


def _channels(
    settings: Mapping[str, Any], key: str, default: tuple[float, ...], minimum: float, file: str
) -> tuple[float, ...]:
    """Return a preprocessing setting with one number per color channel; raise InputError if it is invalid."""
    values = settings.get(key, list(default))
    if not isinstance(values, list) or len(values) != 3:
        raise InputError(f"{key} of {file} is {values!r:.40}, expected three numbers")
    return tuple(_number(value, f"{key} of {file}", minimum, 1e3) for value in values)


def _side(settings: Mapping[str, Any]) -> int | None:
    """Return the side of square input images in pixels, or None if it is unknown or images are not square."""
    cropped = settings.get("do_center_crop", "crop_size" in settings) is True
    size = settings.get("crop_size" if cropped else "size")
    if isinstance(size, Mapping):
        size = size.get("height", size.get("shortest_edge")) if size.get("height") == size.get("width") else None
    return size if type(size) is int else None


def _tokens(path: Path, family: ModelFamily) -> TokenPadding:
    """Read the padding of texts; raise InputError if it is invalid, or the tokenizer is missing or unsuitable."""
    if not (path / TOKENIZER_FILE).is_file():
        older = "; spiece.model, an older format, is not supported" if (path / "spiece.model").is_file() else ""
        raise InputError(f"{TOKENIZER_FILE}, which encodes texts, is missing{older}")
    files = [path / name for name in (_SPECIAL_TOKENS, _TOKENIZER_CONFIG) if (path / name).is_file()]
    settings = {key: value for file in files for key, value in read_json(file).items()}
    name = settings.get("tokenizer_class")
    owner = family_of_tokenizer(name) if isinstance(name, str) else None
    if owner is not None and owner != family:
        raise InputError(
            f"its tokenizer {truncate_text(str(name))} belongs to {owner.title} (--encoder {owner.name}), not to "
            f"{family.title}"
        )
    pad = settings.get("pad_token") or family.pad_token
    pad = pad.get("content") if isinstance(pad, Mapping) else pad
    side = settings.get("padding_side", "right")
    if not isinstance(pad, str):
        raise InputError(f"the pad_token of the tokenizer is {pad!r:.40}, expected a string")
    if side not in ("left", "right"):
        raise InputError(f"the padding_side of the tokenizer is {side!r:.40}, expected left or right")
    inputs = settings.get("model_input_names", ["input_ids"])
    return TokenPadding(pad, side, isinstance(inputs, list) and "attention_mask" in inputs)


def _weights(path: Path) -> tuple[Path, ...]:
    """Return the weight file or the listed shards; raise InputError if a file is missing or the index is invalid."""
    if (path / WEIGHTS_FILE).is_file():
        return (path / WEIGHTS_FILE,)
    if not (path / WEIGHTS_INDEX_FILE).is_file():
        pickled = "; pickle files such as pytorch_model.bin are not supported" if any(path.glob("*.bin")) else ""
        raise InputError(f"{WEIGHTS_FILE} is missing{pickled}")
    shards = read_json(path / WEIGHTS_INDEX_FILE).get("weight_map")
    names = sorted({*shards.values()} if isinstance(shards, Mapping) and all(map(_is_shard, shards.values())) else ())
    if not 0 < len(names) <= _MAX_SHARDS:
        raise InputError(
            f"weight_map of {WEIGHTS_INDEX_FILE} is invalid, expected file names like model-00001-of-00002.safetensors"
        )
    missing = [name for name in names if not (path / name).is_file()]
    if len(missing) > 0:
        raise InputError(f"{missing[0]}, which {WEIGHTS_INDEX_FILE} lists, is missing")
    return tuple(path / name for name in names)


def _is_shard(name: object) -> bool:
    """Return True if a value is the name of a safetensors file, without a folder."""
    return isinstance(name, str) and name.endswith(".safetensors") and name == os.path.basename(name)


# Location of networks: local folders, the Hugging Face hub cache, and downloads.


_MIN_VERSIONS = {"torch": "2.6", "transformers": "4.56"}


def resolve_model_name(options: SourceOptions, family: ModelFamily) -> str:
    """Return the hub name or folder of the selected network.

    The default of `--encoder-model` is an OpenCLIP model, so it selects the default network of the family instead.
    """
    return family.default_model if options.encoder_model == DEFAULT_MODEL else options.encoder_model


def check_transformers_version(family: ModelFamily) -> None:
    """Raise InputError if torch or transformers is missing or too old."""
    weights.check_packages(f"--encoder {family.name}", _MIN_VERSIONS, "lift with --encoder open_clip")


def check_huggingface_options(options: SourceOptions, family: ModelFamily) -> None:
    """Check the options as far as possible without torch.

    Raises:
        InputError: If packages are missing or too old, or an option applies only to another encoder.
        InputError: If the name is not a hub name, or the folder is incomplete, damaged or of a different architecture.
        FileNotFoundError: If the folder does not exist, or the network is not on this machine and the hub cannot be
            reached.
    """
    check_transformers_version(family)
    if options.encoder_pretrained != DEFAULT_PRETRAINED:
        raise InputError(
            f"--encoder-pretrained {options.encoder_pretrained} applies only to --encoder open_clip; remove it. To "
            f"choose a {family.title} network, give its folder or hub name with --encoder-model"
        )
    model = resolve_model_name(options, family)
    check_model_name(model, family)
    folder = find_local_model(model)
    if folder is not None:
        read_model_folder(folder, family)
        return
    with _download_errors(model, family):
        weights.check_hub_access()


def check_model_name(model: str, family: ModelFamily) -> None:
    """Check that a name is a folder or can be a hub name.

    Raises:
        InputError, FileNotFoundError: If it is neither.
    """
    example = (
        f"give a folder with {CONFIG_FILE}, {WEIGHTS_FILE}, {TOKENIZER_FILE} and {_PREPROCESSING_FILES[0]}, or a name "
        f"such as {family.default_model}"
    )
    if not os.path.isdir(model):
        weights.check_not_local(model, 2, "--encoder-model", "not a folder", example)


def find_local_model(model: str) -> Path | None:
    """Return `model` if it is a folder, or else the network's folder in the hub cache, or None if it is not cached."""
    files = (WEIGHTS_FILE, WEIGHTS_INDEX_FILE)
    return Path(model).resolve() if os.path.isdir(model) else weights.find_cached_model(model, files)


def fetch_model(model: str, family: ModelFamily) -> Path:
    """Return the folder of a network, and download its JSON and safetensors files if necessary.

    Raises:
        FileNotFoundError: If the network is not on this machine and cannot be downloaded.
        InputError: If config.json of the network to download is damaged or has a different architecture.
    """
    local = find_local_model(model)
    if local is not None:
        return local

    def choose_files(config: Mapping[str, Any]) -> Sequence[str]:
        if config.get("model_type") not in family.model_types:
            remedy = f"set --encoder-model to a name such as {family.default_model}"
            raise InputError(f"{_other_architecture(model, config, family)}; {remedy}")
        return [*METADATA_FILES, WEIGHTS_FILE, "model-*.safetensors"]

    with _download_errors(model, family):
        return weights.download_model(model, choose_files)


def _download_errors(model: str, family: ModelFamily) -> AbstractContextManager[None]:
    return weights.third_party_errors(
        f"the {family.title} network {model} is not on this machine and cannot be downloaded",
        f"{weights.CONNECT_ONCE}, or lift with --encoder-model FOLDER, --encoder imagenet (weights from the Python "
        "package index) or --encoder color (no weights)",
        FileNotFoundError,
    )
