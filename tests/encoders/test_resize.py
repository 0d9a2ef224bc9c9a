"""Pillow's bilinear resize, to the bit; where Pillow 13 begins with the columns, to one grey value."""

import numpy as np
import pytest
import torch
from hypothesis import example, given
from hypothesis import strategies as st
from PIL import Image

from normlift_ns.segmentation.sam import resize_bilinear
from tests.encoders.tiny import DEVICES
from tests.examples import examples

sides = st.integers(1, 70)


def check(height: int, width: int, to_height: int, to_width: int, seed: int, device: str = "cpu") -> None:
    pixels = np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)
    pixels[: height // 2] = np.where(pixels[: height // 2] > 127, 255, 0)  # extremes too
    expected = Image.fromarray(pixels).resize((to_width, to_height), Image.Resampling.BILINEAR)
    found = resize_bilinear(torch.from_numpy(pixels).to(device), to_height, to_width)
    assert found.dtype == torch.uint8
    off = np.abs(found.cpu().numpy().astype(int) - np.array(expected).astype(int)).max()
    assert off <= (1 if to_height < height else 0)


@examples(25)
@given(height=sides, width=sides, to_height=sides, to_width=sides, seed=st.integers(0, 9))
@example(height=70, width=60, to_height=3, to_width=1, seed=0)
@example(height=1, width=1, to_height=5, to_width=9, seed=0)
def test_equals_pillow(height, width, to_height, to_width, seed):
    check(height, width, to_height, to_width, seed)


@pytest.mark.parametrize("device", DEVICES)
def test_sizes_of_photographs(device):
    for size in ((123, 988, 127, 1024), (1331, 200, 681, 102), (48, 1024, 48, 1024)):
        check(*size, seed=1, device=device)
