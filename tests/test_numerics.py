"""The hard cases of docs/numerics.md at a small size: float32 and float64 keep their digits in all of them."""


def test_errors_are_within_their_bounds():
    from research.hard_case import Setting  # noqa: PLC0415
    from research.numerics import CASES  # noqa: PLC0415

    assert [line for case in CASES for line in case.failures(case.measure(Setting(small=True)))] == []
