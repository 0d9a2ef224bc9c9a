"""The recorded errors of docs/numerics.md are within their bounds."""

import pytest

from research.documents import documents
from research.hard_case import QUANTITIES, Case, Setting
from research.numerics import CASES, main


def test_recorded_errors_are_those_of_the_cases_and_within_their_bounds():
    assert len({case.key for case in CASES}) == len(CASES)
    for case in CASES:
        errors = case.measure(Setting(small=True))
        for name in ("numerics", "numerics_gpu"):
            values = documents()[name].values
            recorded = {key.split(".")[1]: x for key, x in values.items() if key.split(".")[0] == case.key}
            assert set(recorded) == (set(errors) if len(values) > 0 else set()), case.key  # else measure again
            assert case.failures(recorded) == []


def test_what_is_not_a_number_fails_and_a_run_that_fails_says_where(monkeypatch, tmp_path):
    case = Case("some", "", "", "", lambda setting: {}, {"direction": 1.0})
    assert case.failures({"direction": 0.5, "scalars": 1e-6, "wrong": 0}) == []
    errors = {"direction": float("nan"), "scalars": 1e-4, "wrong": 1}
    assert [line.split(" ")[1] for line in case.failures(errors)] == list(errors)
    assert all(quantity.bound <= 1e-4 for quantity in QUANTITIES.values())
    monkeypatch.setattr("research.numerics.CASES", (Case("some", "", "", "", lambda setting: {"wrong": 2}),))
    with pytest.raises(SystemExit, match=r"some: wrong 2\.0e\+00, at most 0"):
        main("cpu", tmp_path)
    assert (tmp_path / "numerics.json").exists()
