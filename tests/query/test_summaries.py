"""Summaries of many prompts at once against those of one prompt at a time."""

from dataclasses import replace
from typing import Any

import pytest
import torch

from normlift_ns import SemanticField
from normlift_ns.query.engine import SelectionStats, run_query
from normlift_ns.query.question import Query
from tests.io.test_field import D, example
from tests.random_scenes import unit_rows


@pytest.mark.parametrize("threshold", [-2.0, 0.1, 2.0])
def test_summaries_equal_those_of_one_prompt(threshold: float, monkeypatch: pytest.MonkeyPatch) -> None:
    lifted, means, source = example(3)
    field = SemanticField.build(lifted, means, source)
    question = Query(tuple("abcde"), unit_rows(5, D, 4).float().numpy(), rule="cosine", threshold=threshold)
    answer = run_query(field, means, question)
    answer = replace(answer, verdicts=("probably not here", "found", None, "weak match", "probably not here"))
    monkeypatch.setattr("normlift_ns.query.summaries._BLOCK_ELEMENTS", 2 * len(means))  # three blocks
    for found, finding in zip(answer._summarize(), answer, strict=True):
        ours, theirs = flat(found), flat(finding.to_json())
        numbers = {key: value for key, value in theirs.items() if isinstance(value, float)}
        assert {key: ours[key] for key in numbers} == pytest.approx(numbers, rel=1e-12, abs=1e-12)
        assert {key: ours.get(key) for key in theirs} == {**theirs, **{key: ours[key] for key in numbers}}


def flat(value: Any, name: str = "") -> dict[str, Any]:
    """Return the entries of nested dictionaries and lists."""
    if not isinstance(value, dict | list):
        return {name: value}
    parts = value.items() if isinstance(value, dict) else enumerate(value)
    return {key: entry for part, inner in parts for key, entry in flat(inner, f"{name}.{part}").items()}


def test_selected_gaussians_without_evidence_count_equally():
    means, mask = torch.tensor([[1.0, 0, 2], [5, 5, 5], [3, 2, 0]]), torch.tensor([True, False, True])
    stats = SelectionStats.of(mask, means, torch.tensor([0.2, 0.9, 0.4]), torch.zeros(3))
    assert stats.centroid == pytest.approx([2.0, 1.0, 1.0]) and stats.mean_reliability == pytest.approx(0.3)
    assert stats.fraction == pytest.approx(2 / 3) and stats.extent == pytest.approx([1.8, 1.8, 1.8])
