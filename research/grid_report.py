"""Summary of a run of the grid: the decision and the figures behind it, as metrics and as a table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy import stats

from research.report import Report
from research.rule import CHOICE, CONFIRMATION, Cell, Verdict, cells_of, decide, mean

FACTS = {
    "mean": "points, mean of all cells",
    "gain": "points over none",
    "undamaged": "points lost undamaged",
    "three_views": "points lost with 3 views",
    "worst": "points lost in the worst cell",
    "worse": "share of cells worse than none by more than 1 point",
    "column": "largest share of a damage or a number of views",
}
FINAL = "1: by all cells and Gaussians, 0: by some"
DEFAULT = "consensus_posterior tau 0.9 gamma 0.05"
"""Choice of the grid, which also has a column for statistic real."""
AXES = ("kind", "statistic", "damage", "views")


def report_of(
    rows: Mapping[Cell, Mapping[str, Any]], names: Sequence[str], expected: int, sizes: Mapping, *, real: bool = False
) -> Report:
    """Return all metrics of the rows of the grid.

    Args:
        expected: Number of cells, finished or not.
        sizes: Settings of the run that are numbers or None.
        real: True if the rows are of statistic real, so that nothing is decided.
    """
    report = Report("grid_real" if real else "grid")
    report.add("cells", len(rows), f"of {expected}")
    for key, value in sizes.items():
        report.add(key, -1 if value is None else value, "-1: all, or the default")
    report.add("seconds", sum(row["seconds"] for row in rows.values()), "s in cells, all processes")
    values = {cell: row["miou"] for cell, row in rows.items()}
    groups = {
        "choice": {cell: row for cell, row in rows.items() if cell.scene in CHOICE},
        **{room: {cell: row for cell, row in rows.items() if cell.scene == room} for room in CONFIRMATION},
    }
    if len(groups["choice"]) > 0:
        decision = decide(values, names)
        whole = set(rows) == {cell for scene in (*CHOICE, *CONFIRMATION) for cell in cells_of(scene)}
        final = whole and all(value is None for value in sizes.values())
        if not real:
            report.add(f"decision.default.{decision.default}", final, FINAL)
            report.add(f"decision.choice.{decision.choice}", final, FINAL)
        if decision.confirmed is not None and not real:
            report.add(
                "decision.confirmed", decision.confirmed, f"1: by {' and '.join(decision.confirmation)}, 0: refuted"
            )
        for group, verdicts in (("choice", decision.verdicts), *decision.confirmation.items()):
            for name, found in verdicts.items():
                _add_verdict(report, f"{group}.{name}", name, found, groups[group])
        for name in shown(names, DEFAULT if real else decision.choice):
            _add_columns(report, name, groups["choice"])
    return report


def shown(names: Sequence[str], choice: str) -> list[str]:
    """Return the candidates with a column of their own in the table by damage, statistic, kind and views."""
    methods = [name for name in names if " " not in name and name != "none"]
    return [*methods, *(name for name in (choice,) if name not in (*methods, "none"))]


def _add_verdict(report: Report, key: str, name: str, found: Verdict, rows: Mapping[Cell, Mapping[str, Any]]) -> None:
    for fact, unit in FACTS.items():
        where = {"worst": f": {', '.join(found.worst_cell)}", "column": f": {found.column_name}"}.get(fact, "")
        report.add(f"{key}.{fact}", getattr(found, fact), unit + where)
    report.add(f"{key}.gain_ci95", interval(rows, name), "points, half of the 95 % interval over seeds")
    report.add(f"{key}.copied", mean(mean(row["copied"][name]) for row in rows.values()), "share of Gaussians copied")
    pairs = [b - a > 1 for row in rows.values() for a, b in zip(row["miou"][name], row["miou"]["none"], strict=True)]
    report.add(f"{key}.worse_seeds", mean(pairs), "share of single observations worse by more than 1 point")
    report.add(f"{key}.eligible", found.eligible, ", ".join(found.broken) or "all clauses hold")


def interval(rows: Mapping[Cell, Mapping[str, Any]], name: str) -> float:
    """Return half of the 95 % interval over seeds of the mean gain over all cells."""
    gains = np.mean([np.subtract(row["miou"][name], row["miou"]["none"]) for row in rows.values()], axis=0)
    return float(stats.t.ppf(0.975, len(gains) - 1) * gains.std(ddof=1) / len(gains) ** 0.5)


def _add_columns(report: Report, name: str, rows: Mapping[Cell, Mapping[str, Any]]) -> None:
    loss = {cell: mean(row["miou"]["none"]) - mean(row["miou"][name]) for cell, row in rows.items()}
    for axis in (*AXES, "scene"):
        for label in dict.fromkeys(getattr(cell, axis) for cell in rows):
            some = [value for cell, value in loss.items() if getattr(cell, axis) == label]
            report.add(f"column.{axis}.{label}.{name}.gain", -mean(some), "points over none, choice scenes")
            report.add(f"column.{axis}.{label}.{name}.worst", max(some), "points lost in the worst cell")
            report.add(f"column.{axis}.{label}.{name}.worse", mean(x > 1 for x in some), "share of its cells")


def show(report: Report, names: Sequence[str]) -> None:
    """Print the decision, and a compact table of the figures of every candidate, best mean first."""
    values = {metric.key: metric for metric in report.metrics}
    facts = ("mean", "gain", "gain_ci95", "undamaged", "three_views", "worst", "worse", "column", "copied")
    for group in ("choice", *CONFIRMATION):
        some = [name for name in names if f"{group}.{name}.mean" in values]
        if len(some) == 0:
            continue
        print(f"\n{group}, points of mIoU and shares\n{'':46}" + "".join(f"{fact[:9]:>10}" for fact in facts))
        for name in sorted(some, key=lambda name: -values[f"{group}.{name}.mean"].value):
            cells = "".join(f"{values[f'{group}.{name}.{fact}'].value:10.2f}" for fact in facts)
            print(f"{name:46}{cells}  {values[f'{group}.{name}.eligible'].unit}")
    for key in (key for key in values if key.startswith("decision.")):
        print(f"{key}: {values[key].value:g} ({values[key].unit})")
