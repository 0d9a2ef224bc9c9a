"""Counts and boxes of masks that are never made, against those of masks that are."""

import pytest
import torch
from torch.nn.functional import interpolate

from normlift_ns.kernels.sam import measure_masks
from normlift_ns.segmentation.mask_filtering import measure_logits
from normlift_ns.segmentation.sam import bilinear_weights

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
CLOSE = 1e-5
"""Of the largest logit: nearer to a threshold rounding decides."""


def smooth(count: int, side: int) -> torch.Tensor:
    coarse = torch.randn(count, 1, 6, 6, generator=torch.Generator().manual_seed(0))
    return 8 * interpolate(coarse, (side, side), mode="bicubic")[:, 0] + torch.linspace(-9, 7, count)[:, None, None]


def enlarged(logits: torch.Tensor, side: int, scaled: tuple[int, int], size: tuple[int, int]) -> torch.Tensor:
    whole = interpolate(logits[:, None].double(), (side, side), mode="bilinear", align_corners=False)
    return interpolate(whole[:, :, : scaled[0], : scaled[1]], size, mode="bilinear", align_corners=False)[:, 0]


@pytest.mark.parametrize(
    ("side", "scaled", "size", "dtype"),
    [
        (64, (33, 64), (20, 39), torch.float16),
        (64, (33, 64), (67, 39), torch.float32),  # 67 rows: a block and a part of one
        (64, (1, 64), (1, 70), torch.float32),
        pytest.param(64, (64, 41), (100, 64), torch.float16, marks=pytest.mark.extra),
        pytest.param(128, (128, 128), (128, 128), torch.float32, marks=pytest.mark.extra),
    ],
)
def test_equals_masks_that_are_made(side, scaled, size, dtype):
    logits = smooth(7, side // 4).to(dtype)
    logits[-1] = -5.0  # an empty mask
    logits[-2] = 5.0  # a full one
    rows, columns = (bilinear_weights(side // 4, side, s, n) for s, n in zip(scaled, size))
    low, *weights = (x.to(DEVICE) for x in (logits, *rows, *columns))
    inner, outer, boxes = measure_masks(low, *weights, offset=1.0)
    large = enlarged(logits, side, scaled, size)
    expected = measure_logits(large, 1.0)
    close = CLOSE * float(large.abs().max())
    for found, exact, bound in ((inner, expected.inner, 1.0), (outer, expected.outer, -1.0)):
        undecided = ((large - bound).abs() < close).flatten(1).sum(dim=1)
        assert bool(((found.cpu() - exact).abs() <= undecided).all())
        assert int(undecided.sum()) < 0.01 * large.numel()
    decided = ~(large.abs() < close).flatten(1).any(dim=1)
    assert int(decided.sum()) >= 4
    assert torch.equal(boxes.cpu()[decided], expected.boxes[decided])
    assert decided[-2:].all() and boxes[-2].tolist() == [0, 0, size[1] - 1, size[0] - 1]
    assert 0 < int(expected.inner[3]) < int(expected.outer[3]) or min(size) == 1
