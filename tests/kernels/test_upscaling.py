"""The end of SAM's mask decoder by one kernel, against torch's own transposed convolutions in float64."""

import pytest
import torch
from torch.nn.functional import conv_transpose2d, gelu, layer_norm

from normlift_ns.kernels.sam import upscale_masks

CUDA = torch.cuda.is_available()
DEVICE = "cuda" if CUDA else "cpu"
needs_gpu = pytest.mark.skipif(not CUDA, reason="the size of SAM, or bfloat16: needs a GPU")
EPS = 1e-6


@pytest.mark.parametrize(
    ("prompts", "height", "side", "channels", "dtype", "bound"),
    [
        (3, 8, 8, 32, torch.float16, 2e-3),  # parts of what a program can hold
        (2, 5, 13, 64, torch.float16, 2e-3),  # 65 positions: one more than a program has
        pytest.param(20, 64, 64, 256, torch.float16, 2e-3, marks=needs_gpu),
        pytest.param(5, 64, 64, 256, torch.bfloat16, 1e-2, marks=needs_gpu),
    ],
)  # fmt: skip
def test_equals_transposed_convolutions(prompts, height, side, channels, dtype, bound):
    g = torch.Generator().manual_seed(side)
    middle, last = channels // 4, channels // 8

    def made(*shape, scale=1.0):
        return (scale * torch.randn(*shape, generator=g)).to(dtype)

    keys = made(prompts, height * side, channels)
    first, second = made(channels, middle, 2, 2, scale=channels**-0.5), made(middle, last, 2, 2, scale=middle**-0.5)
    biases, norm = (made(middle), made(last)), (made(middle), made(middle))
    wanted = made(prompts, 3, last)
    weights = tuple(w.permute(2, 3, 1, 0).flatten(0, 2).contiguous().to(DEVICE) for w in (first, second))
    found = upscale_masks(
        keys.to(DEVICE), weights, tuple(b.to(DEVICE) for b in biases), (*(n.to(DEVICE) for n in norm), EPS),
        wanted.to(DEVICE), side,
    )  # fmt: skip
    image = keys.double().unflatten(1, (height, side)).permute(0, 3, 1, 2)
    grown = conv_transpose2d(image, first.double(), biases[0].double(), stride=2).permute(0, 2, 3, 1)
    pixels = gelu(layer_norm(grown, (middle,), norm[0].double(), norm[1].double(), EPS)).permute(0, 3, 1, 2)
    pixels = gelu(conv_transpose2d(pixels, second.double(), biases[1].double(), stride=2))
    expected = torch.einsum("pko,poyx->pkyx", wanted.double(), pixels)
    assert found.shape == expected.shape == (prompts, 3, 4 * height, 4 * side) and found.dtype == dtype
    assert float((found.cpu().double() - expected).abs().max()) < bound * float(expected.abs().max())
