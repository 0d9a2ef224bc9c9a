"""Tables of `research.segments`."""

from __future__ import annotations

from research.documents import Document, table

MASK_RULES = {"votes": "votes of views", "sum": "plain sum", "found": "sum where found", "majority": "hard majority"}
MASK_DAMAGES = {
    "m20w10d0": "20 % missing, 10 % wrong", "m0w10d0": "none missing, 10 % wrong",
    "m40w10d0": "40 % missing, 10 % wrong", "m20w0d0": "20 % missing, none wrong",
    "m20w20d0": "20 % missing, 20 % wrong", "m20w10d3": "20 % missing, 10 % wrong, dilated by 3 pixels",
}  # fmt: skip


def over_seeds(found: Document, start: str, end: str) -> list[float]:
    return [x for key, x in found.values.items() if key.startswith(f"{start}.seed") and key.endswith(f".{end}")]


def segments(found: Document) -> str:
    """Return a table of the objects that pass both tests, in the worst and the best seed, and the mean IoU."""
    rows = []
    for damage, title in MASK_DAMAGES.items():
        cells = [title]
        for rule in MASK_RULES:
            passed, iou = (over_seeds(found, f"tabletop.{damage}", f"{key}.{rule}") for key in ("both", "mean"))
            cells.append(f"{min(passed):.0f} to {max(passed):.0f} ({sum(iou) / len(iou):.3f})" if passed else "")
        rows.append(cells)
    return table(["masks", *MASK_RULES.values()], rows)


def segments_objects(found: Document) -> str:
    """Return a table of every object in the worst seed, with figures of single views as means over seeds."""
    start, names = f"tabletop.{next(iter(MASK_DAMAGES))}", []
    for key in found.values:
        if key.startswith(f"{start}.seed0.") and key.endswith(".median"):
            names.append(key.split(".")[3])
    rows = []
    for name in names:
        lifted, plain, median, best = (
            over_seeds(found, start, f"{name}.{rule}") for rule in ("votes", "sum", "median", "best")
        )
        means = (f"{sum(x) / len(x):.3f}" for x in (lifted, median, best))
        rows.append([name, *means, f"{min(lifted):.3f}", f"{min(plain):.3f}"])
    header = [
        "object",
        "lifted",
        "median single view",
        "best single view",
        "lifted, worst seed",
        "plain sum, worst seed",
    ]
    return table(header, rows)
