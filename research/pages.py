"""Update of the tables of the pages in `PAGES`, and of the plots, from research/results/*.json.

    python -m research.pages            writes tables and plots
    python -m research.pages --check    writes nothing; fails and lists the tables that are out of date, if any

A table stands between the lines `<!-- table: NAME -->` and `<!-- end -->`; `research.tables` has the names. All other
text of a page is written by hand and does not change.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path

from research.documents import documents
from research.plots import DOCS, plots
from research.tables import tables

PAGES = (
    "docs/accuracy.md",
    "docs/speed_and_error.md",
    "docs/numerics.md",
    "docs/reliability.md",
    "docs/front_ends.md",
    "docs/check.md",
    "docs/splats.md",
    "docs/paper.md",
    "research/studies.md",
)
MARKER = re.compile(r"<!-- (?:table: (?P<name>[\w-]+)|end) -->")
LIKE_A_MARKER = re.compile(r"<!--\s*(table|end)\b", re.IGNORECASE)


class MarkerError(ValueError):
    """Error for a marker that is misspelled, names no table, or has no partner."""


@dataclass(frozen=True)
class Part:
    """Consecutive lines of a page."""

    text: str
    table: str | None = None
    """Name of the table in these lines, or None for text written by hand and for markers."""


def split(text: str, names: Collection[str]) -> list[Part]:
    """Return the parts of a page in order; together, they are the whole page.

    Raises:
        MarkerError: If a marker is misspelled, names no table, or has no partner. The message contains its line.
    """
    parts, lines, opened = [], [], None
    for number, line in enumerate(text.splitlines(keepends=True), start=1):
        marker = MARKER.fullmatch(line.rstrip())
        if marker is None:
            if LIKE_A_MARKER.search(line):
                raise MarkerError(f"line {number}: write <!-- table: NAME --> or <!-- end -->, not {line.strip()}")
            lines.append(line)
            continue
        name = marker["name"]
        if name is None and opened is None:
            raise MarkerError(f"line {number}: <!-- end --> without a table before it")
        if name is not None and opened is not None:
            raise MarkerError(f"line {number}: table {name} starts before the end of table {opened}")
        if name is not None and name not in names:
            raise MarkerError(f"line {number}: there is no table {name}; choose one of: {', '.join(sorted(names))}")
        if name is None:
            parts.append(Part("".join(lines), opened))
            lines = [line]
        else:
            parts.append(Part("".join([*lines, line])))
            lines = []
        opened = name
    if opened is not None:
        raise MarkerError(f"table {opened} has no <!-- end -->")
    return [*parts, Part("".join(lines))]


def outdated(text: str, made: Mapping[str, str]) -> list[str]:
    """Return the names of the tables of a page that are out of date."""
    return [part.table for part in split(text, made) if part.table is not None and part.text != made[part.table]]


def refreshed(text: str, made: Mapping[str, str]) -> str:
    """Return the page with current tables."""
    return "".join(part.text if part.table is None else made[part.table] for part in split(text, made))


def main(check: bool, folder: Path = DOCS.parent) -> None:
    found = documents()
    made, stale, new = tables(found), [], {}
    for path in (folder / name for name in PAGES):
        text = path.read_bytes().decode()
        try:
            stale += [f"{path.name}: table {name} is out of date" for name in outdated(text, made)]
            new[path] = refreshed(text, made).encode()
        except MarkerError as error:
            sys.exit(f"{path.name}, {error}")
    if check:
        if stale:
            sys.exit("\n".join([*stale, "Refresh with: python -m research.pages"]))
        return
    for path, content in new.items():
        path.write_bytes(content)
    print("Written: " + ", ".join(map(str, [*new, *plots(found, folder / DOCS.name)])))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="write nothing; fail if a table is out of date")
    main(parser.parse_args().check)
