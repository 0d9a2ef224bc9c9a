"""docs/speed_and_error.md, docs/accuracy.md and plots from the JSON files of the benchmarks; absent ones are named.

python -m benchmarks.pages
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import matplotlib as mpl
from matplotlib.figure import Figure

from benchmarks.documents import TITLES, Document, documents, table
from benchmarks.findings import findings, steps
from benchmarks.plots import DOCS, NAMES
from benchmarks.signals import STEP
from normlift_ns.evaluation.plots import plot_signals, plot_sweeps

PRESET_FLAGS = {
    "exact": "`--precision double`", "float32": "default", "half_resolution": "`--lift-downscale 2`",
    "every_second_view": "`--max-views` half", "low_rank": "`--form low_rank --tolerance 0.05`",
}  # fmt: skip


def presets(document: Document, accuracy: Document, losses: Document) -> Iterator[str]:
    """Time, memory and error of the whole lift on a GPU, and what it does to mIoU where that was measured."""
    yield from ("## Presets on a GPU", "", document.origin, "")
    v, rows = document.values, []
    for name, label in NAMES.items():
        if f"{name}.s" in v:
            seconds, memory = f"{v[f'{name}.s']:.3g} s", f"{v[f'{name}.peak_gib']:.2f} GiB"
            error, other = f"{v[f'{name}.rms_error']:.2g}", f"{100 * v[f'{name}.other_share']:.2g} %"
            key = "ablation.full.miou" if name == "float32" else f"preset.{name}.miou"
            task = (accuracy.interval(key), "" if name == "float32" else losses.interval(name, 2))
            rows.append((label, PRESET_FLAGS.get(name, "benchmark only"), seconds, memory, error, other, *task))
    if len(rows) == 0:
        return
    header = (
        "preset",
        "how",
        "time",
        "peak memory",
        "RMS error",
        "directions off by > 0.1",
        "mIoU, tabletop",
        "mIoU, demo",
    )
    yield from table(header, rows)
    yield (
        "Time to error: fox. mIoU on the tabletop: means over the ladder of damage; on the demo room: points against "
        "the default on the same damaged masks (`python -m benchmarks.losses`, on a CPU). Empty: not measured."
    )
    yield ""
    ratio = v["float32.s"] / v["every_second_view.s"]
    yield (
        f"Half of the views is {ratio:.1f}x as fast as the default, and moves "
        f"{100 * v['every_second_view.other_share']:.0f} % of the refined directions by more than 0.1, because every "
        f"view has noise of its own; half of the resolution moves {100 * v['half_resolution.other_share']:.0f} %. "
        f"Float32 instead of float64 moves {100 * v['float32.other_share']:.2g} %."
    )
    yield ""


def every_metric(title: str, document: Document, keep: str = "") -> Iterator[str]:
    """All (or some) metrics of one file as they stand."""
    yield from (f"## {title}", "", document.origin, "")
    metrics = [m for m in document.content["metrics"] if keep in [*m["key"].split("_"), ""]]
    if len(metrics) > 0:
        rows = [
            (f"`{m['key']}`", f"{m['value']:.4g} {m['unit']}", "" if m["error"] is None else f"{m['error']:.1e}")
            for m in metrics
        ]
        yield from table(("what", "value", "relative error against float64"), rows)


def timing(document: Document) -> Iterator[str]:
    """The stages, in the columns of the paper's table."""
    yield from ("## Where the time goes on a GPU", "", document.origin, "")
    v, rows = document.values, []
    for case in [k.removesuffix(".total_s") for k in v if k.endswith(".total_s")]:
        size = f"{v[f'{case}.gaussians'] / 1e6:.2f} M, {v[f'{case}.views']:.0f}"
        post = v[f"{case}.reliability_s"] + v[f"{case}.neighbors_s"] + v[f"{case}.vote_s"]
        times = (v[f"{case}.evidence_lift_s"], post, v[f"{case}.total_s"])
        rows.append((case, size, *(f"{t:.3f} s" for t in times), f"{v[f'{case}.peak_gib']:.1f} GiB"))
    header = ("", "Gaussians, views", "lift", "reliability, neighbours, vote", "total", "peak memory")
    yield from table(header, rows)
    yield "Lift: evidence, reliability and directions, which share their sums; 512 channels. 2D features are not in it."
    yield ""


def plot_accuracy(document: Document, target: Path) -> None:
    """mIoU of every variant on every step of the ladder, tabletop."""
    names = steps(document)
    mpl.rcParams["svg.hashsalt"] = "accuracy"  # the same file for the same figures
    figure = Figure(figsize=(9, 4.5), layout="constrained")
    axes = figure.subplots()
    for i, name in enumerate(TITLES):
        values = [document.values[f"ladder.{step}.{name}.miou"] for step in names]
        bars = [document.values[f"ladder.{step}.{name}.miou_ci95"] for step in names]
        places = [x + 0.13 * (i - 2.5) for x in range(len(names))]
        axes.bar(places, values, 0.13, yerr=bars, label=TITLES[name], error_kw={"linewidth": 0.6})
    axes.set_xticks(range(len(names)), names, rotation=30, ha="right")
    axes.set_ylabel("mIoU over Gaussians, points")
    axes.legend(fontsize=8, ncols=3)
    axes.grid(axis="y", alpha=0.3)
    figure.savefig(target, metadata={"Date": None})


def plot_drift(document: Document, target: Path) -> None:
    """Share of pairs whose mixture is nearest to a third class, by the share of one of the two, tabletop."""
    mpl.rcParams["svg.hashsalt"] = "drift"  # the same file for the same figures
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
    figure.savefig(target, metadata={"Date": None})


def page(documents: dict[str, Document]) -> str:
    """docs/speed_and_error.md."""
    lines = [
        "# Speed and error",
        "",
        "Written by `python -m benchmarks.pages` from `benchmarks/results/*.json`. A time stands beside the error of",
        "the result that took it.",
        "",
        *presets(documents["presets"], documents["accuracy"], documents["losses"]),
        *timing(documents["h100"]),
        *every_metric("The core on a GPU", documents["h100"]),
        *every_metric("The core on a CPU", documents["cpu"]),
        *every_metric("Forms on disk, tolerance 0.01", documents["forms"], keep="tol0.01"),
    ]
    return "\n".join(lines).rstrip() + "\n"


def plots(found: dict[str, Document]) -> Iterator[Path]:
    """Pictures of what was measured."""
    accuracy, fit, signals = (found[name] for name in ("accuracy", "fit", "signals"))
    if accuracy.found:
        plot_accuracy(accuracy, DOCS / "accuracy.svg")
        yield DOCS / "accuracy.svg"
    if fit.found:
        curves = ((key.split(".", 2)[1:], value) for key, value in fit.values.items() if key.startswith("curve."))
        rows = [{"parameter": name, "value": float(at), "miou": value} for (name, at), value in curves]
        plot_sweeps(rows, "miou", "mIoU on held-out damage, points", DOCS / "sensitivity.svg")
        yield DOCS / "sensitivity.svg"
    if signals.found:
        start = f"tabletop.{STEP}."
        one = {k.removeprefix(start): value for k, value in signals.values.items() if k.startswith(start)}
        plot_signals({k: value for k, value in one.items() if not k.endswith("_ci95")}, DOCS / "reliability.svg")
        yield DOCS / "reliability.svg"
        plot_drift(signals, DOCS / "drift.svg")
        yield DOCS / "drift.svg"


def main() -> None:
    found = documents()
    (DOCS / "speed_and_error.md").write_text(page(found))
    (DOCS / "accuracy.md").write_text(findings(found))
    written = [DOCS / "speed_and_error.md", DOCS / "accuracy.md", *plots(found)]
    print("Written: " + ", ".join(map(str, written)))


if __name__ == "__main__":
    main()
