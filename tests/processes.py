"""Processes for tests: programs, and what happens when several processes write at once or are killed."""

import multiprocessing
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

FORK = multiprocessing.get_context("fork")
_RENAMES = {"os.rename", "ctypes.dlopen"}
"""Accesses; renames of Linux are seen by the library that they load."""


def run(*words: object, code: int = 0, **how: Any) -> str:
    """What a program prints, errors too if it fails; it must end with the code."""
    done = subprocess.run(list(map(str, words)), capture_output=True, text=True, check=False, **how)
    assert done.returncode == code, done.stdout + done.stderr
    return done.stdout if code == 0 else done.stdout + done.stderr


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


def _watched(action: Callable[[], object], folder: Path, seen: Callable[[str], object]) -> int:
    """Runs an action in a process of its own and tells, there, of each access to files before it happens.

    The first one concerns the folder. Returns how the process ended.
    """
    pid = os.fork()
    if pid == 0:
        begun = False

        def hook(event: str, arguments: tuple[Any, ...]) -> None:
            nonlocal begun
            begun = begun or any(str(folder) in str(x) for x in arguments)
            if begun and event.split(".", maxsplit=1)[0] in ("open", "os", "shutil", "ctypes"):
                seen(event)

        sys.addaudithook(hook)
        try:
            action()
        finally:
            os._exit(0)
    return os.waitpid(pid, 0)[1]


def killed_at(step: int, action: Callable[[], object], folder: Path) -> bool:
    """Runs an action in a process that is killed before its `step`th access to files; False if it ends before that.

    Steps are counted from the first one that concerns the folder or comes after it.
    """
    done = 0

    def kill(event: str) -> None:
        nonlocal done
        done += 1
        if done == step:
            os.kill(os.getpid(), signal.SIGKILL)

    status = _watched(action, folder, kill)
    assert os.WIFSIGNALED(status) or os.WEXITSTATUS(status) == 0
    return os.WIFSIGNALED(status)


def instants(action: Callable[[], object], folder: Path, every: int = 0) -> list[int]:
    """Steps for `killed_at`: each so many; 0: the last three renames and what follows them, the first and the last.

    The action is run to find them.
    """
    reader, writer = os.pipe()
    _watched(action, folder, lambda event: os.write(writer, f"{event}\n".encode()))
    os.close(writer)
    with os.fdopen(reader) as file:
        events = dict(enumerate(file.read().split(), start=1))
    if every > 0:
        return sorted({*range(1, len(events), every), len(events)})
    renames = [step for step, event in events.items() if event in _RENAMES][-3:]
    after = next(step for step, event in events.items() if step > renames[-1] and not event.startswith("ctypes"))
    return sorted({1, *renames, after, len(events)})
