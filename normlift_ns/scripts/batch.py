"""ns-normlift-batch: run ns-normlift for many captures, with one or several workers."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from normlift_ns.ranges import check_options
from normlift_ns.scripts.captures.listed import read_captures
from normlift_ns.scripts.captures.outcomes import counted, summary, worst
from normlift_ns.scripts.captures.shards import make_shard
from normlift_ns.scripts.captures.work import work
from normlift_ns.scripts.early import readable_file, writable_folder
from normlift_ns.scripts.shared import CONSOLE, run_command, run_process, say


@dataclass
class NormLiftBatch:
    """Lift many captures, each in its own process; several workers may share the list. A rerun skips captures that
    were lifted with the same options."""

    captures: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="CAPTURES")]
    """Text file with one capture per line: the config.yml of a run, a PLY file or a gsplat checkpoint. Options of
    ns-normlift for this capture may follow."""
    options: Annotated[tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="[-- OPTIONS]")] = ()
    """Options of ns-normlift for all captures, after --."""
    results: Path | None = None
    """Folder of results, logs and claims, which all workers share. Default: <name of the list>_batch next to the
    list."""
    shard: str = "auto"
    """Part of the list for this worker. i/n: the i-th of n parts. auto: from SLURM_ARRAY_TASK_ID or from RANK and
    WORLD_SIZE if they are set, else none. none: every capture that no other worker has claimed."""
    patience: float = 120.0
    """Take over another worker's capture after this many seconds without a heartbeat, in 1..86400; use the same value
    for all workers. Larger values tolerate longer pauses but delay the takeover."""

    def __post_init__(self) -> None:
        check_options(self)

    def main(self) -> None:
        """Lift the captures and print the results.

        Raises:
            SystemExit: A capture failed; the exit code is the largest of all captures.
        """
        readable_file(self.captures, "ns-normlift-batch")
        shard = make_shard(self.shard, os.environ)
        all_captures = read_captures(self.captures, self.options)
        captures = [capture for index, capture in enumerate(all_captures) if shard.holds(index)]
        folder = self.results or self.captures.with_name(f"{self.captures.stem}_batch")
        writable_folder(folder, "--results")
        count = f"{len(all_captures)} capture{'' if len(all_captures) == 1 else 's'}"
        part = "" if shard.count == 1 else f", {len(captures)} of them in part {shard.index + 1} of {shard.count}"
        say(f"{count} in {self.captures}{part}; results, logs and claims in {folder}")
        outcomes = work(captures, folder, self.patience, say=say)
        if len(captures) > 0:
            CONSOLE.print(summary(captures, outcomes))
            say(counted(captures, outcomes))
        code = worst(outcomes[capture.key] for capture in captures if capture.key in outcomes)
        if code != 0:
            raise SystemExit(code)


def entrypoint() -> None:
    """Run ns-normlift-batch in a process that continues afterwards."""
    run_command(NormLiftBatch)


def main() -> None:
    """Run ns-normlift-batch as a process."""
    run_process(NormLiftBatch)
