"""The hard cases of docs/numerics.md at a small size: float32 and float64 keep their digits in all of them."""

from benchmarks.hard_case import Setting
from benchmarks.numerics import CASES


def test_errors_are_within_their_bounds():
    assert [line for case in CASES for line in case.failures(case.measure(Setting(small=True)))] == []
