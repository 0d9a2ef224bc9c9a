"""Tables of the grid on which defaults are chosen."""

from __future__ import annotations

from research.documents import Document, table

POINTS = {"mean": "mean", "undamaged": "loss undamaged", "three_views": "loss with 3 views", "worst": "worst loss"}
COSINES = {
    **{f"drift.{key}": f"one Gaussian, two views {key.replace('-', ' to ')} degrees apart"
       for key in ("0-3", "3-6", "6-10", "10-20", "20-30", "30-60", "60-180")},
    "thing.one_view": "two parts of one object, one view",
    "thing.two_views": "two parts of one object, two views",
    "two_things.two_views": "two objects, two views",
    "own": "a feature and its own prompt",
    "wrong": "a feature and the best wrong prompt of 11",
    "spread": "spread of the lifted cosines within an object, as a share of their median",
    "agreement": "agreement B of the regions",
}  # fmt: skip
"""Labels of the rows, by keys of geometry.json without the capture."""
SHARES = {"worse": "worse cells", "column": "worst column", "copied": "copied"}


def verdicts(grid: Document, group: str) -> str:
    """Return a table with the figures of every clause of the rule for every candidate, best mean first."""
    v, start, end = grid.values, f"{group}.", ".eligible"
    keys = [key for key in v if key.startswith(start) and key.endswith(end)]
    units, rows = {metric.key: metric.unit for metric in grid.metrics}, []
    for key in sorted((key.removesuffix(end) for key in keys), key=lambda key: -v[f"{key}.mean"]):
        points = (f"{v[f'{key}.{x}']:.1f}" for x in POINTS)
        shares = (f"{100 * v[f'{key}.{x}']:.0f} %" for x in SHARES)
        rule = "eligible" if v[key + end] else "not: " + units[key + end]
        rows.append((key.removeprefix(start), grid.interval(f"{key}.gain"), *points, *shares, rule))
    return table(("candidate", "gain", *POINTS.values(), *SHARES.values(), "rule"), rows)


def columns(grid: Document, real: Document) -> str:
    """Return a table of the gain, and the gain in the worst cell, by column of the grid, and next to it for statistic
    real."""
    header, rows = _columns(grid)
    last = max((i for i, row in enumerate(rows) if row[0].startswith("statistic: ")), default=-1)
    beside = [row for row in _columns(real)[1] if row[0].startswith("statistic: ")]
    return table(header, [*rows[: last + 1], *beside, *rows[last + 1 :]])


def real_columns(real: Document) -> str:
    """Return the columns of statistic real."""
    header, rows = _columns(real)
    return table(header, [row for row in rows if not row[0].startswith("kind: ")])


def _columns(grid: Document) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    v, start, end = grid.values, "column.", ".gain"
    found = [key for key in v if key.startswith(start) and key.endswith(end)]
    keys = [key.removeprefix(start).removesuffix(end).split(".", 2) for key in found]
    methods, rows = list(dict.fromkeys(method for _, _, method in keys)), []
    for axis, label in dict.fromkeys((axis, label) for axis, label, _ in keys):
        starts = (f"column.{axis}.{label}.{method}" for method in methods)
        rows.append((f"{axis}: {label}", *(f"{v[f'{x}.gain']:+.1f} ({-v[f'{x}.worst']:+.1f})" for x in starts)))
    return ("gain (worst cell)", *methods), rows


def geometry(found: Document) -> str:
    """Return a table of the cosines on both captures."""
    v, rows = found.values, []
    for key, label in COSINES.items():
        captures = (f"{v[x]:.3f}" if (x := f"{capture}.{key}") in v else "" for capture in ("fox", "tabletop"))
        rows.append((label, *captures))
    return table(("", "fox", "tabletop"), rows)
