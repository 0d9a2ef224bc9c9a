"""Summary of the rows of `research.accuracy`: means with intervals, worst cases and shares."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from scipy import stats

from normlift_ns.core.metrics import spearman_test
from normlift_ns.evaluation.studies import Variant
from research.damage import LADDER
from research.report import Report
from research.variants import VARIANTS

VARIES = 0.05
"""Accuracy varies over bins of reliability if their means span at least this much."""
WORSE = 1.0
"""A method is worse than no refinement in an observation if it loses more than this number of percentage points."""
AGREED: dict[str, Variant] = {
    "consensus": "none", "consensus_paper": "paper", "consensus_posterior": "posterior",
}  # fmt: skip
"""Variant of the vote after the consensus, by the name of the method."""
VOTES: dict[str, Variant] = {**{name: name for name in VARIANTS}, **AGREED}
METHODS = tuple(VOTES)
THREE = ", 3 views"
"""End of the names of steps with 3 views."""
PRESETS = ("preset_half", "preset_every_second_view")
OTHERS = {"sfs": "A^2 weights", "occam": "centre pixels", "vala": "gated geometric median", "drsplat": "top-k rays"}


def mean_and_interval(values: Sequence[float]) -> tuple[float, float]:
    """Return the mean over seeds and half the width of its 95 % interval."""
    n = len(values)
    half = stats.t.ppf(0.975, n - 1) * np.std(values, ddof=1) / n**0.5 if n > 1 else float("nan")
    return float(np.mean(values)), float(half)


def summarize(rows: list[dict[str, Any]], report: Report) -> None:
    """Add means with intervals of each step and over the ladder, for all scenes together and for each scene."""
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    for scene in ("", *scenes):
        prefix = f"{scene}." if scene else ""
        of_scene = [row for row in rows if scene in ("", row["scene"])]
        steps = [name for name in dict.fromkeys(row["damage"] for row in of_scene) if not name.endswith(THREE)]
        ladder = [row for row in of_scene if row["damage"] in LADDER]
        clean = [row for row in ladder if row["damage"] == "noise only"]
        three = [row for row in of_scene if row["damage"].endswith(THREE)]
        for group, some in (("ablation", ladder), ("undamaged", clean), ("views3", three)):
            for method in METHODS if len(some) > 0 else ():
                _add_method(report, f"{prefix}{group}.{method}", some, method)
                if group != "ablation":
                    _add_mean(report, f"{prefix}{group}.ablation.{method}.miou", _by_seed(some, method, "miou"))
        for step in steps:
            some = [row for row in of_scene if row["damage"] == step]
            for method in METHODS:
                _add_mean(report, f"{prefix}ladder.{step}.{method}.miou", _by_seed(some, method, "miou"))
        for method in (name for name in METHODS if name != "paper"):
            gains = _difference(ladder, "paper", method)
            _add_mean(report, f"{prefix}ablation.paper_minus_{method}.miou", gains)
        for method in (m for m in (*OTHERS, *PRESETS) if m in ladder[0]):
            group = "preset" if method in PRESETS else "baseline"
            for metric in ladder[0][method]:
                key = f"{prefix}{group}.{method.removeprefix('preset_')}.{metric}"
                _add_mean(report, key, _by_seed(ladder, method, metric))
        _add_reliability(ladder, [step for step in steps if step in LADDER], prefix, report)
    for method in AGREED:
        report.add(f"{method}.share_worse", *_worse([row for row in rows if row["damage"] in LADDER], method))


def _by_seed(rows: Sequence[dict[str, Any]], method: str, metric: str) -> list[float]:
    """Return the mean over scenes and steps for each seed."""
    seeds = sorted({row["seed"] for row in rows})
    return [float(np.mean([row[method][metric] for row in rows if row["seed"] == seed])) for seed in seeds]


def _difference(rows: Sequence[dict[str, Any]], method: str, other: str) -> list[float]:
    return [a - b for a, b in zip(_by_seed(rows, method, "miou"), _by_seed(rows, other, "miou"), strict=True)]


def _add_mean(report: Report, key: str, values: Sequence[float]) -> None:
    mean, half = mean_and_interval(values)
    report.add(key, mean, "points")
    report.add(f"{key}_ci95", half, "points, half of the 95 % interval over seeds")


def _worse(rows: Sequence[dict[str, Any]], method: str) -> tuple[float, str]:
    share = float(np.mean([row["none"]["miou"] - row[method]["miou"] > WORSE for row in rows]))
    return share, f"share of {len(rows)} observations worse than none by more than {WORSE:g} point"


def _add_method(report: Report, key: str, rows: Sequence[dict[str, Any]], method: str) -> None:
    """Add the figures of a method that the documentation shows, over some steps."""
    for metric in (name for name in rows[0][method] if name != "copied"):
        _add_mean(report, f"{key}.{metric}", _by_seed(rows, method, metric))
    gains = _difference(rows, method, "none")
    _add_mean(report, f"{key}.gain", gains)
    worst = min(rows, key=lambda row: row[method]["miou"] - row["none"]["miou"])
    where = f"{worst['scene']}, {worst['damage']}, seed {worst['seed']}"
    report.add(f"{key}.worst", worst[method]["miou"] - worst["none"]["miou"], f"points over none: {where}")
    report.add(f"{key}.share_worse", *_worse(rows, method))
    report.add(f"{key}.copied", float(np.mean([row[method]["copied"] for row in rows])), "share of Gaussians")


def _add_reliability(rows: list[dict[str, Any]], steps: Sequence[str], prefix: str, report: Report) -> None:
    """Add Spearman's correlation between ten bins by R (or ||f||) and their accuracy, per step of the ladder."""
    varying = {"reliability": [], "norm": []}
    for step in steps:
        for name, found in varying.items():
            bins = np.mean([row[f"{name}_bins"] for row in rows if row["damage"] == step], axis=0)
            value = spearman_test(torch.arange(10.0), torch.from_numpy(bins)).value
            report.add(f"{prefix}{name}.{step}.spearman_bins", value, "Spearman, ten bins")
            if name == "reliability":
                report.add(f"{prefix}{name}.{step}.lowest_bin", 100 * bins[0], "points, accuracy of the lowest tenth")
                report.add(
                    f"{prefix}{name}.{step}.highest_bin", 100 * bins[-1], "points, accuracy of the highest tenth"
                )
            if np.ptp(bins) >= VARIES:
                found.append(value)
    for name, found in varying.items():
        if len(found) > 0:
            mean = float(np.mean(found))
            report.add(f"{prefix}{name}.spearman_bins_mean", mean, "mean over steps where accuracy varies")
