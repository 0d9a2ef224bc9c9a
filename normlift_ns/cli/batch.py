"""ns-normlift-batch: lift many captures with one or several workers.

The name of a run in a batch contains a digest of the scene and the options. The same capture and options always give
the same name, so workers recognize finished runs and skip them.
"""

from __future__ import annotations

import json
import os
import re
import secrets
import shlex
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from rich.table import Table

from normlift_ns.cli.common import CONSOLE, info, info_progress, parse_flags, plain_text, run_command
from normlift_ns.cli.lift import NormLift
from normlift_ns.cli.preflight import check_readable_file, check_writable_folder
from normlift_ns.distributed.launch import TORCHRUN_VARIABLES, describe_signal, end_processes, exit_with_parent
from normlift_ns.errors import InputError, escape_unprintable
from normlift_ns.io import file_lock
from normlift_ns.io.atomic import safe_file_name, text_digest
from normlift_ns.io.guard import read_file, read_text
from normlift_ns.io.run_dir import FIELD_FOLDER, LIFT_AGAIN, read_manifest, run_directory
from normlift_ns.options import CheckedOptions, names_of_0_2, short_repr

_PREFIX = "batch_"
_SOURCES = {".pt": "load_gsplat", **dict.fromkeys((".ply", ".spz", ".splat", ".glb", ".gltf"), "load_ply")}
"""Option of ns-normlift for a path, by the suffix of the path. Paths with other suffixes are configs."""
_SOURCE_NAMES = ("load_config", "load_ply", "load_gsplat")
_NOT_IN_KEY = ("device", "timestamp", "output_dir")
"""Options that do not change the result of a lift, but only its device or its location."""
_KEY_LENGTH = 16


@dataclass(frozen=True)
class Capture:
    """Entry of a capture list."""

    name: str
    """Line of the capture list that defines this capture."""
    arguments: tuple[str, ...]
    """Arguments of ns-normlift, including the name of the new run."""
    key: str
    """Digest of scene and options, 16 hexadecimal digits."""
    run_dir: Path | None
    """Directory of the lifted run; None if it is not known before the capture is opened."""


def read_captures(path: Path, options: Sequence[str]) -> tuple[Capture, ...]:
    """Read a capture list, and return its captures in order.

    Args:
        path: Text file. Each line has the path of a config.yml, a splat file or a gsplat checkpoint. Options of
            ns-normlift, quoted as in a shell, may follow the path or replace it. Empty lines and lines that start with
            # are ignored.
        options: Options of ns-normlift for all captures. The options of a line override them.
    Raises:
        FileNotFoundError: The file does not exist.
        InputError: The file is not UTF-8 text or lists no captures, `options` are invalid, or a line is invalid or a
            duplicate.
    """
    try:
        common = _parse(options)
    except InputError as error:
        raise InputError(f"Options after --: {error}") from None
    if (name := next((name for name in _SOURCE_NAMES if getattr(common, name) is not None), None)) is not None:
        raise InputError(
            f"--{name.replace('_', '-')} is given after --, but options there apply to every capture. Write this "
            f"option into {path}, with one line per capture."
        )
    try:
        text = read_text(path, "utf-8-sig")
    except UnicodeDecodeError:
        raise InputError(f"{path} is not UTF-8 text. Give a list of captures with one path per line.") from None
    captures: dict[str, tuple[int, Capture]] = {}
    for number, line in enumerate(map(str.strip, text.splitlines()), start=1):
        if line == "" or line.startswith("#"):
            continue
        capture = _make_capture(line, options, common, f"{path}, line {number}")
        if capture.key in captures:
            raise InputError(
                f"{path}, line {number}, has the same capture and options as line {captures[capture.key][0]}: "
                f"{escape_unprintable(line)}. Remove one of the two lines."
            )
        captures[capture.key] = number, capture
    if len(captures) == 0:
        raise InputError(f"{path} lists no captures. Write one path per line, such as outputs/…/config.yml.")
    return tuple(capture for _, capture in captures.values())


def is_lifted(run: Path) -> bool:
    """Return True if a lifted run with a valid manifest exists; False if the path does not exist.

    Raises:
        InputError: The path exists, but is not a lifted run or is a damaged one.
    """
    if not os.path.lexists(run):
        return False
    try:
        read_manifest(run / FIELD_FOLDER)
    except (InputError, OSError) as error:
        problem = str(error).removesuffix(f"; {LIFT_AGAIN}")
        raise InputError(f"{problem}. To lift the capture again, delete {run} and rerun the command.") from error
    return True


def _capture_key(command: NormLift) -> str:
    """Return a digest of the scene and the options of a lift, 16 hexadecimal digits.

    The digest includes the path of the scene, and the name and size of the given splat file or of the checkpoint. For
    folders of features, label maps and weights, it includes only the paths.
    """
    options = {name: value for name, value in names_of_0_2(command).items() if name not in _NOT_IN_KEY}
    options["splat"] = _splat_options_of_0_2(options["splat"])
    options["lift"] = _lift_options_of_0_2(options["lift"])
    files = [path for path in (command.load_ply, command.load_gsplat) if path is not None]
    if command.load_config is not None:
        step = "*" if command.load_step is None else f"{command.load_step:09d}"
        folder = command.load_config.absolute().parent / "nerfstudio_models"
        files = sorted(folder.glob(f"step-{step}.ckpt"))[-1:]
    sizes = [(file.name, file.stat().st_size) for file in files if file.is_file()]
    text = json.dumps([options, sizes], sort_keys=True, default=os.path.abspath)  # only paths need the default
    return text_digest(text).rpartition(":")[2][:_KEY_LENGTH]


def _splat_options_of_0_2(values: Mapping[str, Any]) -> dict[str, Any]:
    """Convert options of a splat to their form in capture keys of version 0.2, so that old batches stay valid."""
    new = {name: value for name, value in values.items() if name == "primitive" and value is not None}
    if values["world_transform"] is None:
        new["search"] = False
    world, background = values["world_transform"], values["background"] or "black"
    old = {name: value for name, value in values.items() if name != "primitive"}
    return {**old, "world_transform": None if world == "auto" else world, "background": background, **new}


def _lift_options_of_0_2(values: Mapping[str, Any]) -> dict[str, Any]:
    """Convert options of a lift to their form in capture keys of version 0.2.

    The result leaves out options that version 0.2 does not have, unless they are set and change the lift.
    """
    old = {name: value for name, value in values.items() if name not in ("reliability", "recognition")}
    if old["consensus_least"] is None:
        old["consensus_least"] = 0.4
    old["vote"] = {name: value for name, value in values["vote"].items() if name != "min_labeled" or value is not None}
    return old if values["reliability"] == "paper" else {**old, "reliability": values["reliability"]}


def _make_capture(line: str, options: Sequence[str], common: NormLift, location: str) -> Capture:
    try:
        first, *rest = shlex.split(line)
    except ValueError as error:
        raise InputError(
            f"{location}: {escape_unprintable(line)} is not quoted correctly ({error}). Correct its quotes "
            "and backslashes."
        ) from None
    source = None if first.startswith("--") else _SOURCES.get(Path(first).suffix.lower(), "load_config")
    own = [first, *rest] if source is None else [f"--{source.replace('_', '-')}", first, *rest]
    try:
        if source is None or len(rest) > 0:
            command = _parse([*options, *own])
        else:  # lines without options avoid tyro, which is slow
            changed: dict[str, Any] = {source: Path(first)}
            command = replace(common, **changed)
    except InputError as error:
        raise InputError(f"{location}: {error}") from None
    key = _capture_key(command)
    timestamp, run_dir = f"{_PREFIX}{key}", None
    with suppress(InputError, OSError):  # the process of this capture reports the error
        name, outputs = command.new_run_location()
        run_dir = None if name is None or outputs is None else run_directory(outputs, name, timestamp)
    return Capture(line, (*options, *own, "--timestamp", timestamp), key, run_dir)


def _parse(words: Sequence[str]) -> NormLift:
    """Parse the arguments of ns-normlift.

    Raises:
        InputError: An argument is not valid for ns-normlift, or not supported in a batch.
    """
    if {"-h", "--help"} & set(words):
        raise InputError("--help is not supported in a batch; for the options of a capture, run ns-normlift --help")
    try:
        command = parse_flags(NormLift, words, name="ns-normlift")
    except InputError as error:
        raise InputError(f"invalid options of ns-normlift: {escape_unprintable(shlex.join(words))}. {error}") from None
    if command.timestamp is not None or command.overwrite:
        flag = "--overwrite" if command.overwrite else "--timestamp"
        raise InputError(
            f"{flag} is not supported in a batch, which names runs by their options and lifts only missing runs. Leave "
            "it out. To lift a capture again, delete its run."
        )
    return command


_MAX_SHARDS = 10**6
_TASK_ID, _TASK_COUNT, _TASK_MIN, _TASK_STEP = (f"SLURM_ARRAY_TASK_{name}" for name in ("ID", "COUNT", "MIN", "STEP"))


@dataclass(frozen=True)
class Shard:
    """Part of a list that is divided into `count` parts."""

    index: int
    """Number of the part, from 0."""
    count: int

    def contains(self, position: int) -> bool:
        """Return True if a position in the list, from 0, belongs to this part. Parts do not overlap.

        >>> [position for position in range(7) if Shard(1, 3).contains(position)]
        [1, 4]
        """
        return position % self.count == self.index


WHOLE_LIST = Shard(0, 1)


def make_shard(word: str, environment: Mapping[str, str]) -> Shard:
    """Return the part that --shard or the environment selects.

    In a Slurm array whose tasks have several ranks (RANK, WORLD_SIZE), each rank of each task has its own part.

    Args:
        word: Value of --shard: auto for the part that the environment defines, none for the whole list, or i/n for the
            i-th of n parts.
        environment: Environment variables.
    Raises:
        InputError: The word is invalid, variables contradict each other, or a Slurm array has gaps.

    >>> make_shard("2/3", {}), make_shard("auto", {"RANK": "0", "WORLD_SIZE": "4"}), make_shard("auto", {})
    (Shard(index=1, count=3), Shard(index=0, count=4), Shard(index=0, count=1))
    """
    if word == "none":
        return WHOLE_LIST
    if word == "auto":
        task, rank = _slurm_shard(environment), _rank_shard(environment)
        return Shard(task.index * rank.count + rank.index, task.count * rank.count)
    match = re.fullmatch(r"(\d{1,7})/(\d{1,7})", word, re.ASCII)
    if match is None or not 1 <= int(match[1]) <= int(match[2]) <= _MAX_SHARDS:
        raise InputError(
            f"--shard must be auto, none, or i/n for the i-th of n parts, where 1 <= i <= n <= {_MAX_SHARDS:,}, got "
            f"{short_repr(word)}. For example, give --shard 2/4 to the second of four workers."
        )
    return Shard(int(match[1]) - 1, int(match[2]))


def _slurm_shard(environment: Mapping[str, str]) -> Shard:
    if _TASK_ID not in environment:
        return WHOLE_LIST
    if _TASK_COUNT not in environment:
        raise InputError(f"{_TASK_ID} is set, but {_TASK_COUNT} is not. Set both, or give the part with --shard i/n.")
    task, count = _integer(environment, _TASK_ID, 0), _integer(environment, _TASK_COUNT, 1)
    first, step = _integer(environment, _TASK_MIN, 0, "0"), _integer(environment, _TASK_STEP, 1, "1")
    index, remainder = divmod(task - first, step)
    if remainder != 0 or not 0 <= index < count:
        raise InputError(
            f"{_TASK_ID} is {task}, but an array without gaps has no such task if {_TASK_COUNT} is {count}, "
            f"{_TASK_MIN} is {first} and {_TASK_STEP} is {step}. Submit an array without gaps, such as sbatch -a 0-7, "
            "or give --shard none to let workers claim captures in a shared folder."
        )
    return Shard(index, count)


def _rank_shard(environment: Mapping[str, str]) -> Shard:
    present = [name for name in ("RANK", "WORLD_SIZE") if name in environment]
    if len(present) == 0:
        return WHOLE_LIST
    if len(present) == 1:
        missing = "RANK" if present == ["WORLD_SIZE"] else "WORLD_SIZE"
        raise InputError(f"{present[0]} is set, but {missing} is not. Set both, or give the part with --shard i/n.")
    rank, count = _integer(environment, "RANK", 0), _integer(environment, "WORLD_SIZE", 1)
    if rank >= count:
        raise InputError(f"RANK is {rank}, but must be less than WORLD_SIZE, {count}. Correct it, or give --shard i/n.")
    return Shard(rank, count)


def _integer(environment: Mapping[str, str], name: str, least: int, default: str = "") -> int:
    text = environment.get(name, default)
    if not re.fullmatch(r"\d{1,7}", text, re.ASCII) or int(text) < least:
        raise InputError(
            f"{name} must be a whole number, at least {least} and at most 9,999,999, got {short_repr(text)}. Correct "
            "it, or give the part with --shard i/n."
        )
    return int(text)


# Results of captures: one line of JSON each, and a table.


OutcomeState = Literal["done", "failed", "skipped"]
_STATE_NAMES: dict[OutcomeState, str] = {"done": "lifted", "skipped": "already lifted", "failed": "failed"}
"""Names of outcome states in messages."""


@dataclass(frozen=True)
class Outcome:
    """Result of one attempt to lift a capture."""

    capture: str
    """Line of the capture list that defines the capture."""
    key: str
    """Digest of scene and options."""
    attempt: int
    """Number of the attempt from 1, counted over all workers."""
    state: OutcomeState
    """done, failed, or skipped if the capture was already lifted."""
    seconds: float
    """Duration of the attempt."""
    message: str
    """Reason for the failure; empty if the attempt did not fail."""
    code: int
    """0 unless the attempt failed. For a failed process, its exit code, or 128 plus the number of the signal that
    killed it. For a damaged run directory, 1."""
    run: str | None
    """Directory of the lifted run; None if the attempt failed or the directory is not known."""
    worker: str
    """Name of the worker."""
    time: float
    """End of the attempt in seconds since 1970, by the clock of the worker."""


def latest_outcomes(outcomes: Iterable[Outcome]) -> dict[str, Outcome]:
    """Return the last outcome of each capture by key. A later skip does not replace a completed lift.

    >>> done = Outcome("fox", "a", 1, "done", 41.0, "", code=0, run=None, worker="one", time=1.0)
    >>> skipped = Outcome("fox", "a", 2, "skipped", 0.0, "", code=0, run=None, worker="two", time=2.0)
    >>> latest_outcomes([skipped, done])["a"].state
    'done'
    """
    by_key: dict[str, Outcome] = {}
    for outcome in sorted(outcomes, key=lambda outcome: (outcome.attempt, outcome.time)):
        previous = by_key.get(outcome.key)
        if previous is None or outcome.state != "skipped" or previous.state != "done":
            by_key[outcome.key] = outcome
    return by_key


def largest_exit_code(outcomes: Iterable[Outcome]) -> int:
    """Return the largest exit code of failed captures; 0 if none failed."""
    return max((outcome.code for outcome in outcomes if outcome.state == "failed"), default=0)


def outcomes_table(captures: Sequence[Capture], outcomes: Mapping[str, Outcome]) -> Table:
    """Return a table with one row per capture, in the order of the list."""
    table = Table(box=None, padding=(0, 2, 0, 0))
    for title in ("capture", "state", "seconds", "run, or error"):
        table.add_column(title, justify="right" if title == "seconds" else "left", overflow="fold")
    for capture in captures:
        outcome = outcomes.get(capture.key)
        if outcome is None:
            table.add_row(plain_text(capture.name), "unknown", "", "the results were deleted")
        else:
            text = outcome.message if outcome.state == "failed" else outcome.run or ""
            table.add_row(plain_text(capture.name), outcome.state, f"{outcome.seconds:.1f}", plain_text(text))
    return table


LIFT_COMMAND = (sys.executable, "-m", "normlift_ns.cli.lift")
"""Command of ns-normlift in this installation."""
_GRACE = 30.0
"""Seconds that a process has to terminate before it is killed."""


def run_logged(command: Sequence[str], log: Path, on_tick: Callable[[], bool], interval: float) -> int | None:
    """Run a program and write its output to a log file.

    On Linux, the program always ends with this process. On other systems, it ends only if Ctrl-C or SIGTERM ends this
    process.

    Args:
        command: Command line of the program.
        log: File for the output; an existing file is replaced.
        on_tick: Callback; if it returns False, the program is terminated.
        interval: Seconds between two calls of `on_tick`.
    Returns:
        The exit code, the negative number of the signal that killed the program, or None if `on_tick` returned False.
    Raises:
        OSError: The program cannot be started, or the log cannot be written.
    """
    inherited = {name: value for name, value in os.environ.items() if name not in TORCHRUN_VARIABLES}
    environment = inherited | {"PYTHONUNBUFFERED": "1", "PYTHONIOENCODING": "utf-8"}  # keeps the last line complete
    log.unlink(missing_ok=True)
    with (
        log.open("xb") as output,  # a new file, never a pipe or the target of a link
        subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            env=environment,
            preexec_fn=exit_with_parent(),  # noqa: PLW1509 (workers have no threads)
        ) as process,
    ):
        try:
            while True:
                with suppress(subprocess.TimeoutExpired):
                    return process.wait(interval)
                if not on_tick():
                    return None
        finally:  # also after Ctrl-C or SIGTERM
            end_processes([process], _GRACE)


def failure_reason(code: int, log: Path) -> str:
    """Return the reason why a process failed: the signal that killed it, or the last line of its output."""
    if code < 0:
        return f"the process was killed by {describe_signal(-code)}; see its output in {log}"
    lines = map(str.strip, read_file(log, max_bytes=2**31).decode("utf8", "replace").split("\n"))
    *_, last = (f"the process ended with exit code {code} without output", *filter(None, lines))
    return last


_CLAIMS, _LOGS = "claims", "logs"
"""Names of the subfolders of the results folder."""


def lift_captures(
    captures: Sequence[Capture],
    folder: Path,
    timeout: float,
    *,
    on_message: Callable[[str], None] = lambda text: None,
    command: Sequence[str] = LIFT_COMMAND,
) -> dict[str, Outcome]:
    """Lift the captures that are neither lifted nor claimed by a live worker, and wait until all lifts have ended.

    Args:
        captures: Captures of this worker.
        folder: Folder of claims and results, which all workers share. It is created if missing.
        timeout: Seconds without a heartbeat after which a worker counts as dead, the same for all workers.
        on_message: Callback for messages about each capture.
        command: Command of ns-normlift.
    Returns:
        The latest outcome of each capture with a result in the folder, by key.
    Raises:
        OSError: The folder cannot be written.
    """
    worker = f"{safe_file_name(socket.gethostname())}_{os.getpid()}_{secrets.token_hex(4)}"
    for name in (_CLAIMS, _LOGS):
        (folder / name).mkdir(parents=True, exist_ok=True)
    at_start = file_lock.read_claim_states(folder / _CLAIMS)
    previous = latest_outcomes(file_lock.read_jsonl(folder, Outcome))
    missing = {capture.key: capture for capture in captures if not _is_complete(capture, previous)}
    for claim in file_lock.iter_claims(folder / _CLAIMS, list(missing), at_start, timeout):
        capture = missing[claim.key]
        try:
            on_message(f"{capture.name} …")
            outcome = _lift_capture(capture, claim, folder, timeout, worker, command)
        except BaseException:
            file_lock.finish_claim(claim, file_lock.ABANDONED)
            raise
        if outcome is None:
            on_message(f"{capture.name}: taken over by another worker, which received no heartbeat from this worker")
            continue
        file_lock.append_jsonl(folder / f"{worker}{file_lock.JSONL_SUFFIX}", outcome)
        file_lock.finish_claim(claim, outcome.state)
        reason = f": {outcome.message}" if outcome.state == "failed" else ""
        on_message(f"{capture.name}: {_STATE_NAMES[outcome.state]}{reason} ({outcome.seconds:.1f} s)")
    return latest_outcomes(file_lock.read_jsonl(folder, Outcome))


def _is_complete(capture: Capture, outcomes: dict[str, Outcome]) -> bool:
    """Return True if a capture is lifted and its result is recorded."""
    outcome = outcomes.get(capture.key)
    if outcome is None or outcome.state == "failed":
        return False
    with suppress(InputError):  # reported when the capture is processed
        return capture.run_dir is None or is_lifted(capture.run_dir)
    return False


def _lift_capture(
    capture: Capture, claim: file_lock.Claim, folder: Path, patience: float, worker: str, program: Sequence[str]
) -> Outcome | None:
    """Lift a capture unless it is already lifted; return None if another worker took it over."""
    start_time, log = time.monotonic(), folder / _LOGS / f"{claim.path.name}.log"

    def outcome(state: OutcomeState, message: str = "", code: int = 0) -> Outcome:
        run = None if capture.run_dir is None or state == "failed" else str(capture.run_dir)
        seconds, now = time.monotonic() - start_time, time.time()
        return Outcome(capture.name, capture.key, claim.number, state, seconds, message, code, run, worker, now)

    try:
        if capture.run_dir is not None and is_lifted(capture.run_dir):
            return outcome("skipped")
        beats = count(1)
        interval = patience / file_lock.BEATS_PER_TIMEOUT
        command = [*program, *capture.arguments]
        code = run_logged(command, log, lambda: file_lock.write_pulse(claim, next(beats)), interval)
        if code is None:
            return None
        if code == 0:
            return outcome("done")
        if capture.run_dir is not None and is_lifted(capture.run_dir):  # a worker that counted as dead lifted it
            return outcome("skipped")
    except InputError as error:
        return outcome("failed", str(error), 1)
    return outcome("failed", failure_reason(code, log), code if code > 0 else 128 - code)


# ns-normlift-batch: run ns-normlift for many captures, with one or several workers.


@dataclass
class NormLiftBatch(CheckedOptions):
    """Lift many captures, each in its own process. Several workers may share the list. A rerun skips captures that were
    already lifted with the same options."""

    captures: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="CAPTURES")]
    """Text file with one capture per line: the path of a config.yml, a splat file or a gsplat checkpoint. Options of
    ns-normlift for this capture may follow or replace the path."""
    options: Annotated[tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="[-- OPTIONS, at the end]")] = ()
    """Options of ns-normlift for all captures, given after --. Options in a line of the list take precedence."""
    results: Path | None = None
    """Folder for results, logs and claims, which all workers share. None: a folder next to the list, such
    as captures_batch for captures.txt."""
    shard: str = "auto"
    """Part of the list that this worker lifts. i/n: the i-th of n parts. none: all captures that no other worker has
    claimed. auto: the part that the variables of a Slurm job array, or RANK and WORLD_SIZE,
    define; without these variables, the same as none."""
    patience: float = 120.0
    """Take over another worker's capture after this many seconds without a heartbeat, in 1..86400. Use the same value
    for all workers. Larger values tolerate longer pauses but delay the takeover."""

    def main(self) -> None:
        """Lift the captures and print the results.

        Raises:
            SystemExit: A capture of this worker failed. The exit code is the largest one of its captures.
        """
        check_readable_file(self.captures, "ns-normlift-batch")
        shard = make_shard(self.shard, os.environ)
        all_captures = read_captures(self.captures, self.options)
        captures = [capture for index, capture in enumerate(all_captures) if shard.contains(index)]
        folder = self.results or self.captures.with_name(f"{self.captures.stem}_batch")
        check_writable_folder(folder, "--results")
        count = f"{len(all_captures)} capture{'' if len(all_captures) == 1 else 's'}"
        part = "" if shard.count == 1 else f" ({len(captures)} in part {shard.index + 1} of {shard.count})"
        info_progress(f"{count} in {self.captures}{part}; results, logs and claims in {folder}")
        outcomes = lift_captures(captures, folder, self.patience, on_message=info_progress)
        if len(captures) > 0:
            CONSOLE.print(outcomes_table(captures, outcomes))
            states = [outcomes[capture.key].state for capture in captures if capture.key in outcomes]
            counts = ((states.count(state), word) for state, word in _STATE_NAMES.items())
            info(", ".join(f"{count} {word}" for count, word in counts if count > 0))
        code = largest_exit_code(outcomes[capture.key] for capture in captures if capture.key in outcomes)
        if code != 0:
            raise SystemExit(code)


def entrypoint() -> None:
    """Run ns-normlift-batch, and return to the caller if it succeeds."""
    run_command(NormLiftBatch)


if __name__ == "__main__":
    entrypoint()
