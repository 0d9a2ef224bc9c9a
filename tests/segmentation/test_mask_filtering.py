"""Rules on masks, against straightforward Python: sets of pixels, exact fractions as floats."""

from collections.abc import Iterator

import numpy as np
import pytest
import torch
from hypothesis import example, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy import ndimage

from normlift_ns.segmentation import mask_filtering, regions
from normlift_ns.segmentation.mask_filtering import Suppression, mask_nms, masks_to_boxes, remove_small_regions
from normlift_ns.segmentation.regions import stack_masks
from tests.encoders.tiny import needs_cuda
from tests.examples import examples


@pytest.fixture(autouse=True, scope="module")
def small_chunks() -> Iterator[None]:
    """So that these masks are read in several parts."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(regions._MASK_CHUNK, "cpu", 200)
        yield


def nms_by_hand(masks: list[set], scores: list[float], rules: Suppression) -> list[bool]:
    """LangSplat's suppression, pair by pair, with its inner score."""
    count = len(masks)
    order = sorted(range(count), key=lambda i: -scores[i])  # stable
    repeated, inner = [0.0] * count, [0.0] * count
    for a in range(count):
        for b in range(a + 1, count):
            i, j = order[a], order[b]
            both = len(masks[i] & masks[j])
            repeated[j] = max(repeated[j], both / len(masks[i] | masks[j]))
            share_i, share_j = both / len(masks[i]), both / len(masks[j])
            if share_i < rules.outer and share_j >= rules.inner:
                inner[j] = max(inner[j], 1 - share_i * share_j)
            if share_i >= rules.inner and share_j < rules.outer:
                inner[i] = max(inner[i], 1 - share_i * share_j)
    confident = [score > rules.score for score in scores]
    if not any(confident):
        for i in order[:3]:
            confident[i] = True
    return [confident[i] and repeated[i] <= rules.iou and inner[i] <= 0.5 for i in range(count)]


def pixels(mask: np.ndarray) -> set:
    return set(map(tuple, np.argwhere(mask).tolist()))


@st.composite
def boxes_with_noise(draw) -> np.ndarray:
    """Rectangles, nested and repeated more often than by chance, some with holes."""
    count, height, width = draw(st.integers(0, 9)), draw(st.integers(1, 9)), draw(st.integers(1, 9))
    masks = np.zeros((count, height, width), dtype=bool)
    for mask in masks:
        top, left = draw(st.integers(0, height - 1)), draw(st.integers(0, width - 1))
        bottom, right = draw(st.integers(top, height - 1)), draw(st.integers(left, width - 1))
        mask[top : bottom + 1, left : right + 1] = True
        if draw(st.booleans()):
            mask[~draw(arrays(bool, (height, width)))] = False
        mask[top, left] = True
    return masks


@examples(20)
@given(
    masks=boxes_with_noise(),
    data=st.data(),
    rules=st.sampled_from([Suppression(), Suppression(iou=0.5, score=0.3, outer=0.4, inner=0.6)]),
)
def test_suppression_is_that_of_the_protocol(masks, data, rules):
    levels = st.sampled_from([0.0, 0.25, 0.3, 0.5, 0.7, 0.75, 0.8, 1.0])  # ties, and the threshold itself
    scores = data.draw(st.lists(levels, min_size=len(masks), max_size=len(masks)))
    found = mask_nms(torch.from_numpy(masks), torch.tensor(scores, dtype=torch.float64), rules)
    assert found.tolist() == nms_by_hand([pixels(mask) for mask in masks], scores, rules)


def discs(pairs: int = 24) -> np.ndarray:
    """Pairs of discs that nearly agree, of areas from specks to half of the image."""
    g = np.random.default_rng(0)
    y, x = np.mgrid[:60, :80]
    masks = []
    for _ in range(pairs):
        cy, cx, r = g.uniform(0, 60), g.uniform(0, 80), np.exp(g.uniform(0.5, 3.5))
        masks.append((y - cy) ** 2 + (x - cx) ** 2 < r**2)
        masks.append((y - cy - g.normal()) ** 2 + (x - cx) ** 2 < (r * g.uniform(0.9, 1.1)) ** 2)
    return np.array([mask for mask in masks if mask.any()])


def test_suppression_of_overlaps_as_large_as_those_of_photographs():
    masks = discs()
    scores = np.random.default_rng(1).uniform(0.6, 1, len(masks))
    found = mask_nms(torch.from_numpy(masks), torch.from_numpy(scores))
    assert found.tolist() == nms_by_hand([pixels(mask) for mask in masks], scores.tolist(), Suppression())
    assert 5 < int(found.sum()) < len(masks) // 2


def test_defaults_and_the_extremes_of_masks():
    assert Suppression() == Suppression(iou=0.8, score=0.7, outer=0.5, inner=0.85)
    assert mask_nms(torch.eye(5, dtype=torch.bool)[:, None], torch.arange(5) / 9).tolist() == [False] * 2 + [True] * 3
    for count in (0, 3):  # no masks, and whole images
        masks = torch.ones(count, 4, 5, dtype=torch.bool)
        assert mask_nms(masks, torch.ones(count)).tolist() == [True, False, False][:count]
        assert stack_masks(masks).shape == (max(1, count), 4, 5)


@needs_cuda
def test_a_gpu_finds_the_same():
    masks = torch.from_numpy(discs(60))
    scores = 0.6 + 0.4 * torch.rand(len(masks), generator=torch.Generator().manual_seed(0))
    assert torch.equal(mask_nms(masks.cuda(), scores.cuda()).cpu(), mask_nms(masks, scores))
    assert torch.equal(stack_masks(masks.cuda()).cpu(), stack_masks(masks))
    assert torch.equal(masks_to_boxes(masks.cuda()).cpu(), masks_to_boxes(masks))
    assert mask_nms(masks[:0].cuda(), scores[:0].cuda()).device.type == "cuda"
    noise = np.random.default_rng(3).random((3, 60, 71))
    for share in (0.1, 0.5, 0.9):
        assert_right(noise < share, 20, "cuda")


@given(masks=boxes_with_noise(), empty=st.booleans())
def test_later_masks_lie_on_top_and_none_is_lost_nor_any_box(masks, empty):
    masks = np.concatenate([masks, np.zeros((1, *masks.shape[1:]), dtype=bool)]) if empty else masks
    labels = stack_masks(torch.from_numpy(masks)).numpy()
    assert labels.dtype == np.int32
    assert len(labels) == max(1, masks.sum(axis=0).max(initial=0))
    by_hand = np.full(masks.shape[1:], -1)
    for i, mask in enumerate(masks):
        by_hand[mask] = i
        assert ((labels == i).any(axis=0) == mask).all()
        assert ((labels == i).sum(axis=0) <= 1).all()
    for mask, box in zip(masks, masks_to_boxes(torch.from_numpy(masks)).tolist(), strict=True):
        y, x = np.nonzero(mask)
        assert box == ([x.min(), y.min(), x.max(), y.max()] if len(y) > 0 else [0, 0, 0, 0])
    assert (labels[0] == by_hand).all()
    assert ((labels[:-1] > labels[1:]) | (labels[1:] == -1)).all()


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


def assert_right(masks: np.ndarray, least: int, device: str = "cpu") -> None:
    given = torch.from_numpy(masks).to(device)
    cleaned, changed = remove_small_regions(given, least)
    assert torch.equal(given.cpu(), torch.from_numpy(masks))  # is left alone
    assert cleaned.dtype == changed.dtype == torch.bool and cleaned.shape == masks.shape
    assert cleaned.device == changed.device == given.device
    for mask, found, different in zip(masks, cleaned.cpu().numpy(), changed.tolist(), strict=True):
        answers, expected = clean_by_hand(mask, least)
        assert any(np.array_equal(found, answer) for answer in answers)
        assert different == expected


@examples(25)
@given(
    masks=arrays(bool, st.tuples(st.integers(1, 4), st.integers(1, 9), st.integers(1, 18))), least=st.integers(0, 30)
)
@example(masks=np.zeros((2, 3, 4), dtype=bool), least=100)  # all of the image is a small hole
@example(masks=np.zeros((2, 3, 4), dtype=bool), least=12)
@example(masks=np.ones((2, 3, 4), dtype=bool), least=100)
@example(masks=np.ones((1, 1, 1), dtype=bool), least=2)
@example(masks=np.indices((3, 8, 8)).sum(axis=0) % 2 == 0, least=5)
@example(masks=np.array([[[1, 1, 0], [0, 0, 0], [1, 1, 1]], [[1, 1, 1], [1, 0, 1], [1, 0, 1]]], bool), least=2)
def test_any_masks(masks, least):
    assert_right(masks, least)
    found, different = remove_small_regions(torch.from_numpy(masks[:0]), least)
    assert found.shape == (0, *masks.shape[1:]) and different.shape == (0,)


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
