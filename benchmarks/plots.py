"""Pictures from benchmark JSON: time against error over the presets of a lift.

python -m benchmarks.plots      docs/presets.svg from results/presets.json
"""

from __future__ import annotations

import json
from pathlib import Path

import matplotlib as mpl
from matplotlib.figure import Figure

from benchmarks.report import RESULTS

DOCS = Path(__file__).parents[1] / "docs"
NAMES = {
    "exact": "float64 (--precision double)",
    "float32": "default: float32",
    "tf32": "TF32 vote",
    "half": "float16 vote",
    "low_rank": "stored in a basis, tolerance 5e-2",
    "half_resolution": "half resolution (--lift-downscale 2)",
    "every_second_view": "every second view",
}
FLOOR = 1e-4
"""Where an error of 0 is drawn."""


def plot_presets(source: Path, target: Path) -> None:
    document = json.loads(source.read_text())
    metrics = {metric["key"]: metric["value"] for metric in document["metrics"]}
    mpl.rcParams["svg.hashsalt"] = "presets"  # the same file for the same figures
    figure = Figure(figsize=(8, 4.5), layout="constrained")
    axes = figure.subplots()
    for name, label in NAMES.items():
        seconds, error = metrics[f"{name}.s"], max(metrics[f"{name}.rms_error"], FLOOR)
        axes.plot(seconds, error, "o", label=f"{label}: {seconds:.3g} s, {metrics[f'{name}.rms_error']:.2g}")
    axes.set(xscale="log", yscale="log", xlabel="seconds: evidence, lift, neighbours, vote", ylim=(FLOOR / 2, 2))
    axes.set_ylabel("error of refined directions against float64, RMS")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    axes.set_title(f"fox, 15 views, {document['hardware'].split(',')[0]}", fontsize=10)
    figure.savefig(target, metadata={"Date": None})


if __name__ == "__main__":
    plot_presets(RESULTS / "presets.json", DOCS / "presets.svg")
    print(f"Written: {DOCS / 'presets.svg'}")
