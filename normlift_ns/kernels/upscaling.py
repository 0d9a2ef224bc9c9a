"""The end of SAM's mask decoder in one pass: both transposed convolutions and the products with the masks' channels.

Step by step, pixels with their channels are many times larger than the image they come from and the masks they become;
here they stay in registers, in float32 but where tensor cores take them.
"""

from __future__ import annotations

import triton
import triton.language as tl
from jaxtyping import Float
from torch import Tensor

_BLOCK = 64
"""Positions of a program."""
_WARPS = 4


@triton.jit
def _gelu(x):
    return 0.5 * x * (1.0 + tl.erf(x * 0.7071067811865476))


@triton.jit
def _upscale(
    keys, first, first_bias, scale, shift, second, second_bias, wanted, masks, positions, side, channels, middle, last,
    eps, MASKS: tl.constexpr, BLOCK: tl.constexpr, C: tl.constexpr, M: tl.constexpr, L: tl.constexpr,
):  # fmt: skip
    """masks[prompt, mask, 4 y + 2 upper + lower, ...] of some positions (y, x)."""
    prompt = tl.program_id(1).to(tl.int64)
    place = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    c, m, o = tl.arange(0, C), tl.arange(0, M), tl.arange(0, L)
    there, of_m, of_o = place < positions, m < middle, o < last
    at = (prompt * positions + place)[:, None] * channels + c[None, :]
    image = tl.load(keys + at, mask=there[:, None] & (c < channels)[None, :], other=0.0)
    gain = tl.load(scale + m, mask=of_m, other=0.0).to(tl.float32)
    offset = tl.load(shift + m, mask=of_m, other=0.0).to(tl.float32)
    bias = tl.load(second_bias + o, mask=of_o, other=0.0).to(tl.float32)
    own_bias = tl.load(first_bias + m, mask=of_m, other=0.0).to(tl.float32)
    corner = 4 * (place // side) * (4 * side) + 4 * (place % side)
    for i in range(4):
        matrix = first + (i * middle + m)[None, :] * channels + c[:, None]
        grown = tl.dot(image, tl.load(matrix, mask=of_m[None, :] & (c < channels)[:, None], other=0.0))
        grown += own_bias[None, :]
        centred = tl.where(of_m[None, :], grown - (tl.sum(grown, axis=1) / middle)[:, None], 0.0)
        spread = tl.sum(centred * centred, axis=1) / middle
        normed = centred * tl.rsqrt(spread + eps)[:, None] * gain[None, :] + offset[None, :]
        pixel = _gelu(normed).to(keys.dtype.element_ty)
        for j in range(4):
            finest = second + (j * last + o)[None, :] * middle + m[:, None]
            finer = tl.dot(pixel, tl.load(finest, mask=of_o[None, :] & of_m[:, None], other=0.0))
            finer = _gelu(finer + bias[None, :])
            row, column = 2 * (i // 2) + j // 2, 2 * (i % 2) + j % 2
            for mask in tl.static_range(MASKS):
                plane = prompt * MASKS + mask
                of_mask = tl.load(wanted + plane * last + o, mask=of_o, other=0.0).to(tl.float32)
                logit = tl.sum(finer * of_mask[None, :], axis=1)
                out = masks + plane * (16 * positions) + corner + row * (4 * side) + column
                tl.store(out, logit.to(masks.dtype.element_ty), mask=there)


def upscaled_masks(
    keys: Float[Tensor, "p n c"],
    weights: tuple[Float[Tensor, "four_m c"], Float[Tensor, "four_o m"]],
    biases: tuple[Float[Tensor, " m"], Float[Tensor, " o"]],
    norm: tuple[Float[Tensor, " m"], Float[Tensor, " m"], float],
    wanted: Float[Tensor, "p k o"],
    side: int,
) -> Float[Tensor, "p k y x"]:
    """Logits of masks, 4 x 4 for every position of an image of `side` columns.

    Args:
        keys: positions of the image of every prompt, in half precision.
        weights: of both convolutions; a position becomes four, row by row.
        norm: weight, bias and epsilon of the layer norm after the first convolution.
        wanted: channels of the masks.
    """
    (prompts, positions, channels), middle, last = keys.shape, len(biases[0]), len(biases[1])
    masks = keys.new_empty(prompts, wanted.shape[1], 4 * (positions // side), 4 * side)
    padded = [max(16, triton.next_power_of_2(size)) for size in (channels, middle, last)]  # what tensor cores take
    _upscale[(triton.cdiv(positions, _BLOCK), prompts)](
        keys.contiguous(), weights[0], biases[0], norm[0], norm[1], weights[1], biases[1], wanted.contiguous(), masks,
        positions, side, channels, middle, last, norm[2],
        MASKS=wanted.shape[1], BLOCK=_BLOCK, C=padded[0], M=padded[1], L=padded[2], num_warps=_WARPS,
    )  # fmt: skip
    return masks
