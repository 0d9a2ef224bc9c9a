"""Figures of the studies."""

from __future__ import annotations


def test_names_in_figures_are_no_mathematics(tmp_path):
    from normlift_ns.evaluation.plots import plot_sweeps  # noqa: PLC0415

    rows = [{"parameter": "$\\frac{$", "value": x, "$\\frac{$": x} for x in (1.0, 2.0)]
    plot_sweeps(rows, "$\\frac{$", "$\\frac{$", tmp_path / "a.svg")
    assert (tmp_path / "a.svg").stat().st_size > 1000


def test_sweeps_mark_the_default_and_the_run_and_draw_the_result():
    from normlift_ns.evaluation.plots import sweeps_figure  # noqa: PLC0415

    values = [("k", 12.0, False, True, 0.4), ("k", 36.0, True, False, 0.5), ("beta", 1.0, True, True, 0.4)]
    rows = [{"parameter": p, "value": v, "default": d, "own": o, "miou": y} for p, v, d, o, y in values]
    of_k, of_beta = sweeps_figure(rows[::-1], "miou", "miou", 0.45).axes[::-1]
    assert [x.get_xlabel() for x in (of_k, of_beta)] == ["k", "beta"]
    curve, default, own, result = of_k.lines
    assert (list(curve.get_xdata()), list(curve.get_ydata())) == ([0, 1], [0.4, 0.5])
    assert [x.get_text() for x in of_k.get_xticklabels()] == ["12", "36"]
    assert (list(default.get_xdata()), list(default.get_ydata())) == ([1], [0.5])
    assert (list(own.get_xdata()), list(own.get_ydata())) == ([0], [0.4])
    assert list(result.get_ydata()) == [0.45, 0.45]
    assert {x.get_text() for x in of_beta.get_legend().get_texts()} == {"default", "of the run", "result"}


def test_every_scene_has_its_signals_drawn():
    from normlift_ns.evaluation.plots import signals_figure  # noqa: PLC0415

    one = {"zero.share": 0.5, "histogram.0.00": 0.2, "histogram.0.50": 0.3}
    rows = [{"scene": "a$", **one, "reliability.bin1": 0.1, "reliability.bin2": 0.9}, {"scene": "b", **one}]
    figure = signals_figure(rows)
    assert len(figure.axes) == 4
    assert [axes.get_title() for axes in figure.axes[::2]] == ["a$", "b"]
    assert list(figure.axes[0].lines[0].get_ydata()) == [10, 90]
    assert len(figure.axes[2].lines) == 0
    assert [bar.get_height() for bar in figure.axes[3].patches] == [20, 30, 50]
