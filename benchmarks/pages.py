"""docs/speed_and_error.md and docs/accuracy.svg from the JSON files of the benchmarks; files that are absent are named.

python -m benchmarks.pages
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure

from benchmarks.accuracy import OTHERS
from benchmarks.plots import DOCS, NAMES
from benchmarks.report import RESULTS

TITLES = {
    "none": "without refinement",
    "plain_knn": "plain KNN voting",
    "linear": "linear averaging",
    "norm_only": "norm only",
    "support_only": "support only",
    "full": "full",
}
PRESET_FLAGS = {
    "exact": "`--precision double`", "float32": "default", "half_resolution": "`--lift-downscale 2`",
    "every_second_view": "`--max-views` half", "low_rank": "`--form low_rank --tolerance 0.05`",
}  # fmt: skip


class Document:
    """One results file; values by key."""

    def __init__(self, path: Path) -> None:
        self.path, self.found = path, path.exists()
        self.content: dict[str, Any] = json.loads(path.read_text()) if self.found else {"metrics": []}
        self.values = {m["key"]: m["value"] for m in self.content["metrics"]}
        self.errors = {m["key"]: m["error"] for m in self.content["metrics"]}

    @property
    def origin(self) -> str:
        """Where the figures come from."""
        if not self.found:
            return f"*`results/{self.path.name}` is absent: run its benchmark first.*"
        return f"`{self.content['command']}` on {self.content['hardware']}."


def table(header: tuple[str, ...], rows: list[tuple[str, ...]]) -> Iterator[str]:
    """A Markdown table."""
    yield "| " + " | ".join(header) + " |"
    yield "|" + "---|" * len(header)
    yield from ("| " + " | ".join(row) + " |" for row in rows)
    yield ""


def presets(document: Document, accuracy: Document) -> Iterator[str]:
    """Time, memory and error of the whole lift on a GPU, and what it does to mIoU where that was measured."""
    yield from ("## Presets on a GPU", "", document.origin, "")
    v, rows = document.values, []
    for name, label in NAMES.items():
        if f"{name}.s" in v:
            seconds, memory = f"{v[f'{name}.s']:.3g} s", f"{v[f'{name}.peak_gib']:.2f} GiB"
            error, other = f"{v[f'{name}.rms_error']:.2g}", f"{100 * v[f'{name}.other_share']:.2g} %"
            key = "ablation.full.miou" if name == "float32" else f"preset.{name}.miou"
            miou = _interval(accuracy.values, key) or "not measured"
            rows.append((label, PRESET_FLAGS.get(name, "benchmark only"), seconds, memory, error, other, miou))
    if len(rows) == 0:
        return
    header = ("preset", "how", "time", "peak memory", "RMS error", "directions off by > 0.1", "mIoU, tabletop")
    yield from table(header, rows)
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


def accuracy(document: Document) -> Iterator[str]:
    """mIoU of the refinement's variants and of other methods, means over the ladder of damage."""
    yield from ("## Task accuracy", "", document.origin, "")
    v = document.values
    if not document.found:
        return
    scenes = ["", *(["demo."] if "demo.ablation.full.miou" in v else [])]
    columns = ["miou", "macc", *(["miou_2d"] if "ablation.full.miou_2d" in v else [])]
    for scene in scenes:
        rows = []
        for group, names in (("ablation", TITLES), ("baseline", OTHERS)):
            for name, label in names.items():
                if f"{scene}{group}.{name}.miou" in v:
                    cells = (_interval(v, f"{scene}{group}.{name}.{c}") for c in columns)
                    rows.append((label if group == "ablation" else f"{label} (our implementation of the idea)", *cells))
        if len(rows) > 0:
            yield from table(("demo room" if scene else "tabletop", *columns), rows)
    yield f"Means over the ladder of damage and {v['seeds']:.0f} seeds, in points, with 95 % intervals over seeds."
    yield ""


def _interval(values: dict[str, float], key: str) -> str:
    return f"{values[key]:.1f} ± {values[f'{key}_ci95']:.1f}" if key in values else ""


def plot_accuracy(document: Document, target: Path) -> None:
    """mIoU of every variant on every step of the ladder."""
    steps = [k.split(".")[1] for k in document.values if k.startswith("ladder.") and k.endswith(".full.miou")]
    mpl.rcParams["svg.hashsalt"] = "accuracy"  # the same file for the same figures
    figure = Figure(figsize=(9, 4.5), layout="constrained")
    axes = figure.subplots()
    for i, name in enumerate(TITLES):
        values = [document.values[f"ladder.{step}.{name}.miou"] for step in steps]
        bars = [document.values[f"ladder.{step}.{name}.miou_ci95"] for step in steps]
        places = [x + 0.13 * (i - 2.5) for x in range(len(steps))]
        axes.bar(places, values, 0.13, yerr=bars, label=TITLES[name], error_kw={"linewidth": 0.6})
    axes.set_xticks(range(len(steps)), steps, rotation=30, ha="right")
    axes.set_ylabel("mIoU over Gaussians, points")
    axes.legend(fontsize=8, ncols=3)
    axes.grid(axis="y", alpha=0.3)
    figure.savefig(target, metadata={"Date": None})


def page(documents: dict[str, Document]) -> str:
    """docs/speed_and_error.md."""
    lines = [
        "# Speed and error",
        "",
        "Written by `python -m benchmarks.pages` from `benchmarks/results/*.json`. A time stands beside the error of",
        "the result that took it.",
        "",
        *presets(documents["presets"], documents["accuracy"]),
        *accuracy(documents["accuracy"]),
        *every_metric("The core on a GPU", documents["h100"]),
        *every_metric("The core on a CPU", documents["cpu"]),
        *every_metric("Forms on disk, tolerance 0.01", documents["forms"], keep="tol0.01"),
    ]
    return "\n".join(lines).rstrip() + "\n"


def documents() -> dict[str, Document]:
    """All results files that the page speaks of."""
    return {name: Document(RESULTS / f"{name}.json") for name in ("cpu", "forms", "presets", "h100", "accuracy")}


def main() -> None:
    found = documents()
    (DOCS / "speed_and_error.md").write_text(page(found))
    written = [DOCS / "speed_and_error.md"]
    if found["accuracy"].found:
        plot_accuracy(found["accuracy"], DOCS / "accuracy.svg")
        written.append(DOCS / "accuracy.svg")
    print("Written: " + ", ".join(map(str, written)))


if __name__ == "__main__":
    main()
