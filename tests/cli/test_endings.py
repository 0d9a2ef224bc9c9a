"""Commands end with a message or in silence: narrow terminals, signals, closed streams, small memory."""

import gc
import os
import resource
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from normlift_ns.cli import common, lift
from normlift_ns.errors import describe_error
from normlift_ns.io import memory
from normlift_ns.io.atomic import atomic_file, deferred_signals
from research.reference import COMMANDS

RUN = [sys.executable, "-m", "normlift_ns.cli.query"]


@pytest.fixture(autouse=True)
def _interruptible() -> Iterator[None]:
    """A process in the background of a shell ignores SIGINT."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize("name", COMMANDS)
def test_help_ends_at_every_width(name, monkeypatch, capsys):
    widths = range(1, 401) if os.environ.get("NORMLIFT_EVERY_WIDTH") else (1, 39, 400)
    for columns in widths:
        monkeypatch.setenv("COLUMNS", str(columns))
        with pytest.raises(SystemExit) as stop:
            common.parse_flags(COMMANDS[name], ["--help"], name)
        assert stop.value.code == 0 and os.environ["COLUMNS"] == str(columns)
    shown = capsys.readouterr().out
    assert "usage: " in shown and "--help" in shown and "\x1b" not in shown


def test_closed_streams_end_in_silence():
    missing = "--load-config /nowhere/config.yml --text a"
    for closed, flags in (
        ("2>&-", "--zzz"), (">&-", "--help"), ("2>&-", missing), (">&- 2>&-", "--help"), ("<&- >&- 2>&-", missing),
    ):  # fmt: skip
        done = subprocess.run(f"{' '.join(RUN)} {flags} {closed}", shell=True, capture_output=True, check=False)
        assert done.returncode == (flags != "--help")
        assert not any(word in done.stderr + done.stdout for word in (b"Traceback", b"bug"))


def test_signals_wait_for_the_end_of_a_critical_section():
    done = []
    with pytest.raises(KeyboardInterrupt), deferred_signals():
        signal.raise_signal(signal.SIGINT)
        done.append(1)
    assert done == [1] and signal.getsignal(signal.SIGINT) is signal.default_int_handler
    worker = threading.Thread(target=lambda: done.append(deferred_signals().__enter__()))  # changes no handler
    worker.start()
    worker.join()
    assert len(done) == 2


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_no_temporary_folder_outlives_a_signal_at_any_call(number, tmp_path_factory):
    """The signal comes at the n-th call while a file is written. A lock may remain until the process ends."""
    folder = tmp_path_factory.mktemp("signals")
    with lift.paused_collection():  # later collections then take no time
        assert not gc.isenabled()
    for instant in range(1, 400, 10):
        calls = 0

        def trace(_frame, event, _argument, instant=instant):
            nonlocal calls
            calls += event == "call"
            if calls == instant:
                calls += 1
                signal.raise_signal(number)

        with suppress(KeyboardInterrupt, common.TerminatedError), common._sigterm_raises():
            sys.setprofile(trace)
            try:
                with atomic_file(folder / "a.txt", overwrite=True) as draft:
                    draft.write_text("content")
            finally:
                sys.setprofile(None)  # before SIGTERM kills again
        gc.collect()
        assert {path.name for path in folder.iterdir()} <= {"a.txt"}, instant
    gc.unfreeze()


def test_a_signal_while_an_object_is_deleted_is_not_lost(capsys):
    class Slow:
        def __del__(self) -> None:
            raise KeyboardInterrupt  # as from Ctrl-C at this instant

    with pytest.raises(KeyboardInterrupt), common._sigterm_raises():
        Slow()  # the signal comes again before the end of this context
    assert "ignored" not in capsys.readouterr().err


def system(root: Path, cgroup: str, files: dict[str, object]) -> Path:
    files = {"proc/meminfo": "MemAvailable: 8388608 kB\n", "proc/self/cgroup": cgroup, "proc/self/statm": "1", **files}
    for name, text in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(str(text))
    return root


def test_limits_of_cgroups_and_shells_are_read(tmp_path, monkeypatch):
    v2 = {"sys/fs/cgroup/a/memory.max": 5000, "sys/fs/cgroup/a/memory.current": 1000,
          "sys/fs/cgroup/a/b/memory.max": "max", "sys/fs/cgroup/a/b/memory.current": 10}  # fmt: skip
    assert memory.free_memory(system(tmp_path / "2", "0::/a/b\n", v2))["the cgroup"] == 4000
    base = "sys/fs/cgroup/memory/memory."
    v1 = {f"{base}limit_in_bytes": 900, f"{base}usage_in_bytes": 100}
    assert memory.free_memory(system(tmp_path / "1", "4:memory:/docker/x\n0::/\n", v1))["the cgroup"] == 800
    assert memory.free_memory(tmp_path / "none").keys() <= {"ulimit -v"}
    monkeypatch.setattr("resource.getrlimit", lambda kind: (2**20, -1))
    free = memory.free_memory(system(tmp_path / "0", "nonsense", {"proc/self/statm": "5 1"}))
    assert free == {"the machine": 2**33, "ulimit -v": 2**20 - 5 * resource.getpagesize()}


def test_a_lift_that_cannot_fit_is_refused_with_the_estimate(monkeypatch):
    monkeypatch.setattr(memory, "free_memory", lambda: {"the cgroup": 2**30})
    memory.refuse_small_memory(1_000_000, 10**6)
    with pytest.raises(MemoryError, match=r"at least 5\.59 GiB .* the cgroup leaves 1\.00 GiB"):
        memory.refuse_small_memory(10_000_000)
    command = f"ulimit -v 250000; {' '.join(RUN)} --load-config /nowhere/config.yml --text a"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, check=False)
    assert done.returncode == 1 and "ulimit -v" in done.stderr
    command = f"ulimit -v 1000000; {sys.executable} -m normlift_ns.cli.lift --load-config {__file__}"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, check=False)
    assert done.returncode == 1 and "Traceback" not in done.stderr
    for error in (RuntimeError("[enforce fail] DefaultCPUAllocator: can't allocate memory"), MemoryError(),
                  RuntimeError("can't start new thread")):  # fmt: skip
        assert describe_error(error)[1] == 1 and "memory is full" in describe_error(error)[0]
