"""SAM checkpoints: a folder in the format of transformers, a file published by Meta, or a name on the hub."""

from __future__ import annotations

import importlib
import json
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file
from torch import Tensor

from normlift_ns.core.disk.digests import file_digest
from normlift_ns.encoders.sam.folders import (
    MASK_KINDS,
    SAM,
    WEIGHTS,
    Kind,
    check_sizes,
    import_transformers,
    kind_of,
    load_folder,
)
from normlift_ns.encoders.weights import first_line, probe
from normlift_ns.errors import InputError
from normlift_ns.options import DEFAULT_SAM, DEFAULT_SAM3

REMEDY = (
    f"give --sam-model a name such as {DEFAULT_SAM}, a folder with config.json and model.safetensors, or a file such "
    "as sam_vit_h_4b8939.pth; or segment without SAM: --regions patches or --regions superpixel"
)
REMEDY_SAM3 = (
    f"give a name such as {DEFAULT_SAM3}, or a folder with config.json, model.safetensors and a tokenizer, to "
    "--sam-model in a lift or to --segment-model in a query; or choose other --regions and omit --segment"
)
_REMEDIES = {"SAM": REMEDY, "SAM 3": REMEDY_SAM3}
_FILES = (WEIGHTS, "pytorch_model.bin")
_FIRST = "the first SAM, ViT-B, -L or -H"
_AS_FOLDER = "; SAM 2 and HQ-SAM need a folder in the format of transformers"
_OTHERS = {
    "image_encoder.trunk.": "SAM 2",
    "image_encoder.layers.": "MobileSAM",
    "mask_decoder.hf_token": "HQ-SAM",
    "mask_decoder.compress_vit_feat": "HQ-SAM",
}
"""Prefixes of parameter names in other networks."""
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
"""Patterns of Meta's parameter names, with the names in transformers."""


def check_sam(checkpoint: str, kinds: Mapping[str, Kind] = MASK_KINDS) -> None:
    """Check a checkpoint by name, without loading or downloading anything.

    Raises:
        ValueError: If transformers is not installed, or the checkpoint is neither a path nor a name of the form
            OWNER/NAME. Also if its folder is of another network, or the installed torch cannot run it.
        FileNotFoundError: If the checkpoint looks like a path but does not exist.
    """
    import_transformers()
    title, example = _title(kinds), DEFAULT_SAM if kinds is MASK_KINDS else DEFAULT_SAM3
    remedy = _REMEDIES[title]
    path = Path(checkpoint)
    if os.path.isfile(path) or os.path.isdir(path):
        folder = folder_of(path)
        if folder is not None and not (folder / "config.json").is_file():
            raise InputError(f"{title} checkpoint {path} is a folder without config.json; {remedy}")
        if folder is not None:
            with told_of(path, title):
                kind_of(folder, kinds)
        return
    if os.path.lexists(path):
        raise InputError(f"{title} checkpoint {checkpoint} is neither a file nor a folder; {remedy}")
    if path.is_absolute() or len(path.parts) > 2 or path.suffix in (".pth", ".pt", ".bin", ".safetensors"):
        raise FileNotFoundError(f"{title} checkpoint {checkpoint} does not exist; check the path, or {remedy}")
    if len(path.parts) != 2:
        raise InputError(
            f"{title} checkpoint {checkpoint!r} is neither a path nor a name on the hub such as {example}; {remedy}"
        )


def _title(kinds: Mapping[str, Kind]) -> str:
    """Return the name of the networks in messages."""
    return "SAM" if kinds is MASK_KINDS else "SAM 3"


def local_sam(checkpoint: str) -> Path | None:
    """Return the path of a checkpoint on this machine, including the cache of the hub; None if there is none."""
    if os.path.exists(checkpoint):
        return Path(checkpoint).resolve()
    hub = importlib.import_module("huggingface_hub")
    for file in _FILES:
        config, weights = (hub.try_to_load_from_cache(checkpoint, name) for name in ("config.json", file))
        if isinstance(config, str) and isinstance(weights, str):
            return Path(weights).parent
    return None


def sam_identity(checkpoint: str) -> str:
    """Return the digest of local files, or the name of a checkpoint on the hub."""
    path = Path(checkpoint)
    if not os.path.exists(path):
        return checkpoint
    return file_digest(*(file for file in (path, path / "config.json", *_weight_files(path)) if file.is_file()))


def load_model(checkpoint: str) -> tuple[Kind, Any]:
    """Return the network of a checkpoint, and its transformers model with weights, in float32 on the CPU.

    Raises:
        FileNotFoundError: If the checkpoint is not on this machine and cannot be downloaded.
        ValueError: If the checkpoint is damaged, its network does not take points, or the installed torch cannot run
            it.
    """
    path = local_sam(checkpoint) or download(checkpoint, MASK_KINDS)
    folder = folder_of(path)
    if folder is None:
        return SAM, load_sam(str(path))
    with told_of(path):
        kind = kind_of(folder, MASK_KINDS)
        if kind is not SAM:
            return kind, load_folder(folder, kind)
    return kind, load_sam(str(path))


def folder_of(path: Path) -> Path | None:
    """Return the folder of a checkpoint in the format of transformers; None for a file published by Meta."""
    if path.is_dir():
        return path
    return path.parent if path.suffix == ".safetensors" and (path.parent / "config.json").is_file() else None


@contextmanager
def told_of(path: Path, title: str = "SAM") -> Iterator[None]:
    """Turn errors of other libraries into an InputError that names the checkpoint."""
    try:
        yield
    except MemoryError:
        raise
    except Exception as error:  # the configs of transformers raise their own exception types for invalid values
        reason = str(error) if isinstance(error, InputError) else first_line(error)
        raise InputError(
            f"{title} checkpoint {path} is damaged or not a checkpoint of {title} ({reason}); {_REMEDIES[title]}"
        ) from None


def load_sam(checkpoint: str) -> Any:
    """Return the SamModel of transformers with the weights of a checkpoint of the first SAM, in float32 on the CPU.

    Raises:
        FileNotFoundError: If the checkpoint is not on this machine and cannot be downloaded.
        ValueError: If the checkpoint is damaged or not of the first SAM.
    """
    path = local_sam(checkpoint) or download(checkpoint, MASK_KINDS)
    with told_of(path):
        config, state = _read_folder(path) if path.is_dir() else _read_file(path)
        for name, other in (_SHARED, _SHARED[::-1]):  # the same tensor; a file may hold only one copy
            if other in state:
                state.setdefault(name, state[other])
        with torch.device("meta"):
            model = import_transformers().SamModel(config)
        model.load_state_dict({name: value.float() for name, value in state.items()}, assign=True)
    return model.eval().requires_grad_(False)


def download(checkpoint: str, kinds: Mapping[str, Kind], more: Sequence[str] = ()) -> Path:
    """Download a checkpoint from the hub: config.json first, the weights only if it names one of `kinds`.

    Args:
        checkpoint: Name on the hub.
        kinds: Networks by the model type of config.json.
        more: Patterns of further files.

    Returns:
        The folder of the checkpoint.

    Raises:
        FileNotFoundError: If the checkpoint cannot be downloaded.
    """
    hub = importlib.import_module("huggingface_hub")
    try:
        probe(hub.constants.ENDPOINT)
        folder = Path(hub.snapshot_download(checkpoint, allow_patterns=["config.json"]))
        known = json.loads((folder / "config.json").read_text("utf8")).get("model_type") in kinds
        patterns = ["config.json", WEIGHTS, *more] if known else ["config.json"]
        return Path(hub.snapshot_download(checkpoint, allow_patterns=patterns))
    except Exception as error:  # the download client raises unrelated exception types
        title = _title(kinds)
        raise FileNotFoundError(
            f"{title} checkpoint {checkpoint} is not in the local cache and cannot be downloaded "
            f"({first_line(error)}); go online once, or {_REMEDIES[title]}"
        ) from None


def _read_folder(folder: Path) -> tuple[Any, dict[str, Tensor]]:
    if kind_of(folder, MASK_KINDS) is not SAM:
        raise InputError(f"the folder does not hold {_FIRST}")
    files = _weight_files(folder)
    if len(files) == 0:
        raise InputError(f"the folder has no {_FILES[0]}")
    config = json.loads((folder / "config.json").read_text())
    check_sizes(config)
    return import_transformers().SamConfig.from_dict(config), _read_tensors(files[0])


def _weight_files(folder: Path) -> list[Path]:
    """Return the weight file of a folder, or an empty list."""
    return [folder / name for name in _FILES if (folder / name).is_file()][:1]


def _read_file(path: Path) -> tuple[Any, dict[str, Tensor]]:
    state = _read_tensors(path)
    for name in [*state, *(state["model"] if isinstance(state.get("model"), Mapping) else [])]:
        for part, kind in _OTHERS.items():
            if str(name).startswith(part):
                raise InputError(f"its parameter {name} is of {kind}, expected {_FIRST}{_AS_FOLDER}")
    if "image_encoder.pos_embed" not in state:
        if (path.parent / "config.json").is_file():
            return _read_folder(path.parent)
        raise InputError(f"it has no image_encoder.pos_embed, expected a file published by Meta for {_FIRST}")
    return published_config(state), {published_name(name): value for name, value in state.items()}


def _read_tensors(path: Path) -> dict[str, Tensor]:
    if path.suffix == ".safetensors":
        return load_file(path)
    return torch.load(path, map_location="cpu", weights_only=True)


def published_name(name: str) -> str:
    """Return the name in transformers of a parameter in Meta's files.

    >>> published_name("mask_decoder.iou_prediction_head.layers.2.weight")
    'mask_decoder.iou_prediction_head.proj_out.weight'
    """
    for pattern, replacement in _NAMES.items():
        name = re.sub(pattern, replacement, name)
    mlp = re.match(r"(.*(?:hypernetworks_mlps\.\d+|prediction_head))\.layers\.(\d)\.(.*)", name)
    return name if mlp is None else f"{mlp[1]}.{_MLP[mlp[2]]}.{mlp[3]}"


def published_config(state: Mapping[str, Tensor]) -> Any:
    """Return the SamConfig of transformers for a file published by Meta, from the shapes of its parameters.

    Values that shapes do not determine are the same in all of Meta's files: eight heads in the mask decoder, and its
    epsilon.
    """
    shape = {name: tuple(value.shape) for name, value in state.items()}
    _, grid, _, width = shape["image_encoder.pos_embed"]
    patch = shape["image_encoder.patch_embed.proj.weight"][-1]
    blocks = sum(name.endswith(".attn.rel_pos_h") for name in shape)
    extent, head = zip(*(shape[f"image_encoder.blocks.{i}.attn.rel_pos_h"] for i in range(blocks)))
    global_blocks = [i for i in range(blocks) if extent[i] == 2 * grid - 1]
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
        global_attn_indexes=global_blocks,
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
