"""Cost of a query and of a lift compared with another version of the program: whole commands, run in turns.

    git worktree add ../before b9779a0
    python -m research.overhead --before ../before                  a plain room, 15 runs each
    python -m research.overhead --before ../before --config FILE    another trained run
    python -m research.overhead --before ../before --quick          3 runs of a small room

Both versions run in this Python in turns, so that other programs on the machine affect both. Lifts start without
caches, and omit the check of images against renders, which version 0.1 does not have. The spread is half of the
distance between the quartiles. The ratio is the median over pairs of consecutive runs.
"""

from __future__ import annotations

import argparse
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from rich.console import Console
from rich.table import Table

from research.report import RESULTS, Report

HERE = Path(__file__).parents[1]
ON_CPU = {"CUDA_VISIBLE_DEVICES": "", "PYTHONWARNINGS": "ignore"}
SOURCE = ("--encoder", "color", "--device", "cpu")


class Cost(NamedTuple):
    """Cost of one command."""

    wall: float
    """Wall time in seconds."""
    cpu: float
    """CPU time in seconds of all threads, in user and kernel mode."""


def run(
    checkout: Path,
    command: str,
    *flags: object,
    program: str | None = None,
    environment: Mapping[str, str] = {"PYTHONWARNINGS": "ignore"},
) -> Cost:
    """Run one command of the version in a checkout in a separate process, and return its cost.

    Args:
        program: Python code that runs the command, or None for its entry point.
        environment: Additions to the environment of this process.
    """
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(checkout), *_paths()]), **environment}
    program = program or f"from normlift_ns.cli.start import {command}; {command}()"
    words = [sys.executable, "-P", "-c", program] if sys.version_info >= (3, 11) else [sys.executable, "-c", program]
    with tempfile.TemporaryFile() as log:
        start = time.perf_counter()
        process = subprocess.Popen(
            [*words, *map(str, flags)], cwd=checkout, env=environment, stdout=log, stderr=subprocess.STDOUT
        )
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        wall = time.perf_counter() - start
        if process.returncode != 0:
            log.seek(0)
            sys.exit(f"{checkout}: {command} {' '.join(map(str, flags))}\n{log.read().decode()[-3000:]}")
    return Cost(wall, usage.ru_utime + usage.ru_stime)


def _paths() -> list[str]:
    """Return the folders in PYTHONPATH except for this checkout."""
    return [path for path in os.environ.get("PYTHONPATH", "").split(os.pathsep) if path and Path(path) != HERE]


def in_turns(checkouts: dict[str, Path], repeats: int, action) -> dict[str, list[Cost]]:
    """Return the costs of an action of (name, checkout), after a warm-up round; the order alternates."""
    found: dict[str, list[Cost]] = {name: [] for name in checkouts}
    for turn in range(repeats + 1):
        names = list(checkouts) if turn % 2 else list(reversed(checkouts))
        for name in names:
            cost = action(name, checkouts[name])
            if turn > 0:
                found[name].append(cost)
    return found


def spread(values: list[float]) -> float:
    """Return half of the distance between the quartiles."""
    low, _, high = statistics.quantiles(values, n=4)
    return (high - low) / 2


def demo(folder: Path, gaussians: int) -> Path:
    """Return the config.yml of a trained plain room."""
    from normlift_ns.demo.capture import write_capture, write_splatfacto_run  # noqa: PLC0415 (nerfstudio)
    from tests.plain_room import plain_room  # noqa: PLC0415 (nerfstudio)

    room = plain_room(gaussians)
    write_capture(room, folder / "room", views=12, held_out=2, width=320, height=240)
    return write_splatfacto_run(room, folder / "room", folder / "outputs")


def main(before: Path, config: Path | None, repeats: int, gaussians: int, output: Path) -> None:
    report, checkouts = Report("overhead"), {"before": before.absolute(), "now": HERE}
    table = Table("command", "before, s", "now, s", "change", title="medians and half of the quartiles' distance")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        trained = demo(folder, gaussians) if config is None else config.absolute()

        def lift(name: str, checkout: Path) -> Cost:
            target = folder / name
            shutil.rmtree(target, ignore_errors=True)
            check = ("--check-alignment", False) if name == "now" else ()
            flags = ("--load-config", trained, *SOURCE, "--output-dir", target, "--timestamp", "run", *check)
            return run(checkout, "lift", *flags, environment=ON_CPU)

        def query(name: str, checkout: Path) -> Cost:
            (lifted,) = (folder / name).glob("*/normlift/run/config.yml")
            return run(
                checkout, "query", "--load-config", lifted, "--text", "red", "--device", "cpu", environment=ON_CPU
            )

        for what, action in (("lift", lift), ("query", query)):
            found = in_turns(checkouts, repeats, action)
            for kind in Cost._fields:
                old, new = ([getattr(cost, kind) for cost in found[version]] for version in checkouts)
                change = statistics.median(b / a for a, b in zip(old, new)) - 1
                cells = []
                for version, values in (("before", old), ("now", new)):
                    middle, around = statistics.median(values), spread(values)
                    report.add(f"{what}_{kind}_{version}", middle, "s")
                    report.add(f"{what}_{kind}_{version}_spread", around, "s")
                    cells.append(f"{middle:.2f} ± {around:.2f}")
                report.add(f"{what}_{kind}_change", change, "share")
                table.add_row(f"{what}, {kind}", *cells, f"{change:+.1%}")
    report.write(output)
    Console(width=120).print(table)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--before", type=Path, required=True, help="checkout of the version to compare with")
    parser.add_argument("--config", type=Path, help="config.yml of a trained run; by default that of a plain room")
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--quick", action="store_true", help="3 runs of a small room")
    parser.add_argument("--output", type=Path, default=RESULTS, help="folder of the JSON file")
    arguments = parser.parse_args()
    repeats, gaussians = (3, 6000) if arguments.quick else (arguments.repeats, 30_000)
    main(arguments.before, arguments.config, repeats, gaussians, arguments.output)
