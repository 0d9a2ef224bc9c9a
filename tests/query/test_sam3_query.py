"""Masks of texts, lifted: against sums by hand in float64."""

from typing import Any

import pytest
import torch

from normlift_ns import rasterize_evidence
from normlift_ns.query.sam3_query import mask_evidence
from tests.random_scenes import dense, orbit_camera, random_scene


def test_shares_agreement_and_reliability_are_their_formulas():
    scene, cameras = random_scene(40), [orbit_camera(angle, 40, 24) for angle in (0.0, 0.9, 2.1)]
    g = torch.Generator().manual_seed(1)
    y = torch.arange(24)[:, None].expand(24, 40)
    upper, lower = y < 13, y > 9
    masks = [torch.stack([upper, lower]) ^ (torch.rand(2, 24, 40, generator=g) < 0.1) for _ in cameras]
    masks[1] = torch.stack([~upper, torch.zeros_like(lower)])  # another thing, and nothing
    counted = [None, torch.rand(24, 40, generator=g) < 0.7, None]
    found = mask_evidence(scene, cameras, masks, valid_pixels=counted)
    for text in range(2):
        labels = [(~mask[text]).int() for mask in masks]
        labels[1] = labels[1].where(counted[1], -2)
        by_hand = rasterize_evidence(scene, cameras, labels, num_regions=[2] * 3, backend="torch").rows
        e = dense(by_hand, 6).unflatten(1, (3, 2))  # Gaussian, view, in or out
        view_weight = e.sum(dim=2)
        first = torch.tensor([True, text == 0, True])  # found there
        drawn = e[:, first, 0].sum(dim=1) > 0.5 * e[:, first].sum(dim=(1, 2))
        both, either = e[drawn, :, 0].sum(dim=0), e[drawn].sum(dim=(0, 2)) + e[~drawn, :, 0].sum(dim=0)
        there = both > 0.5 * either
        assert there.tolist() == [True, False, True]  # in view 1 text 0 is another thing
        seen, total = view_weight.sum(dim=1) > 0, view_weight.sum(dim=1)
        e = e[:, there]  # view 1 dilutes
        length, vector = e.norm(dim=2).sum(dim=1), e.sum(dim=1).norm(dim=1)
        n_eff = total**2 / (view_weight**2).sum(dim=1)
        answer = found.answer(text)
        close: dict[str, Any] = {"rtol": 1e-9, "atol": 1e-12}
        assert torch.equal(answer.is_visible, seen)
        known = seen & (length > 0)
        assert int(known.sum()) > 20 and bool((answer.relevancy[~known] == 0).all())
        share = e[:, :, 0].sum(dim=1) / e.sum(dim=(1, 2))
        torch.testing.assert_close(answer.relevancy[known], share[known], **close)
        torch.testing.assert_close(answer.scalars.c_inter[known], (vector / length)[known], **close)
        reliability = vector / total * n_eff / (n_eff + 1)
        torch.testing.assert_close(answer.scalars.reliability[known], reliability[known], **close)
        assert answer.voting_views.tolist() == there.tolist()
    mask = torch.zeros(1, 24, 40, dtype=torch.bool)
    with pytest.raises(ValueError, match="lengths 3 and 2"):
        mask_evidence(scene, cameras, [mask, mask])
    with pytest.raises(ValueError, match=r"view 1 .*\(1, 24, 39\), .*\[1, 24, 40\]"):
        mask_evidence(scene, cameras, [mask, mask[:, :, 1:], mask])
