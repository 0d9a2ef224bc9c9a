"""Dense CLIP features without masks: every patch of a vision transformer is a region with a feature of its own.

The last layer of CLIP mixes all patches into one vector. As in MaskCLIP, it is left out but for its value path: the
patch tokens of the layer before go through the layer's first norm, its value and output projections, the final norm
and the projection into the joint space. The image is scaled, with its shape kept, to a whole number of patches; the
position embeddings are interpolated to that.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float32, Int32, UInt8
from torch import Tensor
from torch.nn.functional import interpolate, linear, normalize

from normlift_ns.encoders.batches import Batches
from normlift_ns.encoders.clip.architectures import model_config
from normlift_ns.encoders.clip.encoder import OpenClipEncoder
from normlift_ns.encoders.regions import resample_nearest
from normlift_ns.encoders.source import ViewFeatures, check_image
from normlift_ns.errors import InputError
from normlift_ns.options import DEFAULT_MODEL


def why_not_dense(model: str) -> str | None:
    """Why an OpenCLIP architecture has no value path to follow; None if it has one."""
    vision = (model_config(model) or {"vision_cfg": {}})["vision_cfg"]
    if "timm_model_name" in vision:
        return "its image encoder is timm's"
    if not isinstance(vision.get("layers"), int):
        return "its image encoder is a convolutional network"
    return "it pools by attention" if vision.get("attentional_pool") else None


@dataclass(frozen=True)
class PatchFeatures:
    """A `FeatureSource` of patches; formulas at the top of this file.

    Raises:
        ValueError: an architecture without a value path; a count below 1.
    """

    encoder: OpenClipEncoder
    """Whose network it is, and who reads texts."""
    count: int = 1024
    """Patches per image, about; at least 1."""

    def __post_init__(self) -> None:
        if self.count < 1:
            raise InputError(f"number of regions per image must be at least 1, got {self.count}")
        reason = why_not_dense(self.encoder.model)
        if reason is not None:
            raise InputError(
                f"--regions patches needs a vision transformer of open_clip; {self.encoder.model} is none: {reason}. "
                f"Take --encoder-model {DEFAULT_MODEL}, or other regions"
            )

    @property
    def identity(self) -> dict[str, Any]:
        return {"kind": "patches", "count": self.count, "encoder": self.encoder.identity}

    def available(self, names: Sequence[str]) -> list[str]:
        return list(names)

    def view(self, image: UInt8[Tensor, "h w 3"], name: str) -> ViewFeatures:
        """As in `FeatureSource`; raises as `features`."""
        return ViewFeatures(self.labels(image), self.features(image, name))

    def labels(self, image: UInt8[Tensor, "h w 3"]) -> Int32[Tensor, "h w"]:
        """Patch of every pixel, the nearest one, counted row by row."""
        height, width = image.shape[:2]
        rows, columns = patch_grid(height, width, self.count)
        patches = np.arange(rows * columns, dtype=np.int32).reshape(1, rows, columns)
        return torch.from_numpy(resample_nearest(patches, height, width)[0])

    def features(self, image: UInt8[Tensor, "h w 3"], name: str) -> Float32[Tensor, "r d"]:
        """One unit row per patch.

        Raises:
            FileNotFoundError: the weights cannot be downloaded.
            ValueError: no picture; a weight file that is damaged or of another architecture.
            MemoryError: the memory of the device does not hold the image.
        """
        check_image(image, name)
        rows, columns = patch_grid(image.shape[0], image.shape[1], self.count)
        return next(self._images(lambda batch: self._tokens(batch[0], rows, columns), image[None]))

    def text(self, prompts: Sequence[str]) -> Float32[Tensor, "q d"]:
        return self.encoder.text(prompts)

    def _tokens(self, image: Tensor, rows: int, columns: int) -> Float32[Tensor, "r d"]:
        network = self.encoder.network
        tall, wide = network.model.visual.patch_size
        pixels = image.to(self.encoder.device).permute(2, 0, 1)[None].float()
        size = rows * tall, columns * wide
        pixels = interpolate(pixels, size, mode="bicubic", antialias=True, align_corners=False).clamp(0, 255)
        return normalize(dense_tokens(network.model.visual, network.normalized(pixels))[0].float(), dim=1).cpu()

    @cached_property
    def _images(self) -> Batches:
        return Batches(1)


def patch_grid(height: int, width: int, count: int) -> tuple[int, int]:
    """Rows and columns of about `count` squares in an image, none of them smaller than a pixel.

    >>> patch_grid(960, 540, 1024)
    (43, 24)
    """
    side = max(1.0, math.sqrt(height * width / count))
    return max(1, round(height / side)), max(1, round(width / side))


@torch.no_grad()
def dense_tokens(visual: Any, pixels: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b r d"]:
    """Patch tokens in the joint space, row by row, not normalised.

    Args:
        visual: open_clip's VisionTransformer.
        pixels: normalised, of a whole number of patches.
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
    """Position embeddings of the class token and of a grid of patches, bicubic between those learned."""
    learned = visual.positional_embedding.float()
    grid = learned[1:].reshape(*visual.grid_size, -1).permute(2, 0, 1)[None]
    grid = interpolate(grid, (rows, columns), mode="bicubic", antialias=True, align_corners=False)
    return torch.cat([learned[:1], grid[0].flatten(1).T])
