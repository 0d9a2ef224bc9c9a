"""Figures of the studies: a curve for every parameter, and R with accuracy."""

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
    """Write the figure of `sweeps_figure`.

    Args:
        overwrite: replace a file of that name.
    """
    _save(sweeps_figure(rows, metric, label, result), path, overwrite)


def sweeps_figure(rows: Sequence[Mapping[str, Any]], metric: str, label: str, result: float | None = None) -> Figure:
    """Plot the metric against each parameter of `votes.SWEEPS`, one panel each, with the run's values and the default
    marked.

    Args:
        rows: rows with parameter, value and metric; `default` and `own` mark values.
        label: label of the metric's axis.
        result: main result of the run, drawn as a line across all panels.
    """
    parameters = list(dict.fromkeys(row["parameter"] for row in rows))
    figure, axes = _figure((2 * (len(parameters) + 1), 5), 2, -(-len(parameters) // 2), sharey=True)
    for panel, parameter in zip(axes, parameters):
        points = sorted((row for row in rows if row["parameter"] == parameter), key=lambda row: row["value"])
        values = [row[metric] for row in points]
        panel.plot(range(len(points)), values, marker="o", markersize=4)
        panel.set_xticks(range(len(points)), [f"{row['value']:g}" for row in points])
        for mark, style in _MARKS.items():
            marked = [i for i, row in enumerate(points) if row.get(mark)]
            if len(marked) > 0:
                panel.plot(marked, [values[i] for i in marked], linestyle="none", **style)
        if result is not None:
            panel.axhline(result, color="tab:gray", linestyle="--", label="result")
        panel.set_xlabel(parameter, parse_math=False)
        panel.grid(alpha=0.3)
    axes[0].set_ylabel(label, parse_math=False)
    if len(axes[0].get_legend_handles_labels()[0]) > 0:
        axes[0].legend(fontsize="small")
    return figure


_MARKS: dict[str, dict[str, Any]] = {
    "default": {"marker": "D", "color": "tab:orange", "label": "default"},
    "own": {"marker": "o", "color": "black", "markerfacecolor": "none", "markersize": 11, "label": "this run"},
}


def plot_signals(rows: Sequence[Mapping[str, Any]], path: Path, *, overwrite: bool = False) -> None:
    """Write the figure of `signals_figure`.

    Args:
        overwrite: replace a file of that name.
    """
    _save(signals_figure(rows), path, overwrite)


def signals_figure(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """Plot accuracy and reliability, one line of panels per row of the study (that is, per scene).

    The left panel shows the accuracy of unrefined predictions in tenths by R and by ||f||, if there is a truth. The
    right panel shows the histogram of R, with R = 0 as a separate bar.
    """
    figure, axes = _figure((9, 3.5 * len(rows)), len(rows), 2)
    for row, curves, histogram in zip(rows, axes[::2], axes[1::2]):
        for name, label in (("reliability", "R"), ("norm", "||f||")):
            bins = [100 * x for key, x in row.items() if key.startswith(f"{name}.bin")]
            if len(bins) > 0:
                curves.plot(range(1, len(bins) + 1), bins, marker="o", label=f"by {label}")
        curves.set_title(row.get("scene", ""), parse_math=False)
        curves.set_xlabel("tenth of the Gaussians, ascending")
        curves.set_ylabel("accuracy, unrefined, %")
        counts = {float(k.removeprefix("histogram.")): 100 * x for k, x in row.items() if k.startswith("histogram.")}
        width = 1 / len(counts)
        histogram.bar(list(counts), list(counts.values()), width=width, align="edge", label="R > 0")
        histogram.bar([-2 * width], [100 * row["zero.share"]], width=width, color="tab:red", label="R = 0")
        histogram.set_xlabel("R")
        histogram.set_ylabel("Gaussians, %")
        for panel in (curves, histogram):
            panel.grid(axis="y", alpha=0.3)
            if len(panel.get_legend_handles_labels()[0]) > 0:
                panel.legend()
    return figure


def _figure(size: tuple[float, float], rows: int, columns: int, **options: Any) -> tuple[Figure, list[Any]]:
    mpl.rcParams["svg.hashsalt"] = "normlift"  # reproducible files
    figure = Figure(figsize=size, layout="constrained")
    return figure, list(figure.subplots(rows, columns, squeeze=False, **options).flat)


def _save(figure: Figure, path: Path, overwrite: bool) -> None:
    with new_file(path, overwrite=overwrite) as draft:
        figure.savefig(draft, metadata={"Date": None} if path.suffix == ".svg" else None)
