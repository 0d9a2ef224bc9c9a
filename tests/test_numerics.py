"""The hard cases of docs/numerics.md, at a small size: what is on that page holds here too."""

import pytest

from benchmarks.documents import documents
from benchmarks.hard_case import QUANTITIES, Case, Setting
from benchmarks.numerics import CASES, main


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.key)
def test_errors_are_within_their_bounds(case):
    errors = case.measure(Setting(small=True))
    assert case.failures(errors) == []
    for name in ("numerics", "numerics_gpu"):
        values = documents()[name].values
        recorded = {key.split(".")[1]: x for key, x in values.items() if key.split(".")[0] == case.key}
        assert set(recorded) == (set(errors) if len(values) > 0 else set()), (
            "measure again: python -m benchmarks.numerics"
        )
        assert case.failures(recorded) == []


def test_keys_are_distinct_and_what_is_not_a_number_fails():
    assert len({case.key for case in CASES}) == len(CASES)
    case = Case("some", "", "", "", lambda setting: {}, {"direction": 1.0})
    assert case.failures({"direction": 0.5, "scalars": 1e-6, "wrong": 0}) == []
    errors = {"direction": float("nan"), "scalars": 1e-4, "wrong": 1}
    assert [line.split(" ")[1] for line in case.failures(errors)] == list(errors)
    assert all(quantity.bound <= 1e-4 for quantity in QUANTITIES.values())


def test_a_run_that_fails_says_where(monkeypatch, tmp_path):
    case = Case("some", "", "", "", lambda setting: {"wrong": 2})
    monkeypatch.setattr("benchmarks.numerics.CASES", (case,))
    with pytest.raises(SystemExit, match=r"some: wrong 2\.0e\+00, at most 0"):
        main("cpu", tmp_path)
    assert (tmp_path / "numerics.json").exists()
