"""Processes for tests of what happens when several of them write at once, or are killed."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

FORK = multiprocessing.get_context("fork")


def together(count: int, action: Callable[[int], Any]) -> list[Any]:
    """What an action returns in so many processes that start it at the same instant; an error is its result."""
    gate, answers = FORK.Barrier(count), FORK.SimpleQueue()

    def work(i: int) -> None:
        gate.wait()
        try:
            answers.put((i, action(i)))
        except Exception as error:
            answers.put((i, error))

    processes = [FORK.Process(target=work, args=(i,)) for i in range(count)]
    for process in processes:
        process.start()
    found = dict(answers.get() for _ in processes)
    for process in processes:
        process.join()
    return [found[i] for i in range(count)]


def killed_at(step: int, action: Callable[[], object], folder: Path) -> bool:
    """Runs an action in a process that is killed before its `step`th access to files; False if it ends before that.

    Steps are counted from the first one that concerns the folder or comes after it.
    """
    pid = os.fork()
    if pid == 0:
        done = 0

        def count(event: str, arguments: tuple[Any, ...]) -> None:
            nonlocal done
            inside = done > 0 or any(str(folder) in str(x) for x in arguments)
            if inside and event.split(".", maxsplit=1)[0] in ("open", "os", "shutil", "ctypes"):
                done += 1
                if done == step:
                    os.kill(os.getpid(), signal.SIGKILL)

        sys.addaudithook(count)
        try:
            action()
        finally:
            os._exit(0)
    _, status = os.waitpid(pid, 0)
    assert os.WIFSIGNALED(status) or os.WEXITSTATUS(status) == 0
    return os.WIFSIGNALED(status)
