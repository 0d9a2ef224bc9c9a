"""A process that has imported everything once, and runs commands of ours in children of its own, all of one thread.

It reads lists of jobs from its input, one line of JSON each, runs the jobs of a list at the same time, and answers with
one line: exit code (or minus the signal) and number of accesses of every job.
"""

import json
import mmap
import os
import random
import signal
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from normlift_ns.cli import export, lift, query
from normlift_ns.demo.capture import write_capture, write_splatfacto_run
from tests.plain_room import plain_room

_WRITE = os.O_WRONLY | os.O_RDWR
_CHANGES = {"os.rename", "os.mkdir", "os.remove", "os.rmdir", "os.chmod", "shutil.rmtree"}


@dataclass(frozen=True)
class Job:
    """A command, and when it is to be killed."""

    words: tuple[str, ...]  # `lift`, `query` or `export` with flags; `room` with a folder
    log: str  # the file of all that it prints
    folder: str = ""  # in which accesses that change something are counted
    step: int | None = None  # before this access
    seconds: float | None = None  # or after so many
    signal: int = signal.SIGKILL


def make_room(folder: Path) -> None:
    room = plain_room(4000)
    write_capture(room, folder / "room", views=5, held_out=1, width=80, height=60)
    write_splatfacto_run(room, folder / "room", folder / "outputs")


def work(words: tuple[str, ...]) -> int:
    name, *flags = words
    if name == "room":
        make_room(Path(flags[0]))
        return 0
    sys.argv = [name, *flags]
    try:
        {"lift": lift, "query": query, "export": export}[name].entrypoint()
    except SystemExit as stop:
        return int(stop.code or 0)
    return 0


def watch(job: Job, count: mmap.mmap) -> None:
    """Counts the accesses that change something in the folder of a job, and kills this process at its time."""
    done = 0

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        nonlocal done
        if event == "open":
            mode, flags = arguments[1:]
            changes = bool((flags or 0) & _WRITE) or (mode is not None and set(mode) & set("wax+"))
        else:
            changes = event in _CHANGES or (event == "ctypes.dlopen" and done > 0)  # renameat2
        if not changes or (event != "ctypes.dlopen" and job.folder not in str(arguments[0])):
            return
        done += 1
        count[:8] = done.to_bytes(8, "little")
        if done == job.step:
            os.kill(os.getpid(), job.signal)

    sys.addaudithook(hook)
    if job.seconds is not None:
        signal.signal(signal.SIGALRM, signal.SIG_DFL)  # as sudden as SIGKILL
        signal.setitimer(signal.ITIMER_REAL, job.seconds)


def start(job: Job, count: mmap.mmap) -> int:
    pid = os.fork()
    if pid > 0:
        return pid
    code = 70
    try:
        log = os.open(job.log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        os.dup2(log, 1)
        os.dup2(log, 2)
        random.seed()
        torch.set_num_threads(1)  # after a fork, torch replaces its thread pool at the first call, without a lock
        watch(job, count)
        code = work(job.words)
        sys.stdout.flush()
    finally:
        os._exit(code)


def run(jobs: list[Job]) -> list[tuple[int, int]]:
    """Exit codes and numbers of accesses of jobs that run at the same time."""
    counts = [mmap.mmap(-1, 8) for _ in jobs]
    pids = [start(job, count) for job, count in zip(jobs, counts)]
    codes = [os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) for pid in pids]
    return [(code, int.from_bytes(count[:8], "little")) for code, count in zip(codes, counts)]


def warm() -> None:
    """Imports what the commands import when they run."""
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        make_room(folder)
        (trained,) = folder.glob("outputs/room/splatfacto/*/config.yml")
        common = ("--encoder", "color", "--vote-k", "6", "--timestamp", "warm", "--queries", "red")
        assert work(("lift", "--load-config", str(trained), *common)) == 0
        config = str(folder / "outputs" / "room" / "normlift" / "warm" / "config.yml")
        assert work(("query", "--load-config", config, "--text", "red")) == 0
        assert work(("export", "--load-config", config, "--output-dir", str(folder / "ply"))) == 0


if __name__ == "__main__":
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)
    warm()
    answers.write("ready\n")
    for line in sys.stdin:
        jobs = [Job(**{**job, "words": tuple(job["words"])}) for job in json.loads(line)]
        answers.write(json.dumps(run(jobs)) + "\n")
