"""Small holes and pieces, against the same rules mask by mask with SciPy's labelling of pixels."""

import numpy as np
import pytest
import torch
from hypothesis import example, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy import ndimage

from normlift_ns.segmentation import mask_filtering
from normlift_ns.segmentation.mask_filtering import remove_small_regions
from tests.encoders.tiny import DEVICES
from tests.examples import examples

EIGHT = np.ones((3, 3))


def areas(mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Component of every pixel, 0 outside, and the pixels of each, [0] apart."""
    labels, count = ndimage.label(mask, EIGHT)
    return labels, np.bincount(labels[mask], minlength=count + 1)


def clean_by_hand(mask: np.ndarray, least: int) -> tuple[list[np.ndarray], bool]:
    """All right answers, several where the largest of small pieces has equals; and whether anything is small."""
    holes, hole = areas(~mask)
    filled = mask | ((hole < least)[holes] & ~mask)
    pieces, piece = areas(filled)
    small = bool((hole[1:] < least).any() or (piece[1:] < least).any())
    if len(piece) == 1:
        return [filled], small
    stay = piece >= least
    stay[0] = False
    if stay.any():
        return [stay[pieces]], small
    return [pieces == i for i in range(1, len(piece)) if piece[i] == piece[1:].max()], small


def assert_right(masks: np.ndarray, least: int, device: str = "cpu") -> tuple[np.ndarray, list[bool]]:
    given = torch.from_numpy(masks).to(device)
    cleaned, changed = remove_small_regions(given, least)
    assert torch.equal(given.cpu(), torch.from_numpy(masks))  # is left alone
    assert cleaned.dtype == changed.dtype == torch.bool and cleaned.shape == masks.shape
    assert cleaned.device == changed.device == given.device
    for mask, found, different in zip(masks, cleaned.cpu().numpy(), changed.tolist(), strict=True):
        answers, expected = clean_by_hand(mask, least)
        assert any(np.array_equal(found, answer) for answer in answers)
        assert different == expected
    return cleaned.cpu().numpy(), changed.tolist()


@examples(25)
@given(
    masks=arrays(bool, st.tuples(st.integers(1, 4), st.integers(1, 9), st.integers(1, 18))), least=st.integers(0, 30)
)
@example(masks=np.zeros((2, 3, 4), dtype=bool), least=100)  # all of the image is a small hole
@example(masks=np.zeros((2, 3, 4), dtype=bool), least=12)
@example(masks=np.ones((2, 3, 4), dtype=bool), least=100)
@example(masks=np.ones((1, 1, 1), dtype=bool), least=2)
@example(masks=np.indices((3, 8, 8)).sum(axis=0) % 2 == 0, least=5)
def test_any_masks(masks, least):
    assert_right(masks, least)


@pytest.mark.parametrize("device", DEVICES)
def test_noise_stripes_checkerboards_and_plain_masks(device):
    g = np.random.default_rng(3)
    for share in (0.002, 0.1, 0.4, 0.5, 0.6, 0.9, 0.998):
        _, changed = assert_right(g.random((3, 60, 71)) < share, 20, device)
        assert all(changed)
    y, x = np.mgrid[:40, :47]
    masks = [y % 2 == 0, x % 2 == 0, (x + y) % 2 == 0, y > 50, y >= 0, (y == 7) & (x == 9), (y == 39) & (x == 46)]
    masks += [(y == 0) & (x == 0), (x + y) % 5 == 0, (x // 4 + y // 4) % 2 == 0, (y < 20) ^ ((y == 3) & (x > 44))]
    for least in (2, 17, 41, 48, 100):
        assert_right(np.stack(masks), least, device)
    found, different = remove_small_regions(torch.zeros(0, 4, 5, dtype=torch.bool, device=device), 10)
    assert found.shape == (0, 4, 5) and different.shape == (0,)


def test_chunks_and_a_gpus_components_change_nothing(monkeypatch):
    noise = np.random.default_rng(0).random((7, 60, 45))
    masks = torch.from_numpy(ndimage.uniform_filter(noise, (0, 5, 5)) > 0.5)
    expected = remove_small_regions(masks, 40)
    assert expected[1].all() and not torch.equal(expected[0], masks)
    for chunk in (1, 3 * 60 * 45):
        monkeypatch.setitem(mask_filtering._REGION_CHUNK, "cpu", chunk)
        assert all(map(torch.equal, remove_small_regions(masks, 40), expected))
    monkeypatch.undo()
    turned = remove_small_regions(masks.permute(0, 2, 1), 40)  # another order in memory
    assert torch.equal(turned[0], expected[0].permute(0, 2, 1)) and torch.equal(turned[1], expected[1])
    monkeypatch.setattr(mask_filtering, "_components_by_scipy", mask_filtering._components_by_torch)
    assert all(map(torch.equal, remove_small_regions(masks, 40), expected))
    order = torch.from_numpy(np.random.default_rng(0).permutation(3000))  # a long chain is one component
    assert bool((mask_filtering._components_by_torch(3000, torch.stack([order[1:], order[:-1]])) == 0).all())
