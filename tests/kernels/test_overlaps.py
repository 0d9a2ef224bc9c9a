"""Products of regions and row maxima on the GPU against dense ones, and a consensus by kernels against the CPU's."""

import pytest
import torch

from normlift_ns.core import consensus as module
from normlift_ns.core.consensus import consensus, region_overlaps
from normlift_ns.core.sparse import SparseRows
from normlift_ns.kernels import overlaps
from tests.scenes import dense, generator, random_evidence, unit_rows

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"


def transposed(rows: SparseRows, columns: int) -> SparseRows:
    return SparseRows.from_coo(rows.column.long(), rows.row_index().int(), rows.weight, columns)


def test_products_are_rows_of_the_square():
    rows = random_evidence(12, [130, 3, 40], 1, dtype=torch.float32).rows
    assert rows.offsets.diff().max() > overlaps._WIDTH  # longer than what is added at a time
    matrix = dense(rows, 173).double()
    turned, rows = transposed(rows, 173).to(DEVICE), rows.to(DEVICE)
    for first, last in ((0, 173), (5, 6), (160, 173)):
        found = overlaps.products(turned, rows, 173, first, last)
        assert torch.allclose(found.cpu().double(), (matrix.T @ matrix)[first:last], rtol=1e-5, atol=1e-6)
    assert torch.equal(found, overlaps.products(turned, rows, 173, first, last))


def test_row_maxima():
    rows = random_evidence(300, [3, 4], 2, dtype=torch.float32).rows.to(DEVICE)
    value = torch.rand(7, generator=generator(0), dtype=torch.float64).to(DEVICE)
    found = overlaps.row_max(rows.offsets, rows.column, value)
    there = torch.zeros(300, 7, dtype=torch.bool, device=DEVICE)
    there[rows.row_index(), rows.column.long()] = True
    assert torch.equal(found, torch.where(there, value, 0.0).amax(dim=1))


@pytest.mark.parametrize("block", [2**26, 100])
def test_consensus_by_kernels_equals_that_of_the_cpu(monkeypatch, block):
    evidence = random_evidence(40, [5, 0, 7, 4, 6], 3)
    features = unit_rows(22, 8, 3)
    expected = consensus(evidence, features, least=0.0)
    iou = dense(region_overlaps(evidence.rows, evidence.region_view).iou, 22)
    monkeypatch.setattr(module, "kernels_apply", lambda tensor: True)
    monkeypatch.setattr(module, "_DENSE", block)
    evidence, features = evidence.to(DEVICE), features.to(DEVICE)
    found = consensus(evidence, features, least=0.0)
    assert torch.allclose(found.features.cpu(), expected.features, atol=1e-6)
    assert found.agreement == pytest.approx(expected.agreement, abs=1e-6)
    again = dense(region_overlaps(evidence.rows, evidence.region_view).iou, 22)
    assert torch.allclose(again.cpu(), iou, atol=1e-6)
    assert torch.equal(again, again.T)
