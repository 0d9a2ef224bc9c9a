"""Networks of the real kinds with few random weights, written to disk, for the real loading code."""

import json
from functools import partial
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file
from segment_anything.modeling import ImageEncoderViT, MaskDecoder, PromptEncoder, Sam, TwoWayTransformer
from torch.nn import LayerNorm

from normlift_ns.encoders.clip.weights import import_open_clip

open_clip = import_open_clip()
needs_cuda = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA GPU")
DEVICES = ["cpu", pytest.param("cuda", marks=needs_cuda)]

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


def tiny_sam(seed: int = 0, gain: float = 1.0) -> Sam:
    """A SAM in Meta's own code, its weights scaled until masks have edges and scores are about 1; with more gain in the
    decoder masks depend on the point, and errors of rounding grow."""
    grid = SIDE // 16
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        sam = Sam(
            image_encoder=ImageEncoderViT(
                img_size=SIDE,
                embed_dim=32,
                depth=2,
                num_heads=2,
                mlp_ratio=2,
                out_chans=_CHANNELS,
                norm_layer=partial(LayerNorm, eps=1e-6),
                use_rel_pos=True,
                window_size=4,
                global_attn_indexes=(1,),
            ),
            prompt_encoder=PromptEncoder(_CHANNELS, (grid, grid), (SIDE, SIDE), mask_in_chans=4),
            mask_decoder=MaskDecoder(
                transformer_dim=_CHANNELS,
                transformer=TwoWayTransformer(depth=2, embedding_dim=_CHANNELS, num_heads=8, mlp_dim=64),
                iou_head_hidden_dim=32,
            ),
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
    """Writes a file as Meta publishes them."""
    torch.save(tiny_sam(seed, gain).state_dict(), path)


def write_clip(folder: Path, name: str = CLIP, dimension: int = 24) -> None:
    """Makes the architecture known to open_clip and writes tiny.pt and tiny.safetensors of the same 1.7 M weights."""
    (folder / f"{name}.json").write_text(json.dumps({**CLIP_CONFIG, "embed_dim": dimension}))
    open_clip.add_model_config(folder / f"{name}.json")
    with torch.random.fork_rng():
        torch.manual_seed(0)
        state = open_clip.create_model(name).state_dict()
    torch.save(state, folder / "tiny.pt")
    save_file({key: value.contiguous() for key, value in state.items()}, folder / "tiny.safetensors")
