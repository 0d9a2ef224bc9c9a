"""ns-normlift-batch: ns-normlift for many captures, by one worker or several."""

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
    """Lift many captures, each in a process of its own; several workers may share the list. What is lifted already
    with the same options is skipped, so that a rerun does only what is missing."""

    captures: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="CAPTURES")]
    """Text file, one capture per line: the config.yml of a run, a PLY file or a checkpoint of gsplat, and perhaps
    options of ns-normlift for that one."""
    options: Annotated[tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="[-- OPTIONS]")] = ()
    """After --: options of ns-normlift for all captures."""
    results: Path | None = None
    """Folder of results, logs and claims, which the workers share. By default <name of the list>_batch beside it."""
    shard: str = "auto"
    """Which part of the list is this worker's. i/n: the i-th of n parts. auto: by SLURM_ARRAY_TASK_ID or by RANK and
    WORLD_SIZE where they are set, else as none. none: every capture that no other worker has claimed."""
    patience: float = 120.0
    """Seconds without a sign of life after which the capture of another worker is taken over; the same for all
    workers."""

    def __post_init__(self) -> None:
        check_options(self)

    def main(self) -> None:
        """Lifts, and shows what came of it.

        Raises:
            SystemExit: a capture failed; with the largest exit code.
        """
        readable_file(self.captures, "ns-normlift-batch")
        part = make_shard(self.shard, os.environ)
        listed = read_captures(self.captures, self.options)
        captures = [capture for position, capture in enumerate(listed) if part.holds(position)]
        folder = self.results or self.captures.with_name(f"{self.captures.stem}_batch")
        writable_folder(folder, "--results")
        number = f"{len(listed)} capture{'' if len(listed) == 1 else 's'}"
        which = "" if part.count == 1 else f", {len(captures)} of them in part {part.index + 1} of {part.count}"
        say(f"{number} in {self.captures}{which}; results, logs and claims in {folder}")
        outcomes = work(captures, folder, self.patience, say=say)
        if len(captures) > 0:
            CONSOLE.print(summary(captures, outcomes))
            say(counted(captures, outcomes))
        code = worst(outcomes[capture.key] for capture in captures if capture.key in outcomes)
        if code != 0:
            raise SystemExit(code)


def entrypoint() -> None:
    """ns-normlift-batch, in a process that goes on."""
    run_command(NormLiftBatch)


def main() -> None:
    """Entry point of ns-normlift-batch."""
    run_process(NormLiftBatch)
