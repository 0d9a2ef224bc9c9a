"""Figures of `research.gate --later` from its rows, and the targets of its first rule.

python -m research.gate_report            prints tables; results/gate.json with --output
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from statistics import mean
from typing import Any

from research.gate import DEFAULT, LATER, PIECES, TODAY
from research.report import RESULTS, Report
from research.rows import read_rows
from research.rule import CHOICE, CONFIRMATION, REAL, Cell

Row = dict[str, Any]
Cells = Mapping[Cell, Sequence[Row]]
FRONT_ENDS = {"masks": DEFAULT, "patches": PIECES, "superpixels": PIECES, "grid": PIECES}
"""Default form by kind of region."""
WORST = {"all": 0.7, "6": 2.0, "3": 2.5}
"""Largest accepted loss of a cell in percentage points, by number of views."""


def cells_of_rows(rows: Sequence[Row]) -> dict[Cell, list[Row]]:
    """Return the rows of cells of masks, by cell."""
    found: dict[Cell, list[Row]] = {}
    for row in rows:
        cell = Cell(*row["cell"])
        if cell.kind == "masks":
            found.setdefault(cell, []).append(row)
    return found


def by_kind(rows: Sequence[Row]) -> dict[str, list[float]]:
    """Return the gains of the default over the lift alone in all cells, by kind of region. Statistic real is a separate
    kind."""
    cells: dict[Cell, list[Row]] = {}
    for row in rows:
        cells.setdefault(Cell(*row["cell"]), []).append(row)
    found: dict[str, list[float]] = {}
    for cell, some in cells.items():
        kind = REAL if cell.statistic == REAL else cell.kind
        found.setdefault(kind, []).append(value(some, "miou", FRONT_ENDS[cell.kind].name, "lift"))
    return found


def value(rows: Sequence[Row], key: str, name: str, base: str | None = None) -> float:
    """Return the mean over the seeds of a cell, minus that of the form `base` if it is given."""
    at, other = rows[0]["names"].index(name), None if base is None else rows[0]["names"].index(base)
    return mean(row[key][at] - (0 if other is None else row[key][other]) for row in rows)


def some(cells: Cells, chosen: Callable[[Cell], bool]) -> list[Sequence[Row]]:
    return [rows for cell, rows in cells.items() if chosen(cell)]


def ratio(cells: Cells, name: str, statistic: str) -> float:
    rows = some(cells, lambda cell: cell.statistic == statistic)
    mended, broken = (sum(value(x, key, name) for x in rows) for key in ("mended", "broken"))
    return mended / broken if broken > 0 else math.inf


def measures(cells: Cells, name: str) -> dict[str, float]:
    """Return the figures of a form that the rule uses."""
    base = "forced consensus" if name.startswith("forced") else "consensus"
    damaged = lambda cell: cell.damage != "noise only"  # noqa: E731
    found = {
        "damaged": mean(value(x, "miou", name, "lift") for x in some(cells, lambda c: damaged(c) and c.views == "all")),
        "edges": mean(value(x, "edge", name, base) for x in cells.values()),
        "edges, consensus off": mean(value(x, "edge", name, "lift") for x in cells.values()),
    }
    for views in WORST:
        losses = [value(x, "miou", name, "lift") for x in some(cells, lambda c, views=views: c.views == views)]
        found[f"worst {views}"], found[f"mean {views}"] = min(losses), mean(losses)
        single = [row["miou"][row["names"].index(name)] - row["miou"][0]
                  for x in some(cells, lambda c, views=views: c.views == views) for row in x]  # fmt: skip
        found[f"worst observation {views}"] = min(single)
    undamaged = some(cells, lambda c: not damaged(c) and c.views == "all")
    found["undamaged worst"] = min(value(x, "miou", name, "lift") for x in undamaged)
    found["undamaged mean"] = mean(value(x, "miou", name, "lift") for x in undamaged)
    found["mended damaged"] = sum(value(x, "mended", name) for x in some(cells, damaged))
    for statistic in ("clip", "orthogonal", "real"):
        if some(cells, lambda c, statistic=statistic: c.statistic == statistic):
            found[f"ratio {statistic}"] = ratio(cells, name, statistic)
    found["changed"] = mean(value(x, "changed", name) for x in cells.values())
    found["copied"] = mean(value(x, "copied", name) for x in cells.values())
    return found


def targets(found: Mapping[str, float], today: Mapping[str, float]) -> dict[str, bool]:
    """Return, for each target of the rule, whether a form meets it."""
    return {
        "damaged": found["damaged"] >= today["damaged"] - 0.3,
        "edges": found["edges"] >= -1.0,
        **{f"worst {views}": found[f"worst {views}"] >= -limit for views, limit in WORST.items()},
        "undamaged": found["undamaged worst"] >= -0.05,
        "clip 2 : 1": found.get("ratio clip", 0.0) >= 2,
        "orthogonal 3 : 1": found.get("ratio orthogonal", 0.0) >= 3,
        "mended": found["mended damaged"] >= 0.5 * today["mended damaged"],
    }


def table(cells: Cells) -> dict[str, dict[str, float]]:
    """Return the measures of all forms, and the number of targets that each meets."""
    names = next(iter(cells.values()))[0]["names"]
    found = {name: measures(cells, name) for name in names if name != "lift"}
    for one in found.values():
        one["targets"] = sum(targets(one, found[TODAY.name]).values())
    return found


def reliabilities(cells: Cells) -> dict[str, dict[str, float]]:
    """Return figures of each form of R.

    They are its AUC, the accuracy of its highest tenth in the worst cell, and its worst mean gain over the paper's R in
    a column.
    """
    found: dict[str, dict[str, float]] = {}
    kinds = next(iter(cells.values()))[0]["R"]
    auc = {cell: {kind: [row["R"][kind]["auc"] for row in rows] for kind in kinds} for cell, rows in cells.items()}
    auc = {cell: x for cell, x in auc.items() if all(v is not None for values in x.values() for v in values)}
    columns = {f"{key} {label}": [c for c in auc if getattr(c, key) == label]
               for key in ("damage", "views") for label in dict.fromkeys(getattr(c, key) for c in auc)}  # fmt: skip
    for kind in next(iter(auc.values())):
        gain = {c: mean(x[kind]) - mean(x["paper"]) for c, x in auc.items()}
        highest = {c: mean(row["R"][kind]["bins"][-1] for row in cells[c]) for c in auc}
        found[kind] = {
            "auc": mean(mean(x[kind]) for x in auc.values()),
            "worst column": min(mean(gain[c] for c in some) for some in columns.values() if some),
            "highest tenth, worst cell": min(highest.values()),
            "highest tenth, mean": mean(highest.values()),
            "highest tenth, 3 views": mean(highest[c] for c in highest if c.views == "3"),
            "lowest tenth, mean": mean(mean(row["R"][kind]["bins"][0] for row in cells[c]) for c in auc),
        }
    return found


def main(arguments: argparse.Namespace) -> None:
    rows, report = read_rows(arguments.rows, {}), Report("gate")
    for label, scenes in (("choice", CHOICE), *((one, (one,)) for one in CONFIRMATION)):
        cells = cells_of_rows([row for row in rows if row["cell"][0] in scenes])
        if len(cells) == 0:
            continue
        found = table(cells)
        order = sorted(found, key=lambda name: (-found[name]["targets"], -found[name]["damaged"]))
        print(f"\n{label}: {len(cells)} cells of masks")
        keys = [
            *("targets", "damaged", "edges", "worst all", "worst 6", "worst 3", "undamaged worst", "ratio clip"),
            *("ratio orthogonal", "ratio real", "mended damaged", "changed", "mean all", "mean 6", "mean 3"),
        ]
        print(" " * 34 + " ".join(f"{key.replace('undamaged', 'und')[:9]:>9}" for key in keys))
        for name in order:
            print(f"{name:34}" + " ".join(f"{found[name].get(key, math.nan):9.2f}" for key in keys))
        for name in ("consensus", "forced consensus", *(form.name for form in LATER)):
            for key, x in found[name].items():
                if math.isfinite(x):
                    report.add(f"{label}.{name}.{key}", x, "points; ratio; share")
        for kind, gains in by_kind([row for row in rows if row["cell"][0] in scenes]).items():
            report.add(f"{label}.default.{kind}.gain", mean(gains), "points")
            report.add(f"{label}.default.{kind}.worst", min(gains), "points")
        judged = {cell: kept for cell, some in cells.items() if (kept := [row for row in some if "R" in row])}
        for kind, x in (reliabilities(judged) if judged else {}).items():
            print(f"R {kind:12}", {key: round(v, 3) for key, v in x.items()})
            for key, v in x.items():
                report.add(f"{label}.R {kind}.{key}", v, "AUC or accuracy")
    if arguments.output is not None:
        report.write(arguments.output)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rows", type=Path, default=RESULTS / "gate_rows.jsonl")
    parser.add_argument("--output", type=Path)
    main(parser.parse_args())
