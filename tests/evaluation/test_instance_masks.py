"""Truth of Gaussians from masks, names and figures of protocol masks; results on disk."""

import json
import math

import pytest
import torch

from normlift_ns import Evidence
from normlift_ns.core.sparse import SparseRows
from normlift_ns.evaluation.options import Evaluation, write_evaluation
from normlift_ns.evaluation.protocols import evaluate_masks, gaussian_truth


def test_truth_needs_purity_and_weight():
    # columns: class 0 and 1 of view 0, class 0 and 1 of view 1
    weight = torch.tensor([[3.0, 0.2, 1.0, 0.0], [1.0, 1.0, 0.0, 0.0], [0.0, 0.5, 0.0, 0.0], [0.0, 3.0, 0.0, 0.0]])
    row, column = weight.nonzero(as_tuple=True)
    rows = SparseRows.from_coo(row, column, weight[row, column], 4)
    blank = SparseRows.from_coo(torch.tensor([3]), torch.tensor([1]), torch.tensor([2.0]), 4)
    evidence = Evidence(rows, torch.tensor([0, 0, 1, 1]).int(), blank, 2)
    assert gaussian_truth(evidence, 2).tolist() == [0, -1, -1, -1]  # pure; mixed; too light; mostly background
    assert gaussian_truth(evidence, 2, min_weight=0.1, purity=0.5).tolist() == [0, 0, 1, 1]


def test_figures_by_hand(tmp_path):
    truth, found = torch.tensor([0, 0, 1, -1]), torch.tensor([0, -1, 1, 0])
    image = torch.tensor([[0, 1], [1, -1]])
    weight = torch.tensor([1.0, 0, 1, 1])
    evaluation = evaluate_masks(["a", "b"], truth, found, [(image, torch.zeros_like(image))], weight, {})
    results = evaluation.results
    assert (results["miou_3d"], results["accuracy_3d"]) == ((1 / 2 + 1) / 2, pytest.approx(2 / 3))
    assert (results["miou_2d"], results["macc_2d"]) == ((1 / 3 + 0) / 2, 1 / 2)
    assert (results["zero_evidence_share"], results["gaussians_with_truth_share"]) == (0.25, 0.75)
    assert evaluation.rows[0]["gaussians"] == 2

    with_gap = Evaluation({**results, "none": math.nan}, evaluation.rows, evaluation.settings)
    write_evaluation(tmp_path / "o" / "out.json", with_gap, [("e", "c")])
    document = json.loads((tmp_path / "o" / "out.json").read_text())
    assert list(document)[:4] == ["experiment_name", "method_name", "checkpoint", "results"]  # as ns-eval
    assert document["results"]["none"] is None
    assert document["settings"] == {"protocol": "masks"}
