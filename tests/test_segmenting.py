"""Masks of texts, lifted: against sums by hand in float64, and on a trained capture with masks as SAM 3 gives them."""

import json
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from benchmarks.captures import SHARED, trained_scene, training_cameras, training_indices
from normlift_ns import Camera, GaussianScene, rasterize_evidence
from normlift_ns.segmenting import MaskEvidence, mask_evidence
from tests.captures import needs_shared

MISSING, WRONG, SEED = 0.2, 0.1, 20
"""Shares of an object's views in which SAM 3 finds nothing, and another thing; chosen before any number was seen."""


def small_scene(count: int = 40, seed: int = 0) -> tuple[GaussianScene, list[Camera]]:
    g = torch.Generator().manual_seed(seed)
    means = torch.rand(count, 3, generator=g, dtype=torch.float64) - 0.5
    quats = torch.nn.functional.normalize(torch.randn(count, 4, generator=g, dtype=torch.float64), dim=1)
    scales = 0.03 + 0.1 * torch.rand(count, 3, generator=g, dtype=torch.float64)
    scene = GaussianScene(means, quats, scales, 0.2 + 0.7 * torch.rand(count, generator=g, dtype=torch.float64))
    K = torch.tensor([[30.0, 0, 20], [0, 30, 12], [0, 0, 1]], dtype=torch.float64)
    cameras = []
    for angle in (0.0, 0.9, 2.1):
        turn = torch.eye(4, dtype=torch.float64)
        c, s = np.cos(angle), np.sin(angle)
        turn[:3, :3] = torch.tensor([[c, 0, s], [0, 1, 0], [-s, 0, c]])
        turn[2, 3] = 1.6
        cameras.append(Camera(K, turn, 40, 24))
    return scene, cameras


def test_shares_agreement_and_reliability_are_their_formulas():
    scene, cameras = small_scene()
    g = torch.Generator().manual_seed(1)
    y = torch.arange(24)[:, None].expand(24, 40)
    upper, lower = y < 13, y > 9
    masks = [torch.stack([upper, lower]) ^ (torch.rand(2, 24, 40, generator=g) < 0.1) for _ in cameras]
    masks[1] = torch.stack([~upper, torch.zeros_like(lower)])  # another thing, and nothing
    counted = [None, torch.rand(24, 40, generator=g) < 0.7, None]
    found = mask_evidence(scene, cameras, masks, counted=counted, backend="torch")
    for text in range(2):
        labels = [(~mask[text]).int() for mask in masks]
        labels[1] = labels[1].where(counted[1], -2)
        by_hand = rasterize_evidence(scene, cameras, labels, num_regions=[2] * 3, backend="torch").rows
        dense = torch.zeros(40, 6, dtype=torch.float64)
        dense[by_hand.row_index(), by_hand.column.long()] = by_hand.weight.double()
        e = dense.unflatten(1, (3, 2))  # Gaussian, view, in or out
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
        assert torch.equal(answer.seen, seen)
        known = seen & (length > 0)
        assert int(known.sum()) > 20 and bool((answer.relevancy[~known] == 0).all())
        share = e[:, :, 0].sum(dim=1) / e.sum(dim=(1, 2))
        torch.testing.assert_close(answer.relevancy[known], share[known], **close)
        torch.testing.assert_close(answer.scalars.c_inter[known], (vector / length)[known], **close)
        reliability = vector / total * n_eff / (n_eff + 1)
        torch.testing.assert_close(answer.scalars.reliability[known], reliability[known], **close)
        assert answer.voted.tolist() == there.tolist()
        again = found.answer(text, views=[0, 2])
        torch.testing.assert_close(again.relevancy[known], share[known], **close)
        assert bool((again.scalars.reliability >= answer.scalars.reliability)[known].all())


def test_masks_of_another_size_or_number_are_refused():
    scene, cameras = small_scene()
    mask = torch.zeros(1, 24, 40, dtype=torch.bool)
    with pytest.raises(ValueError, match="one set per camera; got 2 of 3"):
        mask_evidence(scene, cameras, [mask, mask])
    with pytest.raises(ValueError, match=r"masks of view 1 are \(1, 24, 39\), expected \[1, 24, 40\]"):
        mask_evidence(scene, cameras, [mask, mask[:, :, 1:], mask])


def as_sam3(instances: list[torch.Tensor], values: list[int]) -> list[torch.Tensor]:
    """[Q, H, W] per view: the exact mask of every object, of which some are missing, and some those of other things."""
    g = torch.Generator().manual_seed(SEED)
    given = []
    for labels in instances:
        exact = torch.stack([labels == value for value in values])
        there = exact.flatten(1).any(dim=1)
        masks = exact.clone()
        for i in there.nonzero()[:, 0].tolist():
            draw = float(torch.rand((), generator=g))
            others = [k for k in there.nonzero()[:, 0].tolist() if k != i]
            other = others[int(torch.randint(0, len(others), (), generator=g))]
            if draw < MISSING:
                masks[i] = False
            elif draw < MISSING + WRONG:
                masks[i] = exact[other]
        given.append(masks)
    return given


@pytest.mark.slow
@needs_shared
def test_the_lifted_answer_is_better_than_single_views():
    """Masks as SAM 3 gives them (20 % missing, 10 % of another thing), lifted from all views, against the same lift
    from one view alone; both drawn into all views and compared with the exact masks of all of them, in pixels: a pixel
    is drawn by the share of its colour that the selected Gaussians make.

    The reading chosen: a "single view" is what one can know of the scene from one view, that is its mask lifted alone.
    It must answer for all views, as the lifted answer does. In its own picture alone a given mask is exact (IoU 1) in
    seven views of ten by construction, which nothing exceeds and which says nothing of the scene. Views in which the
    object does not appear do not count; those with a missing or a wrong mask do, as a user would meet them. The median
    of those with the exact mask is printed beside. Damage and seed were fixed first; the votes of views were added when
    the plain share over all views had been seen (no worse than the best view for 8 of 12).
    """
    scene, cameras = trained_scene("tabletop"), training_cameras("tabletop")
    folder, half = SHARED / "captures" / "tabletop", torch.tensor([[0.5], [0.5], [1.0]])
    names = {int(k): v for k, v in json.loads((folder / "labels.json").read_text())["labels"].items()}
    files = sorted((folder / "instance").glob("*.png"))
    maps = [torch.from_numpy(np.array(Image.open(files[i])))[::2, ::2].int() for i in training_indices("tabletop")]
    small = [Camera(c.K * half, c.world_to_camera, c.width // 2, c.height // 2) for c in cameras]
    exact = [torch.stack([labels == value for value in names]) for labels in maps]
    masks = as_sam3(maps, list(names))
    both = mask_evidence(scene, small, [torch.cat(pair) for pair in zip(masks, exact)])  # rasterized once
    found, object_of = MaskEvidence(both.evidence, both.inside[: len(names)]), both.inside[len(names) :]
    rows = both.evidence.rows
    column, owner, weight = rows.column.long(), rows.row_index(), rows.weight.double()
    total = torch.zeros(len(scene), dtype=torch.float64).index_add(0, owner, weight)

    def held_by(text: int) -> torch.Tensor:
        within = object_of[text][column]
        return torch.zeros_like(total).index_add(0, owner[within], weight[within])

    def iou(chosen: torch.Tensor, held: torch.Tensor) -> float:
        return float(held[chosen].sum() / (held.sum() + (total - held)[chosen].sum()))

    better = not_worse = 0
    for text, name in enumerate(names.values()):
        held = held_by(text)
        lifted = iou(found.answer(text).mask, held)
        views = [v for v, part in enumerate(exact) if bool(part[text].any())]
        share = _single_shares(found, text)
        single = np.array([iou(share[v] > 0.5, held) for v in views])
        intact = np.array([torch.equal(masks[v][text], exact[v][text]) for v in views])
        median, of_intact, best = float(np.median(single)), float(np.median(single[intact])), float(single.max())
        print(f"{name:>22}: lifted {lifted:.3f}; single views: median {median:.3f}, with exact masks {of_intact:.3f}, "
              f"best {best:.3f} ({intact.sum()} of {len(views)} exact)")  # fmt: skip
        better += lifted >= median + 0.05
        not_worse += lifted >= best
    assert torch.allclose(_single_shares(found, 4)[3], found.answer(4, views=[3]).relevancy, atol=1e-6)
    print(f"better by 5 points: {better} of 12; no worse than the best view: {not_worse} of 12")
    assert len(names) == 12 and better == 12 and not_worse >= 10


def _single_shares(found: MaskEvidence, text: int) -> torch.Tensor:
    """[V, N]: the relevancy that `answer` gives for every view alone, all at once."""
    rows, inside = found.evidence.rows, found.inside[text]
    column = rows.column.long()
    place = found.evidence.region_view[column].long() * len(rows) + rows.row_index()
    total, held = torch.zeros(2, found.evidence.num_views * len(rows), dtype=torch.float64)
    total.index_add_(0, place, rows.weight.double())
    held.index_add_(0, place, rows.weight.double() * inside[column])
    return torch.where(total > 0, held / total, 0.0).reshape(-1, len(rows)).to(rows.weight.dtype)
