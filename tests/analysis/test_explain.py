"""Votes for a selection against sums in float64, and identities that they keep."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from normlift_ns import Evidence, InputError
from normlift_ns.analysis.explain import Why, draw_outlines, explain_selection
from normlift_ns.core.evidence import Entries
from tests.examples import examples
from tests.random_scenes import generator, unit_rows

N, D = 30, 5
COUNTS = (3, 0, 4, 1)
"""Regions of the photographs; one has none."""


def votes(seed: int) -> tuple[Evidence, torch.Tensor, np.ndarray]:
    """Evidence, features in float64, and the evidence as a dense matrix."""
    g = generator(seed)
    columns = sum(COUNTS) + len(COUNTS)
    dense = torch.rand(N, columns, generator=g) * (torch.rand(N, columns, generator=g) < 0.4)
    row, column = dense.nonzero(as_tuple=True)
    evidence = Evidence.from_entries([Entries(row, column, dense[row, column], COUNTS)], N)
    starts = np.cumsum([0, *(count + 1 for count in COUNTS)])[:-1]
    regions = [start + 1 + i for start, count in zip(starts, COUNTS) for i in range(count)]
    return evidence, unit_rows(sum(COUNTS), D, seed + 1), dense.double().numpy()[:, regions]


@examples(15)
@given(seed=st.integers(0, 500), share=st.floats(0.05, 1.0), copies=st.booleans())
def test_votes_are_the_sums_that_the_module_says(seed, share, copies):
    evidence, features, dense = votes(seed)
    g = generator(seed + 2)
    selected = torch.rand(N, generator=g) < share
    selected[0] = True
    source = torch.randint(0, N, (N,), generator=g) if copies else None
    why = explain_selection(evidence, features, selected, source=source)
    rows = np.flatnonzero(selected) if source is None else source.numpy()[np.flatnonzero(selected)]
    weight, table = dense[rows].sum(0), features.double().numpy()
    view = np.repeat(np.arange(len(COUNTS)), COUNTS)
    says = np.stack([(weight[view == v, None] * table[view == v]).sum(0) for v in range(len(COUNTS))])
    of_view = np.array([weight[view == v].sum() for v in range(len(COUNTS))])
    length = np.linalg.norm(says, axis=1)
    assert why.gaussians == int(selected.sum())
    unit = torch.nn.functional.normalize(torch.as_tensor(dense) @ torch.as_tensor(table), dim=1).numpy()
    cosine = (unit[rows] * unit[np.flatnonzero(selected)]).sum(1)[rows != np.flatnonzero(selected)]
    assert abs(cosine - 0.98).min(initial=1) < 1e-6 or why.changed == (cosine < 0.98).sum() / why.gaussians
    heaviest, others = why.images_to_show(2)
    assert heaviest == why.views[:2] and set(others) == {x for x in why.views[2:] if x in others}
    assert all(one.agreement < 0.9 for one in others)
    assert len(others) == min(2, sum(one.agreement < 0.9 for one in why.views[2:]))
    assert why.copied == (rows != np.flatnonzero(selected)).sum()
    if weight.sum() == 0:
        assert why.views == ()
        assert why.words and not any(letter.isdigit() for letter in why.words)
        return
    total = says.sum(0)
    assert why.c_inter == pytest.approx(np.linalg.norm(total) / length.sum(), abs=1e-5)
    assert why.n_eff == pytest.approx(weight.sum() ** 2 / (of_view**2).sum(), rel=1e-5)
    assert [vote.view for vote in why.views] == [int(v) for v in np.argsort(-of_view, kind="stable") if of_view[v] > 0]
    for vote in why.views:
        v = vote.view
        assert vote.weight == pytest.approx(of_view[v], rel=1e-6)
        assert vote.agreement == pytest.approx(says[v] @ total / length[v] / np.linalg.norm(total), abs=1e-6)
        for one in vote.regions:
            column = sum(COUNTS[:v]) + one.region
            assert one.weight == pytest.approx(weight[column], rel=1e-6)
            assert one.agreement == pytest.approx(table[column] @ total / np.linalg.norm(total), abs=1e-6)
        assert sum(one.share for one in vote.regions) > 0.9 - 1e-9
    assert sum(vote.share for vote in why.views) == pytest.approx(1)
    lost = sum(length[vote.view] * (1 - vote.agreement) for vote in why.views) / length.sum()
    assert lost == pytest.approx(1 - why.c_inter, abs=1e-5)  # the disagreement is a sum over photographs
    if lost > 1e-4:
        assert sum(vote.disagreement for vote in why.views) == pytest.approx(1)
        for vote in why.most_different:
            expected = length[vote.view] * (1 - vote.agreement) / length.sum() / lost
            assert vote.disagreement == pytest.approx(expected, abs=1e-3)


def test_unlabelled_pixels_dilute_where_they_did_in_the_lift():
    evidence, features, _ = votes(5)
    every = torch.ones(N, dtype=torch.bool)
    plain, diluted = (explain_selection(evidence, features, every, unlabeled=x) for x in ("ignore", "dilute"))
    blank, weight = float(evidence.unlabeled.weight.sum()), float(evidence.rows.weight.sum())
    assert diluted.norm == pytest.approx(plain.norm * weight / (weight + blank), rel=1e-5)
    assert diluted.c_inter == pytest.approx(plain.c_inter, abs=1e-6)


def test_agreement_in_words():
    def level(c_inter: float) -> str:
        words = Why(1, 0, 0.5, 0.5, c_inter, 5.04, 0.5, ()).words
        assert f"{c_inter:.2f}" in words and "5.0" in words
        return words.replace(f"{c_inter:.2f}", "")

    levels = [level(c_inter) for c_inter in (1.0, 0.95, 0.949, 0.85, 0.849, 0.6, 0.599, 0.0)]
    assert levels[::2] == levels[1::2] and len(set(levels)) == 4
    one, more = (Why(1, 0, 0.5, 0.5, 1.0, n_eff, 0.5, ()).words for n_eff in (1.04, 1.06))
    assert "1.1" in more and "1.0 " not in one  # a single one is no number
    assert "25%" in Why(4, 0.25, 0.5, 0.5, 1.0, 2.0, 0.5, ()).sentence
    entries = Entries(torch.tensor([0, 0]), torch.tensor([1, 2]), torch.tensor([0.3, 0.7]), (2,))
    evidence = Evidence.from_entries([entries], 1)
    alone = explain_selection(evidence, torch.tensor([[0.6, 0.8], [1.0, 0.0]]), torch.ones(1, dtype=torch.bool))
    assert "one image" in alone.words and "1.00" not in alone.words  # it agrees with nobody
    assert alone.most_different == () and alone.c_inter == pytest.approx(1)
    assert alone.to_json()["views"][0]["regions"][0]["weight"] == pytest.approx(0.7)


def test_selections_of_nothing_or_of_another_shape(unchecked):
    evidence, features, _ = votes(0)
    every = torch.ones(N, dtype=torch.bool)
    for wrong, hint in ((~every, "nothing is selected"), (every[1:], "30 booleans"), (every.float(), "30 booleans")):
        with pytest.raises(InputError, match=hint):
            explain_selection(evidence, features, wrong)


def test_an_outline_lies_within_and_around_its_region():
    image = torch.full((200, 640, 3), 100, dtype=torch.uint8)
    masks = torch.zeros(2, 200, 640, dtype=torch.bool)
    masks[0, 50:100, 100:300] = True
    masks[1, 150:, :50] = True  # reaches the border of the picture
    shown = draw_outlines(image, masks)
    line = (shown == torch.tensor([255, 176, 0], dtype=torch.uint8)).all(dim=2)
    assert bool(masks.any(0)[line].all())
    assert line[50:52, 100:300].all() and not line[52:98, 102:298].any()  # two pixels wide at 640
    assert line[198:, :50].all()
    assert (shown[75, 200] == 100).all() and (shown[10, 10] == 45).all()
    assert torch.equal(draw_outlines(image, masks[:0]), torch.full_like(image, 45))
