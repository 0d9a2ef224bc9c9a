"""Networks of the real kinds with few random weights, written to disk, for the real loading code."""

import json
import shutil
from collections.abc import Callable
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import save_file
from torch.utils._python_dispatch import TorchDispatchMode

from normlift_ns.encoders.open_clip import import_open_clip
from normlift_ns.errors import InputError

needs_cuda = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA GPU")
DEVICES = ["cpu", pytest.param("cuda", marks=needs_cuda)]
HUB = {"siglip": "siglip", "siglip2": "siglip2", "naflex": "siglip2", "metaclip2": "metaclip2"}
"""Networks of the hub, and the encoder of each."""

CLIP = "normlift-tiny"
"""Name of the OpenCLIP architecture."""
CLIP_CONFIG = {
    "embed_dim": 24,
    "vision_cfg": {"image_size": 32, "layers": 2, "width": 64, "head_width": 32, "patch_size": 8},
    "text_cfg": {"context_length": 77, "vocab_size": 49408, "width": 32, "heads": 2, "layers": 2},
}
SIDE = 128
"""Of SAM's input."""
_CHANNELS = 32


def tiny_sam(seed: int = 0, gain: float = 1.0) -> Any:
    """A SAM in Meta's own code, scaled until masks have edges; with more gain they depend on the point."""
    meta, grid = import_module("segment_anything.modeling"), SIDE // 16
    shape = {"img_size": SIDE, "embed_dim": 32, "depth": 2, "num_heads": 2, "mlp_ratio": 2, "out_chans": _CHANNELS}
    windows = {"use_rel_pos": True, "window_size": 4, "global_attn_indexes": (1,)}
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        encoder = meta.ImageEncoderViT(**shape, **windows, norm_layer=partial(torch.nn.LayerNorm, eps=1e-6))
        prompts = meta.PromptEncoder(_CHANNELS, (grid, grid), (SIDE, SIDE), mask_in_chans=4)
        turning = meta.TwoWayTransformer(depth=2, embedding_dim=_CHANNELS, num_heads=8, mlp_dim=64)
        sam = meta.Sam(
            image_encoder=encoder,
            prompt_encoder=prompts,
            mask_decoder=meta.MaskDecoder(transformer_dim=_CHANNELS, transformer=turning, iou_head_hidden_dim=32),
            pixel_mean=[123.675, 116.28, 103.53],
            pixel_std=[58.395, 57.12, 57.375],
        )
        with torch.no_grad():
            for name, value in sam.named_parameters():
                if "rel_pos" in name or "pos_embed" in name:
                    value.normal_(std=0.3)
                elif name.startswith("mask_decoder.transformer") and name.endswith("weight") and "norm" not in name:
                    value.mul_(4 * gain if gain > 1 and ("q_proj" in name or "k_proj" in name) else gain)
            sam.prompt_encoder.pe_layer.positional_encoding_gaussian_matrix *= 0.3
            for mlp in sam.mask_decoder.output_hypernetworks_mlps:
                mlp.layers[2].weight *= 400
                mlp.layers[2].bias.zero_()
            score = sam.mask_decoder.iou_prediction_head.layers[2]
            score.weight *= 2
            score.bias.fill_(0.95)
    return sam.eval()


def write_sam(path: Path, seed: int = 0, gain: float = 1.0) -> None:
    torch.save(tiny_sam(seed, gain).state_dict(), path)


def write_clip(folder: Path, name: str = CLIP, dimension: int = 24) -> None:
    """Makes the architecture known to open_clip and writes tiny.pt and tiny.safetensors of the same 1.7 M weights."""
    (folder / f"{name}.json").write_text(json.dumps({**CLIP_CONFIG, "embed_dim": dimension}))
    open_clip = import_open_clip()
    open_clip.add_model_config(folder / f"{name}.json")
    with torch.random.fork_rng():
        torch.manual_seed(0)
        state = open_clip.create_model(name).state_dict()
    torch.save(state, folder / "tiny.pt")
    save_file({key: value.contiguous() for key, value in state.items()}, folder / "tiny.safetensors")


def refused(call: Callable[[], object], *parts: str, error: type[Exception] = InputError) -> str:
    """The message of the error that a call raises: one line, which holds all the parts."""
    try:
        call()
    except error as caught:
        message = str(caught)
        assert caught.__suppress_context__ or caught.__context__ is None or error is not InputError, parts
    else:
        pytest.fail(f"nothing was refused, expected {parts}")
    assert "\n" not in message and [part for part in parts if part not in message] == [], message
    return message


def copied(folder: Path, to: Path) -> Path:
    return shutil.copytree(folder, to, dirs_exist_ok=True)


def noise(height: int, width: int, seed: int = 0) -> torch.Tensor:
    return torch.randint(0, 256, (height, width, 3), generator=torch.Generator().manual_seed(seed), dtype=torch.uint8)


class Largest(TorchDispatchMode):
    """The most elements of any floating tensor that is made."""

    most = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        found = func(*args, **(kwargs or {}))
        for one in found if isinstance(found, tuple | list) else (found,):
            if isinstance(one, torch.Tensor) and one.is_floating_point():
                self.most = max(self.most, one.numel())
        return found
