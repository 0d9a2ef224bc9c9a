"""Joining the entries of views: by sorting, as on a GPU, and by putting every entry to its place."""

import torch
from hypothesis import given
from hypothesis import strategies as st

from normlift_ns.core.evidence import Entries, Evidence, _joined, _joined_by_sorting


@st.composite
def parts_of_a_scene(draw):
    gaussians, parts = draw(st.integers(1, 9)), []
    for _ in range(draw(st.integers(1, 4))):
        counts = tuple(draw(st.lists(st.integers(0, 3), min_size=1, max_size=3)))
        columns = sum(counts) + len(counts)
        place = sorted(draw(st.sets(st.integers(0, gaussians * columns - 1), max_size=20)))
        row, column = (torch.tensor(x, dtype=torch.int32) for x in ([p // columns for p in place],
                                                                    [p % columns for p in place]))  # fmt: skip
        parts.append(Entries(row, column, torch.arange(1.0, len(place) + 1), counts))
    return gaussians, parts


@given(parts_of_a_scene())
def test_both_ways_to_join_give_the_same_matrices(case):
    gaussians, parts = case
    device = torch.device("cpu")
    for ours, theirs in zip(_joined_by_sorting(parts, gaussians, device), _joined(parts, gaussians, device)):
        for name in ("offsets", "column", "weight"):
            assert torch.equal(getattr(ours, name), getattr(theirs, name))
            assert getattr(ours, name).dtype == getattr(theirs, name).dtype
    evidence = Evidence.from_entries(parts, gaussians)
    counts = [count for part in parts for count in part.num_regions]
    assert evidence.region_view.tolist() == [v for v, count in enumerate(counts) for _ in range(count)]
    total = sum(float(part.weight.sum()) for part in parts)
    assert float(evidence.rows.weight.sum() + evidence.unlabeled.weight.sum()) == total


def test_no_view_at_all():
    evidence = Evidence.from_entries([], 3)
    assert evidence.rows.row_sums().tolist() == [0.0, 0.0, 0.0]
    assert evidence.region_view.dtype == torch.int32
