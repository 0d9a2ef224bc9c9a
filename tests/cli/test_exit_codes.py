"""How commands end: exit codes, what is said where, and what happens to output that cannot be written."""

import io
import os
import signal
import subprocess
import sys
import textwrap
from pathlib import Path
from typing import NoReturn

import pytest
from rich.console import Console
from rich.panel import Panel

from normlift_ns.cli import common
from normlift_ns.cli.common import info, plain_text
from normlift_ns.errors import InputError
from normlift_ns.io.atomic import atomic_file

NO_SPACE = OSError(28, "No space left on device", "a.ply")


@pytest.fixture(autouse=True)
def console(monkeypatch: pytest.MonkeyPatch) -> None:
    """What could not be written stays in a console, and would be printed by the next test."""
    fresh = Console(width=120, markup=False, emoji=False, highlight=False)
    monkeypatch.setattr(common, "CONSOLE", fresh)


def fail(error: BaseException) -> NoReturn:
    raise error


def test_an_error_is_one_message_on_standard_error(ended, tmp_path):
    for body, code, *facts in (
        (lambda _: fail(InputError("k [/red] :smile:")), 1, "k [/red] :smile:"),
        (lambda _: os.listdir("/nowhere/[/x]"), 1, "/nowhere/[/x]: No such file or directory"),
        (lambda _: fail(NO_SPACE), 1, "a.ply: No space left on device"),
        (lambda _: fail(MemoryError()), 1, "memory"),
        (lambda _: fail(KeyboardInterrupt()), 130, "Interrupted. "),
        (lambda _: fail(ValueError("what")), 70, "bug in normlift_ns: ValueError: what"),
        (lambda _: {}["[/bold]"], 70, "KeyError: '[/bold]'"),
        (lambda _: fail(RecursionError()), 70, "RecursionError"),
        (lambda _: fail(SystemExit(7)), 7, ""),
    ):
        found, out, err = ended(body)
        assert (found, out) == (code, "") and "Traceback" not in err, facts
        assert [fact for fact in facts if fact not in err] == [], err
        logs = list((tmp_path / "state" / "normlift_ns").glob("*.log"))
        assert len(logs) == (code == 70), facts
        for log in logs:
            assert "Traceback" in log.read_text() and str(log) in err
            assert log.stat().st_mode & 0o777 == 0o600
            log.unlink()


def test_what_cannot_be_encoded_is_replaced(ended, monkeypatch):
    def body(_: str) -> None:
        info("a 🎉 中 \u202e " + chr(0xDC80))
        common.CONSOLE.print(Panel(plain_text("🎉")))
        raise InputError("no 中")

    for encoding in ("cp1252", "ascii", "latin-1"):
        streams = [io.TextIOWrapper(io.BytesIO(), encoding) for _ in range(2)]
        with monkeypatch.context() as patch:
            patch.setattr(sys, "stdout", streams[0])
            patch.setattr(sys, "stderr", streams[1])
            assert ended(body)[0] == 1
        out, err = (stream.buffer.getvalue().decode(encoding) for stream in streams)  # type: ignore[attr-defined]
        assert out.splitlines()[0] == "a ? ? \\u202e \\udc80", encoding
        assert err.splitlines()[-1] == "no ?", encoding


def caught(_: str) -> None:
    try:
        print("a" * 10**6)
    except OSError:
        raise InputError("what a loader makes of a file") from None


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no /dev/full")
def test_a_full_device_is_a_message(ended, monkeypatch):
    for body, *flags in ((info,), (print,), (lambda _: info("a" * 10**6),), (caught,), (info, "--help")):
        with open("/dev/full", "w") as full, monkeypatch.context() as patch:
            patch.setattr(sys, "stdout", full)
            code, _, err = ended(body, *flags)
        assert code == 1 and "Traceback" not in err
        assert err.count("cannot be written: No space left on device") == err.count("No space") == 1


def test_a_closed_pipe_ends_quietly(ended, monkeypatch):
    def body(_: str) -> None:
        for i in range(10**5):
            info(f"line {i}")
        raise AssertionError("nobody reads")

    reading, writing = os.pipe()
    os.close(reading)
    with os.fdopen(writing, "w") as pipe, monkeypatch.context() as patch:
        patch.setattr(sys, "stdout", pipe)
        assert ended(body) == (1, "", "")


def test_sigterm_cleans_up_and_says_so(ended, tmp_path):
    def body(word: str) -> None:
        with atomic_file(tmp_path / word) as draft:
            draft.write_text("half")
            try:
                os.kill(os.getpid(), signal.SIGTERM)
            except Exception:
                info("swallowed")
            raise AssertionError("went on")

    before = signal.getsignal(signal.SIGTERM)
    code, out, err = ended(body, "--word", "a.txt")
    assert (code, out) == (143, "") and err.startswith("Terminated. ")
    assert list(tmp_path.iterdir()) == [] and signal.getsignal(signal.SIGTERM) == before


PROGRAM = """
import atexit, os, sys
from dataclasses import dataclass
from normlift_ns.errors import InputError
from normlift_ns.cli.common import run_command_process

class Slow:
    def __del__(self):
        print("taken down")

kept = Slow()
atexit.register(print, "duty")

@dataclass
class Command:
    '''A command.'''

    def main(self):
{body}

run_command_process(Command)
"""


def started(body: str, state: Path, **more: str) -> subprocess.CompletedProcess[str]:
    program = PROGRAM.format(body=textwrap.indent(textwrap.dedent(body), " " * 8))
    environment = {name: value for name, value in os.environ.items() if name != "OMP_WAIT_POLICY"}
    environment |= {"XDG_STATE_HOME": str(state), "PYTHONUNBUFFERED": "", **more}
    how = {"env": environment, "capture_output": True, "text": True, "timeout": 300}
    return subprocess.run([sys.executable, "-c", program], check=False, **how)


@pytest.mark.parametrize(
    ("body", "code", "given"), [("", 0, {}), ("raise InputError('no')", 1, {"OMP_WAIT_POLICY": "active"})]
)
def test_a_process_ends_at_once_with_its_code_its_output_and_its_last_duties(body, code, given, tmp_path):
    """Threads of OpenMP that wait sleep, unless the user says otherwise."""
    done = started(f"print(os.environ['OMP_WAIT_POLICY'], 'torch' in sys.modules)\n{body}", tmp_path, **given)
    assert (done.returncode, done.stdout.split()) == (code, ["passive" if code == 0 else "active", "False", "duty"])


@pytest.mark.slow
def test_a_server_ends_where_another_thread_gets_the_signal(tmp_path):
    """It wakes no wait of the main thread: a viewer that had been told to end went on."""
    body = """
        import signal, threading, time
        from normlift_ns.cli.view import until_stopped
        def tell():
            time.sleep(0.5)
            signal.pthread_kill(threading.get_ident(), signal.SIGTERM)
        threading.Thread(target=tell).start()
        until_stopped()
    """
    done = started(body, tmp_path)
    assert (done.returncode, "Terminated" in done.stderr) == (143, True)
