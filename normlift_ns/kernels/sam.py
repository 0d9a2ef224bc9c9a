"""Triton kernels that measure SAM masks and compute the upscaling of the mask decoder.

The kernels combine SAM's two bilinear resizes into one separable filter with three taps per axis. One program measures
some rows of one mask. It keeps three interpolated rows of logits in registers until a row of the mask needs others.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from jaxtyping import Float, Float32, Int32, Int64
from torch import Tensor

_ROWS = 64
"""Number of rows of a mask per program."""


@triton.jit
def _line(logits, line, first, w0, w1, w2, inside):
    """Return a row of logits, interpolated at the columns of the image."""
    pointer = logits + line + first
    a = tl.load(pointer, mask=inside, other=0.0).to(tl.float32)
    b = tl.load(pointer + 1, mask=inside, other=0.0).to(tl.float32)
    c = tl.load(pointer + 2, mask=inside, other=0.0).to(tl.float32)
    return w0 * a + w1 * b + w2 * c


@triton.jit
def _measure(
    logits, row_first, row_weights, column_first, column_weights, out, height, width, low_height, low_width, offset,
    ROWS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Write the pixel counts above offset and -offset, and the box (x0, y0, x1, y1) of some rows to out[mask, part]."""
    mask = tl.program_id(0).to(tl.int64)
    mask_logits = logits + mask * low_height * low_width
    x = tl.arange(0, BLOCK)
    inside = x < width
    first = tl.load(column_first + x, mask=inside, other=0)
    w0 = tl.load(column_weights + 3 * x, mask=inside, other=0.0)
    w1 = tl.load(column_weights + 3 * x + 1, mask=inside, other=0.0)
    w2 = tl.load(column_weights + 3 * x + 2, mask=inside, other=0.0)
    start = tl.program_id(1) * ROWS
    line = tl.load(row_first + start)
    above = _line(mask_logits, line * low_width, first, w0, w1, w2, inside)
    middle = _line(mask_logits, (line + 1) * low_width, first, w0, w1, w2, inside)
    below = _line(mask_logits, (line + 2) * low_width, first, w0, w1, w2, inside)
    inner = tl.zeros([BLOCK], tl.int32)
    outer = tl.zeros([BLOCK], tl.int32)
    columns = tl.zeros([BLOCK], tl.int32)
    top = tl.full((), 0, tl.int32) + height
    bottom = tl.full((), -1, tl.int32)
    for y in range(start, tl.minimum(start + ROWS, height)):
        next_line = tl.load(row_first + y)
        if next_line != line:
            line = next_line
            above = _line(mask_logits, line * low_width, first, w0, w1, w2, inside)
            middle = _line(mask_logits, (line + 1) * low_width, first, w0, w1, w2, inside)
            below = _line(mask_logits, (line + 2) * low_width, first, w0, w1, w2, inside)
        v0 = tl.load(row_weights + 3 * y)
        v1 = tl.load(row_weights + 3 * y + 1)
        v2 = tl.load(row_weights + 3 * y + 2)
        value = v0 * above + v1 * middle + v2 * below
        inner += (inside & (value > offset)).to(tl.int32)
        outer += (inside & (value > -offset)).to(tl.int32)
        positive = (inside & (value > 0)).to(tl.int32)
        columns = tl.maximum(columns, positive)
        any_positive = tl.max(positive, axis=0)
        top = tl.where((any_positive > 0) & (top == height), y, top)
        bottom = tl.where(any_positive > 0, y, bottom)
    row = out + (mask * tl.num_programs(1) + tl.program_id(1)) * 6
    tl.store(row, tl.sum(inner, axis=0))
    tl.store(row + 1, tl.sum(outer, axis=0))
    tl.store(row + 2, tl.min(tl.where(columns > 0, x, width), axis=0))
    tl.store(row + 3, top)
    tl.store(row + 4, tl.max(tl.where(columns > 0, x, -1), axis=0))
    tl.store(row + 5, bottom)


def measure_masks(
    logits: Float[Tensor, "m y x"],
    row_first: Int32[Tensor, " h"],
    row_weights: Float32[Tensor, "h 3"],
    column_first: Int32[Tensor, " w"],
    column_weights: Float32[Tensor, "w 3"],
    offset: float,
) -> tuple[Int32[Tensor, " m"], Int32[Tensor, " m"], Int64[Tensor, "m 4"]]:
    """Measure masks at the size of the image.

    Args:
        logits: Logits at the resolution of the network.
        row_first: For every row of the image, the first of the three rows of logits that it is interpolated from.
        row_weights: For every row of the image, the weights of the three rows of logits.
        column_first: For every column of the image, the first of the three columns of logits.
        column_weights: For every column of the image, the weights of the three columns of logits.
        offset: Distance of both thresholds from 0.

    Returns:
        The number of pixels above `offset`, the number above -`offset`, and the box of the pixels above 0.
        Boxes are (x0, y0, x1, y1), with x1 and y1 inclusive, or zeros for an empty mask.
    """
    count, height, width = len(logits), len(row_first), len(column_first)
    num_parts, block = triton.cdiv(height, _ROWS), triton.next_power_of_2(width)
    partial = torch.empty(count, num_parts, 6, dtype=torch.int32, device=logits.device)
    _measure[(count, num_parts)](
        logits.contiguous(), row_first, row_weights, column_first, column_weights, partial, height, width,
        logits.shape[1], logits.shape[2], offset, ROWS=_ROWS, BLOCK=block, num_warps=min(16, max(4, block // 256)),
    )  # fmt: skip
    low, high = partial[:, :, 2:4].amin(dim=1), partial[:, :, 4:6].amax(dim=1)
    boxes = torch.cat([low, high], dim=1).long() * (high[:, :1] >= 0)
    return *partial[:, :, :2].sum(dim=1, dtype=torch.int32).unbind(dim=1), boxes


# Final steps of SAM's mask decoder in one pass: two transposed convolutions, then products with mask channels.
#
# In separate steps, the channels of all pixels would take many times the memory of the image and the masks. Here, they
# stay in registers, in float32 except as input of tensor cores.


_BLOCK = 64
"""Number of positions per program."""
_WARPS = 4


@triton.jit
def _gelu(x):
    return 0.5 * x * (1.0 + tl.erf(x * 0.7071067811865476))


@triton.jit
def _upscale(
    keys, first, first_bias, scale, shift, second, second_bias, mask_channels, masks, positions, side, channels, middle,
    last, eps, MASKS: tl.constexpr, BLOCK: tl.constexpr, C: tl.constexpr, M: tl.constexpr, L: tl.constexpr,
):  # fmt: skip
    """Write masks[prompt, mask, 4 y + row, 4 x + column] for some positions (y, x), with row and column in 0..3."""
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


def upscale_masks(
    keys: Float[Tensor, "p n c"],
    weights: tuple[Float[Tensor, "four_m c"], Float[Tensor, "four_o m"]],
    biases: tuple[Float[Tensor, " m"], Float[Tensor, " o"]],
    norm: tuple[Float[Tensor, " m"], Float[Tensor, " m"], float],
    mask_channels: Float[Tensor, "p k o"],
    side: int,
) -> Float[Tensor, "p k y x"]:
    """Return the logits of masks, with 4 x 4 logits for every position of an image embedding.

    Args:
        keys: Image embedding of every prompt, [prompts, positions, channels], in half precision.
        weights: Weights of both convolutions. Each convolution turns a position into four, row by row.
        biases: Biases of both convolutions.
        norm: Weight, bias and epsilon of the layer norm after the first convolution.
        mask_channels: Vector of every mask of every prompt.
        side: Number of columns of the image embedding.
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
