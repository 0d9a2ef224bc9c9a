"""Plots of the documentation from the results files; the same figures give the same file."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import matplotlib as mpl
from matplotlib.figure import Figure

from normlift_ns.evaluation.studies import default_value, save_figure, signals_figure, sweeps_figure
from research.documents import PRESETS, TITLES, Document, Documents, steps
from research.signals import STEP

DOCS = Path(__file__).parents[1] / "docs"
FLOOR = 1e-4
"""Value at which an error of 0 is drawn."""


def plots(found: Documents, folder: Path) -> Iterator[Path]:
    """Draw all plots, and yield their paths."""
    accuracy, fit, signals = (found[name] for name in ("accuracy", "fit", "signals"))
    yield plot_presets(found["presets"], folder / "presets.svg")
    yield plot_accuracy(accuracy, folder / "accuracy.svg")
    yield plot_drift(signals, folder / "drift.svg")
    curves = ((key.split(".", 2)[1:], value) for key, value in fit.values.items() if key.startswith("curve."))
    rows = [
        {"parameter": name, "value": float(at), "miou": value, "default": float(at) == default_value(name, "paper")}
        for (name, at), value in curves
    ]
    figure = sweeps_figure(rows, "miou", "mIoU on held-out damage, points")
    save_figure(figure, folder / "sensitivity.svg", overwrite=True)
    yield folder / "sensitivity.svg"
    start = f"tabletop.{STEP}."
    one = {k.removeprefix(start): value for k, value in signals.values.items() if k.startswith(start)}
    save_figure(signals_figure([one]), folder / "reliability.svg", overwrite=True)
    yield folder / "reliability.svg"


def plot_presets(document: Document, target: Path) -> Path:
    """Plot time against error over the presets of a lift."""
    v = document.values
    mpl.rcParams["svg.hashsalt"] = "presets"
    figure = Figure(figsize=(8, 4.5), layout="constrained")
    axes = figure.subplots()
    for name, label in PRESETS.items():
        seconds, error = v[f"{name}.s"], v[f"{name}.rms_error"]
        axes.plot(seconds, max(error, FLOOR), "o", label=f"{label}: {seconds:.3g} s, {error:.2g}")
    axes.set(xscale="log", yscale="log", xlabel="seconds: evidence, lift, neighbours, vote", ylim=(FLOOR / 2, 2))
    axes.set_ylabel("error of refined directions against float64, RMS")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    axes.set_title(f"fox, 15 views, {document.hardware.split(',')[0]}", fontsize=10)
    return _saved(figure, target)


def plot_accuracy(document: Document, target: Path) -> Path:
    """Plot the mIoU of every variant on every step of the ladder, for the tabletop."""
    names = steps(document)
    mpl.rcParams["svg.hashsalt"] = "accuracy"
    figure = Figure(figsize=(9, 4.5), layout="constrained")
    axes = figure.subplots()
    start = "tabletop.ladder"
    methods = [name for name in TITLES if f"{start}.{names[0]}.{name}.miou" in document.values]
    width = 0.8 / len(methods)
    for i, name in enumerate(methods):
        values = [document.values[f"{start}.{step}.{name}.miou"] for step in names]
        bars = [document.values[f"{start}.{step}.{name}.miou_ci95"] for step in names]
        places = [x + width * (i - (len(methods) - 1) / 2) for x in range(len(names))]
        axes.bar(places, values, width, yerr=bars, label=TITLES[name], error_kw={"linewidth": 0.6})
    axes.set_xticks(range(len(names)), names, rotation=30, ha="right")
    axes.set_ylabel("mIoU over Gaussians, points")
    figure.legend(loc="outside upper center", fontsize=8, ncols=4)
    axes.grid(axis="y", alpha=0.3)
    return _saved(figure, target)


def plot_drift(document: Document, target: Path) -> Path:
    """Plot the share of pairs whose mixture is nearest to a third class, by the mixing ratio, for the tabletop."""
    mpl.rcParams["svg.hashsalt"] = "drift"
    figure = Figure(figsize=(6, 3.5), layout="constrained")
    axes = figure.subplots()
    keys = [k.split(".drift.noise")[1].split(".mix") for k in document.values if k.startswith("tabletop.drift.")]
    for noise in dict.fromkeys(noise for noise, _ in keys):
        mixes = [mix for other, mix in keys if other == noise]
        rates = [document.values[f"tabletop.drift.noise{noise}.mix{mix}"] for mix in mixes]
        axes.plot(list(map(float, mixes)), rates, marker="o", markersize=3, label=f"noise {noise}")
    axes.set_xlabel("share of one of two features")
    axes.set_ylabel("pairs nearest to a third, %")
    axes.legend(fontsize=8, loc="center left", bbox_to_anchor=(1, 0.5))
    axes.grid(alpha=0.3)
    return _saved(figure, target)


def _saved(figure: Figure, target: Path) -> Path:
    figure.savefig(target, metadata={"Date": None})
    return target
