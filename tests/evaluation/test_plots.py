"""Figures of the studies."""

from __future__ import annotations

from normlift_ns.evaluation.plots import plot_sweeps


def test_names_in_figures_are_no_mathematics(tmp_path):
    rows = [{"parameter": "$\\frac{$", "value": x, "$\\frac{$": x} for x in (1.0, 2.0)]
    plot_sweeps(rows, "$\\frac{$", "$\\frac{$", tmp_path / "a.svg")
    assert (tmp_path / "a.svg").stat().st_size > 1000
