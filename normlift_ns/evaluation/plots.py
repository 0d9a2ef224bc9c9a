"""Figures of the studies: curves of every parameter, and R beside accuracy."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure

from normlift_ns.core.files import new_file


def plot_sweeps(
    rows: Sequence[Mapping[str, Any]], metric: str, label: str, path: Path, *, overwrite: bool = False
) -> None:
    """One panel per parameter of `votes.SWEEPS`, the metric over its values.

    Args:
        rows: with parameter, value and the metric.
        label: of the metric's axis.
        overwrite: replace a file of that name.
    """
    parameters = list(dict.fromkeys(row["parameter"] for row in rows))
    figure, axes = _figure((2 * (len(parameters) + 1), 5), 2, -(-len(parameters) // 2), sharey=True)
    for one, parameter in zip(axes, parameters):
        points = sorted((row["value"], row[metric]) for row in rows if row["parameter"] == parameter)
        one.plot([f"{x:g}" for x, _ in points], [y for _, y in points], marker="o", markersize=4)
        one.set_xlabel(parameter, parse_math=False)
        one.grid(alpha=0.3)
    axes[0].set_ylabel(label, parse_math=False)
    _save(figure, path, overwrite)


def plot_signals(found: Mapping[str, Any], path: Path, *, overwrite: bool = False) -> None:
    """Accuracy in tenths by R and by ||f||, where there is a truth, and the histogram of R with R = 0 apart."""
    bins = {name: [found[k] for k in found if k.startswith(f"{name}.bin")] for name in ("reliability", "norm")}
    figure, axes = _figure((9, 3.5), 1, 2)
    for name, label in (("reliability", "R"), ("norm", "||f||")):
        if len(bins[name]) > 0:
            axes[0].plot(range(1, len(bins[name]) + 1), [100 * x for x in bins[name]], marker="o", label=f"by {label}")
    axes[0].set_xlabel("tenth of the Gaussians, ascending")
    axes[0].set_ylabel("accuracy, %")
    axes[0].legend()
    counts = {float(k.removeprefix("histogram.")): 100 * x for k, x in found.items() if k.startswith("histogram.")}
    axes[1].bar(list(counts), list(counts.values()), width=1 / len(counts), align="edge", label="R > 0")
    axes[1].bar([-2 / len(counts)], [100 * found["zero.share"]], width=1 / len(counts), color="tab:red", label="R = 0")
    axes[1].set_xlabel("R")
    axes[1].set_ylabel("Gaussians, %")
    axes[1].legend()
    for one in axes:
        one.grid(axis="y", alpha=0.3)
    _save(figure, path, overwrite)


def _figure(size: tuple[float, float], rows: int, columns: int, **options: Any) -> tuple[Figure, list[Any]]:
    mpl.rcParams["svg.hashsalt"] = "normlift"  # the same file for the same figures
    figure = Figure(figsize=size, layout="constrained")
    return figure, list(figure.subplots(rows, columns, squeeze=False, **options).flat)


def _save(figure: Figure, path: Path, overwrite: bool) -> None:
    with new_file(path, overwrite=overwrite) as draft:
        figure.savefig(draft, metadata={"Date": None} if path.suffix == ".svg" else None)
