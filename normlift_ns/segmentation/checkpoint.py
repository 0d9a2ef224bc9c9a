"""SAM checkpoints, which are model folders, files published by Meta, or hub names.

Entries of config.json that could refer to code, kernels or other weights are ignored.
"""

from __future__ import annotations

import importlib
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file
from torch import Tensor

from normlift_ns.encoders import weights
from normlift_ns.encoders.weights import CONFIG_FILE, SAM_WEIGHT_FILES, read_json
from normlift_ns.errors import InputError, json_type, summarize_error
from normlift_ns.io.atomic import file_digest
from normlift_ns.io.guard import check_regular
from normlift_ns.options import DEFAULT_SAM, DEFAULT_SAM3, SamPrecision

WEIGHTS_FILE = SAM_WEIGHT_FILES[0]
_MAX_PARTS, _MAX_SIZE, _MAX_DEPTH = 512, 2**16, 8
"""Upper bounds on the numbers of layers, labels and entries in a config, on its other numbers, and on its nesting."""
_MIN_TORCH = "2.6"
_ALTERNATIVE = "lift with the original SAM: --regions sam --sam-model sam_vit_h_4b8939.pth (a file published by Meta)"
_SAM3_ALTERNATIVE = "lift with other --regions, or query without --segment"
_SAM_CONFIGS = ("vision_config", "prompt_encoder_config", "mask_decoder_config")
_NOT_SIZES = re.compile(
    r"(?s)_|.*attn_impl|(auto_map|quantization_config|architectures|dtype|torch_dtype|transformers_version)\Z"
)
"""Pattern of the names of config entries that are ignored."""


@dataclass(frozen=True)
class SamFamily:
    """A network of the SAM family that transformers implements."""

    name: str
    prefix: str
    """Prefix of the class names of the network in transformers."""
    config_parts: tuple[str, ...]
    """Names of the sub-configs in the config of the network."""
    nested_types: tuple[tuple[str, str], ...] = ()
    """Dotted paths of sub-configs at any depth, each with its expected model type."""
    config_key: str | None = None
    """Entry of config.json that holds the config of the network, or None if the whole file is the config."""
    min_transformers: str = "4.50"
    """Minimum version of transformers for the network."""


_SAM2_NESTED = (("vision_config.backbone_config", "sam2_hiera_det_model"),)
_SAM3_CONFIGS = ("vision_config", "text_config", "geometry_encoder_config", "detr_encoder_config",
                 "detr_decoder_config", "mask_decoder_config")  # fmt: skip
_SAM3_NESTED = (("vision_config.backbone_config", "sam3_vit_model"), ("text_config", "clip_text_model"))
SAM = SamFamily("SAM", "Sam", _SAM_CONFIGS)
_SAM2 = SamFamily("SAM 2", "Sam2", _SAM_CONFIGS, _SAM2_NESTED, min_transformers="4.56")
POINT_PROMPT_FAMILIES: dict[str, SamFamily] = {
    "sam": SAM,
    "sam2": _SAM2,
    "sam2_video": _SAM2,  # model type of the checkpoints of SAM 2 and 2.1, which contain the image model
    "sam_hq": SamFamily("HQ-SAM", "SamHQ", _SAM_CONFIGS, min_transformers="4.52"),
}
"""Networks that predict masks for points, by the model type in config.json."""
_SAM3 = SamFamily("SAM 3", "Sam3", _SAM3_CONFIGS, _SAM3_NESTED, min_transformers="5.0")
TEXT_PROMPT_FAMILIES: dict[str, SamFamily] = {
    "sam3": _SAM3,
    "sam3_video": replace(_SAM3, config_key="detector_config"),
}
"""Networks that predict masks for text prompts, by the model type in config.json."""


def import_transformers() -> Any:
    """Import transformers, which takes seconds the first time.

    Raises:
        ValueError: If transformers is not installed.
    """
    try:
        return importlib.import_module("transformers")
    except ImportError as error:
        raise InputError(
            f"SAM needs the package transformers ({summarize_error(error)}); install it with: "
            'pip install "normlift-ns[sam]". Without it, lift with --regions patches or superpixel, and query without '
            "--segment"
        ) from None


def read_sam_family(folder: Path, kinds: Mapping[str, SamFamily]) -> SamFamily:
    """Return the network that the config.json of a folder describes.

    Raises:
        ValueError: If config.json is missing, is damaged, or describes none of `kinds`.
    """
    model_type = read_json(folder / CONFIG_FILE).get("model_type")
    kind = kinds.get(model_type) if isinstance(model_type, str) else None
    if kind is None:
        other = (TEXT_PROMPT_FAMILIES if kinds is POINT_PROMPT_FAMILIES else POINT_PROMPT_FAMILIES).get(str(model_type))
        prompts, regions = ("text prompts", "sam3") if kinds is POINT_PROMPT_FAMILIES else ("points", "sam")
        hint = "" if other is None else f" ({other.name} takes {prompts}; use it with --regions {regions})"
        expected = ", ".join(f"{name!r}" for name in kinds)
        raise InputError(f"config.json has the model type {model_type!r:.60}{hint}, expected one of {expected}")
    return kind


def check_versions(kind: SamFamily) -> None:
    """Raise InputError if the installed torch or transformers is too old for a network other than the original SAM."""
    if kind is not SAM:
        alternative = _SAM3_ALTERNATIVE if kind.name == "SAM 3" else _ALTERNATIVE
        weights.check_packages(kind.name, {"torch": _MIN_TORCH, "transformers": kind.min_transformers}, alternative)


def load_pretrained_sam(folder: Path, kind: SamFamily) -> Any:
    """Load the transformers model of a folder with its weights, in float32 on the CPU.

    Raises:
        ValueError: If weights are missing or have the wrong shapes, or if the config does not describe the network.
        Exception: If the libraries that read the folder find other damage.
    """
    transformers = import_transformers()
    if not (folder / WEIGHTS_FILE).is_file():
        raise InputError(f"the folder has no {WEIGHTS_FILE}")
    config = getattr(transformers, f"{kind.prefix}Config")(**_sizes(read_json(folder / CONFIG_FILE), kind))
    with _quiet(transformers):
        model, report = getattr(transformers, f"{kind.prefix}Model").from_pretrained(
            None,
            config=config,
            state_dict=load_file(folder / WEIGHTS_FILE),
            dtype=torch.float32,
            attn_implementation="sdpa",
            output_loading_info=True,
        )
    missing = sorted(map(str, [*report["missing_keys"], *report["mismatched_keys"]]))
    if len(missing) > 0:
        more = f" and {len(missing) - 1} more" if len(missing) > 1 else ""
        raise InputError(f"in {WEIGHTS_FILE}, parameters are missing or have wrong shapes: {missing[0]}{more}")
    return model.eval().requires_grad_(False)


@contextmanager
def _quiet(transformers: Any) -> Iterator[None]:
    """Disable the progress bar and the warnings of transformers in the `with` block."""
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


def _sizes(config: dict[str, Any], kind: SamFamily) -> dict[str, Any]:
    """Return the sub-configs of a network without ignored entries; raise InputError if one is missing or invalid."""
    own = config if kind.config_key is None else config.get(kind.config_key)
    parts = {name: own.get(name) for name in kind.config_parts} if isinstance(own, Mapping) else {}
    for name, part in parts.items():
        if not isinstance(part, Mapping):
            found = "missing" if part is None else json_type(part)
            raise InputError(f"{name} of config.json is {found}, expected an object")
    sizes = check_config_sizes(parts)
    for path, expected in kind.nested_types:
        part: Any = sizes
        for name in path.split("."):
            part = part.get(name) if isinstance(part, Mapping) else None
        model_type = part.get("model_type", expected) if isinstance(part, Mapping) else None
        if model_type != expected:
            raise InputError(f"{path} of config.json has the model type {model_type!r:.60}, expected {expected!r}")
    return sizes


def check_config_sizes(values: Any, name: str = CONFIG_FILE, depth: int = 0) -> Any:
    """Return a config without ignored entries; raise InputError if it is too large or a number is implausible.

    Without this check, transformers would build a network of any size.
    """
    if depth > _MAX_DEPTH or (isinstance(values, Mapping | list) and len(values) > _MAX_PARTS):
        raise InputError(f"{name} is nested too deeply, or has more than {_MAX_PARTS} entries")
    if isinstance(values, Mapping):
        checked = {key: check_config_sizes(value, str(key), depth + 1) for key, value in values.items()}
        return {key: value for key, value in checked.items() if not _NOT_SIZES.match(key)}
    if isinstance(values, list):
        return [check_config_sizes(value, name, depth + 1) for value in values]
    if isinstance(values, int | float):
        limit = _MAX_PARTS if name.startswith("num_") or name.endswith("depth") else _MAX_SIZE
        if not -1 <= values <= limit:
            raise InputError(f"{name} of config.json is {values!r:.40}, expected a number from -1 to {limit:,}")
    return values


# SAM checkpoints: folders in the format of transformers, files published by Meta, or hub names.


_REMEDIES = {
    "SAM": f"set --sam-model to a name such as {DEFAULT_SAM}, to a folder with config.json and model.safetensors, or "
    "to a file such as sam_vit_h_4b8939.pth. To lift without SAM, use --regions patches or --regions superpixel",
    "SAM 3": f"set --sam-model (lift) or --segment-model (query) to a name such as {DEFAULT_SAM3}, or to a "
    "folder with config.json, model.safetensors and a tokenizer. Without SAM 3, lift with other --regions, or query "
    "without --segment",
}
"""Advice in messages about an unusable checkpoint, by the name of the network."""
_FIRST = "the original SAM (ViT-B, ViT-L or ViT-H)"
_AS_FOLDER = "; SAM 2 and HQ-SAM need a folder in the format of transformers"
_OTHERS = {
    "image_encoder.trunk.": "SAM 2",
    "image_encoder.layers.": "MobileSAM",
    "mask_decoder.hf_token": "HQ-SAM",
    "mask_decoder.compress_vit_feat": "HQ-SAM",
}
"""Names of networks other than the original SAM, by prefixes of their parameter names."""
_MLP = {"0": "proj_in", "1": "layers.0", "2": "proj_out"}
_SHARED = ("shared_image_embedding.positional_embedding", "prompt_encoder.shared_embedding.positional_embedding")
_NAMES = {
    r"^image_encoder\.": "vision_encoder.",
    r"\.patch_embed\.proj\.": ".patch_embed.projection.",
    r"\.blocks\.(\d+)\.norm(\d)\.": r".layers.\1.layer_norm\2.",
    r"\.blocks\.": ".layers.",
    r"\.neck\.0\.": ".neck.conv1.",
    r"\.neck\.1\.": ".neck.layer_norm1.",
    r"\.neck\.2\.": ".neck.conv2.",
    r"\.neck\.3\.": ".neck.layer_norm2.",
    r"\.pe_layer\.positional_encoding_gaussian_matrix$": ".shared_embedding.positional_embedding",
    r"\.point_embeddings\.": ".point_embed.",
    r"\.mask_downscaling\.0\.": ".mask_embed.conv1.",
    r"\.mask_downscaling\.1\.": ".mask_embed.layer_norm1.",
    r"\.mask_downscaling\.3\.": ".mask_embed.conv2.",
    r"\.mask_downscaling\.4\.": ".mask_embed.layer_norm2.",
    r"\.mask_downscaling\.6\.": ".mask_embed.conv3.",
    r"\.norm_final_attn\.": ".layer_norm_final_attn.",
    r"\.layers\.(\d+)\.norm(\d)\.": r".layers.\1.layer_norm\2.",
    r"\.output_upscaling\.0\.": ".upscale_conv1.",
    r"\.output_upscaling\.1\.": ".upscale_layer_norm.",
    r"\.output_upscaling\.3\.": ".upscale_conv2.",
}
"""Patterns in Meta's parameter names, each with its replacement in transformers."""


def check_sam_checkpoint(checkpoint: str, kinds: Mapping[str, SamFamily] = POINT_PROMPT_FAMILIES) -> None:
    """Check the name of a checkpoint and its local config.json, if any, without downloading or loading weights.

    Raises:
        ValueError: If transformers is not installed, or if torch or transformers is too old for the network.
        ValueError: If the checkpoint is neither a path nor a hub name (OWNER/NAME), its config.json is damaged, or it
            belongs to another network.
        FileNotFoundError: If the checkpoint looks like a path but does not exist.
    """
    import_transformers()
    title = _title(kinds)
    path, remedy = Path(checkpoint), _REMEDIES[title]
    if not (os.path.isfile(path) or os.path.isdir(path)):
        weights.check_not_local(checkpoint, 2, f"{title} checkpoint", "neither a file nor a folder", remedy)
    elif (folder := transformers_folder(path)) is not None:
        with checkpoint_errors(path, title):
            kind = read_sam_family(folder, kinds)
        check_versions(kind)


def _title(kinds: Mapping[str, SamFamily]) -> str:
    """Return the name that messages use for the networks `kinds`."""
    return "SAM" if kinds is POINT_PROMPT_FAMILIES else "SAM 3"


def sam_identity(checkpoint: str) -> str:
    """Return the digest of the files of a local checkpoint, or the name of a hub checkpoint."""
    path = Path(checkpoint)
    if not os.path.exists(path):
        return checkpoint
    return file_digest(*(file for file in (path, path / "config.json", *_weight_files(path)) if file.is_file()))


def load_sam_checkpoint(checkpoint: str) -> tuple[SamFamily, Any]:
    """Load a checkpoint; return its family, and its transformers model in float32 on the CPU.

    Raises:
        FileNotFoundError: If the checkpoint is not on this machine and cannot be downloaded.
        ValueError: If the checkpoint is damaged, its network does not accept points, or torch or transformers is
            missing or too old.
    """
    path = locate_sam(checkpoint, POINT_PROMPT_FAMILIES)
    folder = transformers_folder(path)
    with checkpoint_errors(path):
        kind = SAM if folder is None else read_sam_family(folder, POINT_PROMPT_FAMILIES)
    check_versions(kind)
    with checkpoint_errors(path):
        return kind, _load_first_sam(path) if folder is None or kind is SAM else load_pretrained_sam(folder, kind)


def resolve_precision(precision: SamPrecision, device: str) -> SamPrecision:
    """Return the precision of a network on a device, with "auto" replaced by the default of the device."""
    default: SamPrecision = "float16" if torch.device(device).type == "cuda" else "float32"
    return default if precision == "auto" else precision


def transformers_folder(path: Path) -> Path | None:
    """Return the folder of a checkpoint in the format of transformers, or None for a file published by Meta."""
    if path.is_dir():
        return path
    return path.parent if path.suffix == ".safetensors" and (path.parent / "config.json").is_file() else None


def checkpoint_errors(path: Path, title: str = "SAM") -> AbstractContextManager[None]:
    """Convert errors of other libraries to an InputError with the path of the checkpoint."""
    return weights.third_party_errors(f"{title} checkpoint {path} cannot be loaded", _REMEDIES[title])


def _load_first_sam(path: Path) -> Any:
    config, state = _read_folder(path) if path.is_dir() else _read_file(path)
    for name, other in (_SHARED, _SHARED[::-1]):  # two names of the same tensor; a file may have only one
        if other in state:
            state.setdefault(name, state[other])
    with torch.device("meta"):
        model = import_transformers().SamModel(config)
    model.load_state_dict({name: value.float() for name, value in state.items()}, assign=True)
    return model.eval().requires_grad_(False)


def locate_sam(checkpoint: str, kinds: Mapping[str, SamFamily], more: Sequence[str] = ()) -> Path:
    """Return the path of a checkpoint, and download it from the hub if necessary.

    The download starts with config.json, and continues only if this file describes one of `kinds`.

    Args:
        checkpoint: Path or hub name.
        kinds: Accepted networks, by the model type in config.json.
        more: Patterns of additional files to download.
    Raises:
        FileNotFoundError: If the checkpoint cannot be downloaded.
    """
    local = weights.find_local_sam(checkpoint)
    if local is not None:
        return local
    title, files = _title(kinds), [WEIGHTS_FILE, *more]
    problem = f"{title} checkpoint {checkpoint} is not in the local cache and cannot be downloaded"
    access = " and log in to the hub with an account that accepted the license of SAM 3" if title == "SAM 3" else ""
    other = re.sub(rf"a name such as {re.escape(checkpoint)}, (or )?to ", "", _REMEDIES[title])
    with weights.third_party_errors(problem, f"{weights.CONNECT_ONCE}{access}. Otherwise, {other}", FileNotFoundError):
        return weights.download_model(checkpoint, lambda config: files if config.get("model_type") in kinds else [])


def _read_folder(folder: Path) -> tuple[Any, dict[str, Tensor]]:
    if read_sam_family(folder, POINT_PROMPT_FAMILIES) is not SAM:
        raise InputError(f"config.json in its folder does not describe {_FIRST}{_AS_FOLDER}")
    files = _weight_files(folder)
    if len(files) == 0:
        raise InputError(f"the folder has no {WEIGHTS_FILE}")
    config = check_config_sizes(read_json(folder / CONFIG_FILE))
    return import_transformers().SamConfig.from_dict(config), _read_tensors(files[0])


def _weight_files(folder: Path) -> list[Path]:
    """Return a list with the weight file of a folder, or an empty list if there is none."""
    return [folder / name for name in SAM_WEIGHT_FILES if (folder / name).is_file()][:1]


def _read_file(path: Path) -> tuple[Any, dict[str, Tensor]]:
    state = _read_tensors(path)
    for name in [*state, *(state["model"] if isinstance(state.get("model"), Mapping) else [])]:
        for part, kind in _OTHERS.items():
            if str(name).startswith(part):
                raise InputError(f"its parameter {name} belongs to {kind}, expected {_FIRST}{_AS_FOLDER}")
    if "image_encoder.pos_embed" not in state:
        if (path.parent / "config.json").is_file():
            return _read_folder(path.parent)
        raise InputError(f"it lacks image_encoder.pos_embed, expected a file published by Meta for {_FIRST}")
    return config_from_weights(state), {transformers_name(name): value for name, value in state.items()}


def _read_tensors(path: Path) -> dict[str, Tensor]:
    check_regular(path)
    if path.suffix == ".safetensors":
        return load_file(path)
    return torch.load(path, map_location="cpu", weights_only=True)


def transformers_name(name: str) -> str:
    """Convert the name of a parameter in Meta's files to its name in transformers.

    >>> transformers_name("mask_decoder.iou_prediction_head.layers.2.weight")
    'mask_decoder.iou_prediction_head.proj_out.weight'
    """
    for pattern, replacement in _NAMES.items():
        name = re.sub(pattern, replacement, name)
    mlp = re.match(r"(.*(?:hypernetworks_mlps\.\d+|prediction_head))\.layers\.(\d)\.(.*)", name)
    return name if mlp is None else f"{mlp[1]}.{_MLP[mlp[2]]}.{mlp[3]}"


def config_from_weights(state: Mapping[str, Tensor]) -> Any:
    """Return the SamConfig of transformers for a file published by Meta, derived from the shapes of its parameters.

    The shapes determine neither the number of heads (eight) of the mask decoder nor the epsilon of its layer norms
    (1e-5). These values are the same in all of Meta's files.
    """
    shape = {name: tuple(value.shape) for name, value in state.items()}
    _, grid, _, width = shape["image_encoder.pos_embed"]
    patch = shape["image_encoder.patch_embed.proj.weight"][-1]
    blocks = sum(name.endswith(".attn.rel_pos_h") for name in shape)
    extent, head = zip(*(shape[f"image_encoder.blocks.{i}.attn.rel_pos_h"] for i in range(blocks)))
    channels = shape["image_encoder.neck.0.weight"][0]
    layer = "mask_decoder.transformer.layers.0"
    transformers = import_transformers()
    vision = transformers.SamVisionConfig(
        hidden_size=width,
        output_channels=channels,
        num_hidden_layers=blocks,
        num_attention_heads=width // head[0],
        image_size=grid * patch,
        patch_size=patch,
        window_size=(min(extent) + 1) // 2,
        global_attn_indexes=[i for i in range(blocks) if extent[i] == 2 * grid - 1],
        num_pos_feats=channels // 2,
        mlp_dim=shape["image_encoder.blocks.0.mlp.lin1.weight"][0],
    )
    prompt = transformers.SamPromptEncoderConfig(
        hidden_size=channels,
        image_size=grid * patch,
        patch_size=patch,
        mask_input_channels=shape["prompt_encoder.mask_downscaling.3.weight"][0],
    )
    decoder = transformers.SamMaskDecoderConfig(
        hidden_size=channels,
        mlp_dim=shape[f"{layer}.mlp.lin1.weight"][0],
        num_hidden_layers=sum(name.endswith("self_attn.q_proj.weight") for name in shape),
        attention_downsample_rate=channels // shape[f"{layer}.cross_attn_token_to_image.q_proj.weight"][0],
        iou_head_hidden_dim=shape["mask_decoder.iou_prediction_head.layers.0.weight"][0],
        layer_norm_eps=1e-5,
    )
    return transformers.SamConfig(vision_config=vision, prompt_encoder_config=prompt, mask_decoder_config=decoder)
