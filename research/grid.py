"""Grid of cells on which defaults are chosen among `research.candidates`, by the rule of `research.rule`.

    python -m research.grid                       all scenes, every Gaussian votes; for a GPU
    python -m research.grid --minutes 9           start no cell after this many minutes; repeat to continue
    python -m research.grid --voters 400 --views 22 --gaussians 20000 --scenes demo second third
                                                    for CPUs: a sample votes and counts
    python -m research.grid --statistic real      cells of statistic real, which decide nothing: results/grid_real.json
    python -m research.grid --quick               a small plain room, three cells per kind of region, for the tests

Each finished cell is one line of the file `--rows`, which later calls read first. The current decision is always
printed. results/grid.json is written if no cell is missing, or with `--report`.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch

from research.candidates import CANDIDATES
from research.cells import Place, Settings, Site
from research.grid_report import report_of, show
from research.report import RESULTS
from research.rows import append, read_rows
from research.rule import CHOICE, CONFIRMATION, REAL, SEEDS, Cell, cells_of, real_cells_of

CHUNK = 50
"""Number of cells of one place that a worker takes at a time. The worker builds the place first."""
QUICK = Settings(voters=80, gaussians=2500, pieces=30, room_views=8, room_width=160)
QUICK_CELLS = (
    ("masks", "clip", "noise only"), ("masks", "clip", "group"), ("masks", "histogram", "arc"),
    ("superpixels", "histogram", "mild"), ("grid", "clip", "dropped masks"), ("patches", "clip", "noise"),
)  # fmt: skip


def finished(path: Path, run: dict[str, Any]) -> dict[Cell, dict[str, Any]]:
    """Return the rows of the finished cells. Raises the same errors as `read_rows`."""
    return {Cell(*row["cell"]): row for row in read_rows(path, run)}


@lru_cache(maxsize=1)
def site_of(place: Place, settings: Settings) -> Site:
    """Return the site of a place; the last one is cached."""
    return Site(place, settings)


@torch.no_grad()
def run_cells(cells: Sequence[Cell], settings: Settings, seeds: Sequence[int], path: Path, deadline: float) -> int:
    """Run cells of one place until the deadline (`time.time`), and return their number."""
    for done, cell in enumerate(cells):
        if time.time() > deadline:
            return done
        site = site_of(Place.of(cell), settings)
        start = time.perf_counter()
        found = [site.run(cell, seed, CANDIDATES) for seed in seeds]
        seconds = time.perf_counter() - start
        values = {key: {one.name: [getattr(x[one.name], key) for x in found] for one in CANDIDATES}
                  for key in ("miou", "copied")}  # fmt: skip
        append(path, {"cell": list(cell), "seconds": round(seconds, 3), "voters": len(site.voters.truth), **values})
        print(f"{seconds:6.2f} s  {', '.join(cell)}", flush=True)
    return len(cells)


def chunks(cells: Sequence[Cell]) -> Iterator[list[Cell]]:
    """Yield up to `CHUNK` cells of one place at a time."""
    places: dict[Place, list[Cell]] = {}
    for cell in cells:
        places.setdefault(Place.of(cell), []).append(cell)
    for some in places.values():
        for first in range(0, len(some), CHUNK):
            yield some[first : first + CHUNK]


def run_all(
    missing: Sequence[Cell], settings: Settings, seeds: Sequence[int], path: Path, workers: int, deadline: float
) -> None:
    """Run all cells, in several processes if `workers` is above 1."""
    jobs = [(some, settings, seeds, path, deadline) for some in chunks(missing)]
    if workers == 1:
        for job in jobs:
            run_cells(*job)
        return
    threads = max(1, (os.cpu_count() or 1) // workers)
    context = multiprocessing.get_context("spawn")
    with context.Pool(workers, initializer=torch.set_num_threads, initargs=(threads,)) as pool:
        pool.starmap(run_cells, jobs, chunksize=1)


def cells_to_run(scenes: Sequence[str], quick: bool, real: bool) -> list[Cell]:
    """Return all cells of the scenes, or a few of them if `quick` is True."""
    cells = [cell for scene in scenes for cell in (real_cells_of if real else cells_of)(scene)]
    few = [(kind, REAL if real else statistic, damage) for kind, statistic, damage in QUICK_CELLS]
    return [cell for cell in cells if not quick or (cell[1:4] in few and cell.views in ("all", "3"))]


@torch.no_grad()
def main(arguments: argparse.Namespace) -> None:
    start = time.time()
    device = "cuda" if torch.cuda.is_available() else "cpu"
    given = {key: getattr(arguments, key) for key in ("voters", "gaussians", "views", "room_views", "pieces")}
    settings = replace(QUICK if arguments.quick else Settings(**given), device=device)
    scenes = ["demo"] if arguments.quick else arguments.scenes
    seeds = SEEDS[:2] if arguments.quick else SEEDS
    names = [one.name for one in CANDIDATES]
    sizes = {key: value for key, value in asdict(settings).items() if key != "device"}
    real = arguments.statistic == REAL
    cells = cells_to_run(scenes, arguments.quick, real)
    rows = finished(arguments.rows, run := {"seeds": list(seeds), "candidates": names, **sizes})
    missing = [cell for cell in cells if cell not in rows]
    print(f"{len(cells)} cells of {len(seeds)} seeds, {len(cells) - len(missing)} of them finished before", flush=True)
    deadline = start + 60 * arguments.minutes if arguments.minutes is not None else float("inf")
    run_all(missing, settings, seeds, arguments.rows, arguments.workers, deadline)
    rows = {cell: row for cell, row in finished(arguments.rows, run).items() if cell in set(cells)}
    spent = sum(row["seconds"] for row in rows.values())
    print(
        f"{len(rows)} of {len(cells)} cells finished; {spent:.0f} s in cells, {time.time() - start:.0f} s in this call"
    )
    if len(rows) == 0:
        sys.exit("no cell is finished; repeat the command, with more --minutes")
    report = report_of(rows, names, len(cells), sizes, real=real)
    if len(rows) == len(cells) or arguments.report:
        report.write(arguments.output)
    show(report, names)
    if len(rows) < len(cells):
        print("There is no decision yet, because cells are missing. Repeat the command to continue.")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=[*CHOICE, *CONFIRMATION], choices=[*CHOICE, *CONFIRMATION])
    parser.add_argument("--statistic", choices=[REAL], help="run the cells of this statistic instead of the grid's")
    parser.add_argument("--voters", type=int, help="Gaussians of a scene that vote and count; all by default")
    parser.add_argument("--gaussians", type=int, help="Gaussians of each room; 40,000 by default")
    parser.add_argument("--views", type=int, help="training views of the tabletop; all by default")
    parser.add_argument("--room-views", type=int, help="training views of each room; 24 and 30 by default")
    parser.add_argument("--pieces", type=int, help="superpixels, cells or patches per image; 256, 256, 1024 by default")
    parser.add_argument("--workers", type=int, default=1, help="processes that run cells")
    parser.add_argument("--minutes", type=float, help="minutes after which no cell starts")
    parser.add_argument("--quick", action="store_true", help="a few cells of a small plain room")
    parser.add_argument("--report", action="store_true", help="write the report even if cells are missing")
    parser.add_argument("--rows", type=Path, default=RESULTS / "grid_rows.jsonl", help="file of finished cells")
    parser.add_argument("--output", type=Path, default=RESULTS, help="folder of the report")
    main(parser.parse_args())
