"""Sums, products and maxima of sparse rows on the GPU against those of the CPU, where digits cancel too."""

import pytest
import torch

from normlift_ns import Evidence, lift
from normlift_ns.core import consensus as module
from normlift_ns.core.consensus import consensus, region_overlaps
from normlift_ns.core.lift import _sums
from normlift_ns.core.sparse import CANCELLATION_RATIO, MANY_ENTRIES, SparseRows, segment_sum
from normlift_ns.kernels import sparse
from tests.random_scenes import dense, generator, random_evidence, unit_rows

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"


def on_device(*tensors):
    return [x.to(DEVICE) for x in tensors]


def test_segments_and_products_with_a_vector_are_added_in_float64():
    values = 10 ** (18 * torch.rand(500, generator=generator(0)) - 12)
    offsets = torch.tensor([0, 0, 1, 4, 4, 200, 500, 500])
    found = sparse.segment_sum(*on_device(values, offsets)).cpu()
    assert torch.allclose(found, segment_sum(values, offsets), rtol=1e-15, atol=0)
    assert found[0] == found[3] == found[6] == 0
    evidence = random_evidence(300, [3, 4], 1, dtype=torch.float32)
    vector = torch.randn(7, generator=generator(1), dtype=torch.float64)
    found = sparse.multiply_vector(
        *on_device(evidence.rows.offsets, evidence.rows.column, evidence.rows.weight, vector)
    ).cpu()
    expected = evidence.rows.matmul(vector[:, None]).squeeze(1)
    assert torch.allclose(found, expected, rtol=1e-12, atol=1e-12)


def kernel_norms(evidence, table, ratio=CANCELLATION_RATIO, many=MANY_ENTRIES):
    rows = evidence.rows
    arrays = on_device(rows.offsets, rows.column, rows.weight, evidence.region_view, table)
    return [x.cpu() for x in sparse.row_norms(*arrays, ratio, many)]


def test_cancelled_sums_are_right():
    """Opposite vectors within a view, and between views, leave 1e-6 of the weight: float32 has no digit of it."""
    table = torch.eye(1, 8)
    table = torch.cat([table, -table, table, -table])
    offsets, region = torch.tensor([0, 4, 6]), torch.tensor([0, 1, 2, 3, 0, 3], dtype=torch.int32)
    weight = torch.tensor([1.0, 1 - 2**-20, 3.0, 3 - 2**-20, 5.0, 5 - 2**-19])
    view = torch.tensor([0, 0, 1, 1], dtype=torch.int32)
    empty = SparseRows(torch.zeros(3, dtype=torch.int64), torch.zeros(0, dtype=torch.int32), torch.zeros(0))
    evidence = Evidence(SparseRows(offsets, region, weight), view, empty, 2)
    total, by_view, *_ = kernel_norms(evidence, table)
    exact = weight.double()
    within = [exact[0] - exact[1], exact[2] - exact[3]]
    assert torch.allclose(total, torch.stack([sum(within), exact[4] - exact[5]]), rtol=1e-12)
    assert torch.allclose(by_view, torch.stack([sum(within), exact[4] + exact[5]]), rtol=1e-12)
    arrays = on_device(torch.arange(2), offsets, region, weight, table, torch.ones(2))
    found = sparse.unit_sums(*arrays, torch.float32, CANCELLATION_RATIO, MANY_ENTRIES).cpu()
    assert torch.equal(found, torch.eye(1, 8).expand(2, -1))


def test_sums_of_many_entries_are_taken_in_float64():
    evidence, table = random_evidence(3, [40, 40], 8, dtype=torch.float32), unit_rows(80, 16, 2, torch.float32)
    rows, exact = evidence.rows, _sums(evidence, table.double())
    for ours, theirs in zip(kernel_norms(evidence, table, 0.0, 2), exact):
        assert torch.allclose(ours.double(), theirs.double(), rtol=1e-12, atol=0)
    single, *_ = kernel_norms(evidence, table, 0.0, 1000)
    assert (single - exact[0]).abs().max() > 1e-9 * exact[0].max()
    arrays = on_device(torch.arange(3), rows.offsets, rows.column, rows.weight, table, torch.ones(3))
    units = sparse.unit_sums(*arrays, torch.float32, 0.0, 10).cpu()
    sums_of_rows = rows.matmul(table.double())
    expected = sums_of_rows / sums_of_rows.norm(dim=1, keepdim=True)
    assert torch.equal(units, expected.float())


def test_norms_and_directions_equal_those_of_the_cpu():
    evidence = random_evidence(30, [3, 0, 4], 5, dtype=torch.float32)
    lifted = lift(evidence, unit_rows(7, 20, 6, torch.float32))
    expected = _sums(evidence, lifted.features)
    for ours, theirs in zip(kernel_norms(evidence, lifted.features), expected):
        assert torch.allclose(ours.double(), theirs.double(), rtol=2e-6, atol=0)
    rows = torch.randperm(30, generator=generator(7))
    given = evidence.rows
    arrays = on_device(rows, given.offsets, given.column, given.weight, lifted.features, lifted.scalars.norm)
    for dtype, close in ((torch.float32, 2e-7), (torch.float16, 5e-4)):
        found = torch.empty(30, 20, dtype=dtype)
        found[rows] = sparse.unit_sums(*arrays, dtype, CANCELLATION_RATIO, MANY_ENTRIES).cpu()
        assert torch.allclose(found.float(), lifted.directions(), atol=close)
        assert not found[lifted.scalars.norm == 0].any()
        assert torch.equal(lifted.directions(dtype=dtype), lifted.directions().to(dtype))


def transposed(rows: SparseRows, columns: int) -> SparseRows:
    return SparseRows.from_coo(rows.column.long(), rows.row_index().int(), rows.weight, columns)


def test_products_are_rows_of_the_square():
    rows = random_evidence(4, [130, 3, 20], 1, dtype=torch.float32).rows
    assert rows.offsets.diff().max() > sparse._WIDTH  # longer than what is added at a time
    matrix = dense(rows, 153).double()
    turned, rows = transposed(rows, 153).to(DEVICE), rows.to(DEVICE)
    for first, last in ((0, 20), (5, 6), (140, 153)):
        found = sparse.multiply_rows(turned, rows, 153, first, last)
        assert torch.allclose(found.cpu().double(), (matrix.T @ matrix)[first:last], rtol=1e-5, atol=1e-6)
    assert torch.equal(found, sparse.multiply_rows(turned, rows, 153, first, last))


def test_row_maxima():
    rows = random_evidence(150, [3, 4], 2, dtype=torch.float32).rows.to(DEVICE)
    value = torch.rand(7, generator=generator(0), dtype=torch.float64).to(DEVICE)
    found = sparse.row_max(rows.offsets, rows.column, value)
    there = torch.zeros(150, 7, dtype=torch.bool, device=DEVICE)
    there[rows.row_index(), rows.column.long()] = True
    assert torch.equal(found, torch.where(there, value, 0.0).amax(dim=1))


def test_consensus_by_kernels_equals_that_of_the_cpu(monkeypatch):
    given, features = random_evidence(20, [4, 0, 5, 3], 3), unit_rows(12, 8, 3)
    expected = consensus(given, features, least=0.0)
    iou = dense(region_overlaps(given.rows, given.region_view).iou, 12)
    monkeypatch.setattr(module, "can_use_triton", lambda tensor: True)
    evidence = given.to(DEVICE)
    for block in (2**26, 50):
        monkeypatch.setattr(module, "_MAX_DENSE", block)
        found = consensus(evidence, features.to(DEVICE), least=0.0)
        assert torch.allclose(found.features.cpu(), expected.features, atol=1e-6)
        assert found.agreement == pytest.approx(expected.agreement, abs=1e-6)
        again = dense(region_overlaps(evidence.rows, evidence.region_view).iou, 12)
        assert torch.allclose(again.cpu(), iou, atol=1e-6)
        assert torch.equal(again, again.T)
