"""Products of regions and row maxima on the GPU against dense ones, and a consensus by kernels against the CPU's."""

import pytest
import torch

from normlift_ns.core import consensus as module
from normlift_ns.core.consensus import consensus, region_overlaps
from normlift_ns.core.sparse import SparseRows
from normlift_ns.kernels import sparse
from tests.random_scenes import dense, generator, random_evidence, unit_rows

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"


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
