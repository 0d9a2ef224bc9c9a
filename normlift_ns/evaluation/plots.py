"""Figures of the studies: curves of every parameter, and R beside accuracy."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure

from normlift_ns.core.files import new_file


def plot_sweeps(
    rows: Sequence[Mapping[str, Any]],
    metric: str,
    label: str,
    path: Path,
    *,
    result: float | None = None,
    overwrite: bool = False,
) -> None:
    """Writes `sweeps_figure`.

    Args:
        overwrite: replace a file of that name.
    """
    _save(sweeps_figure(rows, metric, label, result), path, overwrite)


def sweeps_figure(rows: Sequence[Mapping[str, Any]], metric: str, label: str, result: float | None = None) -> Figure:
    """One panel per parameter of `votes.SWEEPS`, the metric over its values, those of the run and the default marked.

    Args:
        rows: with parameter, value, the metric and, where they are marked, default and own.
        label: of the metric's axis.
        result: main result of the run, a line across all panels.
    """
    parameters = list(dict.fromkeys(row["parameter"] for row in rows))
    figure, axes = _figure((2 * (len(parameters) + 1), 5), 2, -(-len(parameters) // 2), sharey=True)
    for one, parameter in zip(axes, parameters):
        some = sorted((row for row in rows if row["parameter"] == parameter), key=lambda row: row["value"])
        values = [row[metric] for row in some]
        one.plot(range(len(some)), values, marker="o", markersize=4)
        one.set_xticks(range(len(some)), [f"{row['value']:g}" for row in some])
        for mark, style in _MARKS.items():
            chosen = [i for i, row in enumerate(some) if row.get(mark)]
            if len(chosen) > 0:
                one.plot(chosen, [values[i] for i in chosen], linestyle="none", **style)
        if result is not None:
            one.axhline(result, color="tab:grey", linestyle="--", label="result")
        one.set_xlabel(parameter, parse_math=False)
        one.grid(alpha=0.3)
    axes[0].set_ylabel(label, parse_math=False)
    if len(axes[0].get_legend_handles_labels()[0]) > 0:
        axes[0].legend(fontsize="small")
    return figure


_MARKS: dict[str, dict[str, Any]] = {
    "default": {"marker": "D", "color": "tab:orange", "label": "default"},
    "own": {"marker": "o", "color": "black", "markerfacecolor": "none", "markersize": 11, "label": "of the run"},
}


def plot_signals(rows: Sequence[Mapping[str, Any]], path: Path, *, overwrite: bool = False) -> None:
    """Writes `signals_figure`.

    Args:
        overwrite: replace a file of that name.
    """
    _save(signals_figure(rows), path, overwrite)


def signals_figure(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """A line of panels per row of the study, that is per scene: accuracy of unrefined answers in tenths by R and by
    ||f||, where there is a truth, and the histogram of R with R = 0 apart.
    """
    figure, axes = _figure((9, 3.5 * len(rows)), len(rows), 2)
    for found, curves, histogram in zip(rows, axes[::2], axes[1::2]):
        for name, label in (("reliability", "R"), ("norm", "||f||")):
            bins = [100 * x for key, x in found.items() if key.startswith(f"{name}.bin")]
            if len(bins) > 0:
                curves.plot(range(1, len(bins) + 1), bins, marker="o", label=f"by {label}")
        curves.set_title(found.get("scene", ""), parse_math=False)
        curves.set_xlabel("tenth of the Gaussians, ascending")
        curves.set_ylabel("accuracy, unrefined, %")
        counts = {float(k.removeprefix("histogram.")): 100 * x for k, x in found.items() if k.startswith("histogram.")}
        width = 1 / len(counts)
        histogram.bar(list(counts), list(counts.values()), width=width, align="edge", label="R > 0")
        histogram.bar([-2 * width], [100 * found["zero.share"]], width=width, color="tab:red", label="R = 0")
        histogram.set_xlabel("R")
        histogram.set_ylabel("Gaussians, %")
        for one in (curves, histogram):
            one.grid(axis="y", alpha=0.3)
            if len(one.get_legend_handles_labels()[0]) > 0:
                one.legend()
    return figure


def _figure(size: tuple[float, float], rows: int, columns: int, **options: Any) -> tuple[Figure, list[Any]]:
    mpl.rcParams["svg.hashsalt"] = "normlift"  # the same file for the same figures
    figure = Figure(figsize=size, layout="constrained")
    return figure, list(figure.subplots(rows, columns, squeeze=False, **options).flat)


def _save(figure: Figure, path: Path, overwrite: bool) -> None:
    with new_file(path, overwrite=overwrite) as draft:
        figure.savefig(draft, metadata={"Date": None} if path.suffix == ".svg" else None)
