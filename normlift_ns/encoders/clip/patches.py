"""Patch features of OpenCLIP's vision transformers.

The last layer of CLIP mixes all patches into one vector. As in MaskCLIP (Zhou, Loy and Dai, ECCV 2022), only the value
path of that layer is used. Patch tokens of the preceding layer pass through the last layer's first norm, its value and
output projections, the final norm, and the joint-space projection. The image is scaled to a whole number of patches,
preserving its aspect ratio, and position embeddings are interpolated to that grid.
"""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import interpolate, linear

from normlift_ns.encoders.clip.architectures import model_config


def why_not_dense(model: str) -> str | None:
    """Return why an OpenCLIP architecture has no value path to follow; None if it has one."""
    vision = (model_config(model) or {"vision_cfg": {}})["vision_cfg"]
    if "timm_model_name" in vision:
        return "its image encoder is timm's"
    if not isinstance(vision.get("layers"), int):
        return "its image encoder is a convolutional network"
    return "it pools by attention" if vision.get("attentional_pool") else None


@torch.no_grad()
def dense_tokens(visual: Any, pixels: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b r d"]:
    """Return patch tokens in the joint space, row by row, not normalized.

    Args:
        visual: open_clip's VisionTransformer.
        pixels: Normalized images of a whole number of patches.
    """
    tokens = visual.conv1(pixels)
    rows, columns = tokens.shape[2:]
    tokens = tokens.flatten(2).transpose(1, 2)
    first = visual.class_embedding.to(tokens.dtype).expand(len(tokens), 1, -1)
    positions = _positions(visual, rows, columns).to(tokens.dtype)
    tokens = visual.ln_pre(torch.cat([first, tokens], dim=1) + positions)
    *before, last = visual.transformer.resblocks
    for block in before:
        tokens = block(tokens)
    tokens = last.ln_1(tokens[:, 1:])
    values = linear(tokens, last.attn.in_proj_weight.chunk(3)[2], last.attn.in_proj_bias.chunk(3)[2])
    return visual.ln_post(last.ls_1(last.attn.out_proj(values))) @ visual.proj


def _positions(visual: Any, rows: int, columns: int) -> Float[Tensor, "n d"]:
    """Return position embeddings of the class token and of a grid of patches, interpolated bicubically."""
    learned = visual.positional_embedding.float()
    grid = learned[1:].reshape(*visual.grid_size, -1).permute(2, 0, 1)[None]
    grid = interpolate(grid, (rows, columns), mode="bicubic", antialias=True, align_corners=False)
    return torch.cat([learned[:1], grid[0].flatten(1).T])
