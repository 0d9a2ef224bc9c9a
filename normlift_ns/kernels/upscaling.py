"""Final steps of SAM's mask decoder in one pass: two transposed convolutions and the products with mask channels.

Computed separately, the pixels with their channels would be many times larger than the image and the masks. Here they
stay in registers, in float32 except as input of tensor cores.
"""

from __future__ import annotations

import triton
import triton.language as tl
from jaxtyping import Float
from torch import Tensor

_BLOCK = 64
"""Positions per program."""
_WARPS = 4


@triton.jit
def _gelu(x):
    return 0.5 * x * (1.0 + tl.erf(x * 0.7071067811865476))


@triton.jit
def _upscale(
    keys, first, first_bias, scale, shift, second, second_bias, mask_channels, masks, positions, side, channels, middle,
    last, eps, MASKS: tl.constexpr, BLOCK: tl.constexpr, C: tl.constexpr, M: tl.constexpr, L: tl.constexpr,
):  # fmt: skip
    """Write masks[prompt, mask, 4 y + row, 4 x + column] of some positions (y, x), with row and column in 0..3."""
    prompt = tl.program_id(1).to(tl.int64)
    position = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    c, m, o = tl.arange(0, C), tl.arange(0, M), tl.arange(0, L)
    valid, valid_m, valid_o = position < positions, m < middle, o < last
    pointers = (prompt * positions + position)[:, None] * channels + c[None, :]
    image = tl.load(keys + pointers, mask=valid[:, None] & (c < channels)[None, :], other=0.0)
    norm_scale = tl.load(scale + m, mask=valid_m, other=0.0).to(tl.float32)
    norm_shift = tl.load(shift + m, mask=valid_m, other=0.0).to(tl.float32)
    bias_o = tl.load(second_bias + o, mask=valid_o, other=0.0).to(tl.float32)
    bias_m = tl.load(first_bias + m, mask=valid_m, other=0.0).to(tl.float32)
    corner = 4 * (position // side) * (4 * side) + 4 * (position % side)
    for i in range(4):
        matrix = first + (i * middle + m)[None, :] * channels + c[:, None]
        upscaled = tl.dot(image, tl.load(matrix, mask=valid_m[None, :] & (c < channels)[:, None], other=0.0))
        upscaled += bias_m[None, :]
        centered = tl.where(valid_m[None, :], upscaled - (tl.sum(upscaled, axis=1) / middle)[:, None], 0.0)
        variance = tl.sum(centered * centered, axis=1) / middle
        normed = centered * tl.rsqrt(variance + eps)[:, None] * norm_scale[None, :] + norm_shift[None, :]
        pixel = _gelu(normed).to(keys.dtype.element_ty)
        for j in range(4):
            matrix_o = second + (j * last + o)[None, :] * middle + m[:, None]
            upscaled_o = tl.dot(pixel, tl.load(matrix_o, mask=valid_o[None, :] & valid_m[:, None], other=0.0))
            upscaled_o = _gelu(upscaled_o + bias_o[None, :])
            row, column = 2 * (i // 2) + j // 2, 2 * (i % 2) + j % 2
            for mask in tl.static_range(MASKS):
                plane = prompt * MASKS + mask
                channels_of_mask = tl.load(mask_channels + plane * last + o, mask=valid_o, other=0.0).to(tl.float32)
                logit = tl.sum(upscaled_o * channels_of_mask[None, :], axis=1)
                out = masks + plane * (16 * positions) + corner + row * (4 * side) + column
                tl.store(out, logit.to(masks.dtype.element_ty), mask=valid)


def upscaled_masks(
    keys: Float[Tensor, "p n c"],
    weights: tuple[Float[Tensor, "four_m c"], Float[Tensor, "four_o m"]],
    biases: tuple[Float[Tensor, " m"], Float[Tensor, " o"]],
    norm: tuple[Float[Tensor, " m"], Float[Tensor, " m"], float],
    mask_channels: Float[Tensor, "p k o"],
    side: int,
) -> Float[Tensor, "p k y x"]:
    """Return the logits of masks, 4 x 4 for every position of an image with `side` columns.

    Args:
        keys: Positions of the image of every prompt, in half precision.
        weights: Weights of both convolutions; a position becomes four, row by row.
        biases: Biases of both convolutions.
        norm: Weight, bias and epsilon of the layer norm after the first convolution.
        mask_channels: Channels of the masks.
        side: Columns of the image.
    """
    (prompts, positions, channels), middle, last = keys.shape, len(biases[0]), len(biases[1])
    masks = keys.new_empty(prompts, mask_channels.shape[1], 4 * (positions // side), 4 * side)
    padded = [max(16, triton.next_power_of_2(size)) for size in (channels, middle, last)]  # sizes for tensor cores
    _upscale[(triton.cdiv(positions, _BLOCK), prompts)](
        keys.contiguous(), weights[0], biases[0], norm[0], norm[1], weights[1], biases[1], mask_channels.contiguous(),
        masks, positions, side, channels, middle, last, norm[2],
        MASKS=mask_channels.shape[1], BLOCK=_BLOCK, C=padded[0], M=padded[1], L=padded[2], num_warps=_WARPS,
    )  # fmt: skip
    return masks
