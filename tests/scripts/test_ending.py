"""How commands end: exit codes, what is said where, and what happens to output that cannot be written."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path
from typing import Any

import pytest

PROGRAM = """
import os, sys, time, warnings
from dataclasses import dataclass
from pathlib import Path
from normlift_ns.errors import InputError
from normlift_ns.scripts.shared import CONSOLE, plain, run_command, say

@dataclass
class Command:
    '''A command.'''

    word: str = "x"
    '''A word.'''

    def main(self):
{body}

run_command(Command)
"""


def start(body: str, *flags: str, state: Path, stdout: Any = subprocess.PIPE, **more: str) -> subprocess.Popen[bytes]:
    program = PROGRAM.format(body=textwrap.indent(textwrap.dedent(body), " " * 8))
    environment = os.environ | {"XDG_STATE_HOME": str(state), "PYTHONUNBUFFERED": ""} | more
    return subprocess.Popen(
        [sys.executable, "-c", program, *flags],
        env=environment,
        stdout=stdout,
        stderr=subprocess.PIPE,  # type: ignore[arg-type]
    )


def ended(body: str, *flags: str, state: Path, **more: object) -> tuple[int, str, str]:
    """Exit code, output and errors of a command."""
    process = start(body, *flags, state=state, **more)  # type: ignore[arg-type]
    out, err = process.communicate(timeout=60)
    return process.returncode, (out or b"").decode(), err.decode()


@pytest.mark.parametrize(
    ("body", "code", "message"),
    [
        ("raise InputError('k [/red] :smile:')", 1, "k [/red] :smile:"),
        ("open('/nowhere/[/x]')", 1, "/nowhere/[/x]: No such file or directory"),
        ("raise OSError(28, 'No space left on device', 'a.ply')", 1, "a.ply: No space left on device"),
        ("raise MemoryError", 1, "the memory is full"),
        ("raise KeyboardInterrupt", 130, "Interrupted. No partial files remain; rerun the command to resume."),
        ("raise ValueError('what')", 70, "This is a bug of normlift_ns: ValueError: what. The details are in"),
        ("{}['[/bold]']", 70, "KeyError: '[/bold]'"),
        ("def f(): f()\nf()", 70, "RecursionError"),
    ],
)
def test_an_error_is_one_message_on_standard_error(body, code, message, tmp_path):
    found, out, err = ended(body, state=tmp_path)
    assert (found, out) == (code, "")
    assert message in err and "Traceback" not in err
    logs = list((tmp_path / "normlift_ns").glob("*.log"))
    assert len(logs) == (code == 70)
    assert all("Traceback" in log.read_text() and str(log) in err for log in logs)


def test_flags_that_cannot_be_read_are_mistakes_of_the_user(tmp_path):
    code, out, err = ended("pass", "--wrod", "a", state=tmp_path)
    assert (code, out) == (1, "")
    assert "--wrod" in err


@pytest.mark.parametrize("encoding", ["cp1252", "ascii", "latin-1"])
def test_what_cannot_be_encoded_is_replaced(encoding, tmp_path):
    body = """
        say("a 🎉 中 \\u202e " + chr(0xdc80))
        from rich.panel import Panel
        CONSOLE.print(Panel(plain("🎉")))
        raise InputError("no 中")
    """
    code, out, err = ended(body, state=tmp_path, PYTHONIOENCODING=encoding)
    assert code == 1
    assert out.splitlines()[0] == "a ? ? \\u202e \\udc80"
    assert err.splitlines()[-1] == "no ?"


_CAUGHT = "try: print('a' * 10**6)\nexcept OSError: raise InputError('what a loader makes of a file')"


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no /dev/full")
@pytest.mark.parametrize("body", ["say('a')", "print('a')", "say('a' * 10**6)", "sys.stdout.write('x')", _CAUGHT])
def test_a_full_device_is_a_message(body, tmp_path):
    with open("/dev/full", "wb") as full:
        code, _, err = ended(body, state=tmp_path, stdout=full)
    assert code == 1
    assert "The output of the command cannot be written: No space left on device" in err
    assert "Traceback" not in err and "Exception ignored" not in err
    assert err.count("No space") == 1


@pytest.mark.parametrize("flag", ["--help", "--version"])
def test_help_to_a_full_device(flag, tmp_path):
    if not Path("/dev/full").exists():
        pytest.skip("this system has no /dev/full")
    with open("/dev/full", "wb") as full:
        code, _, err = ended("pass", flag, state=tmp_path, stdout=full)
    assert code == 1 and "cannot be written" in err and "Traceback" not in err


def test_a_closed_pipe_ends_quietly(tmp_path):
    process = start("for i in range(10**5): say(f'line {i}')", state=tmp_path)
    assert process.stdout is not None and process.stderr is not None
    assert process.stdout.readline() == b"line 0\n"
    process.stdout.close()
    assert process.stderr.read() == b""
    assert process.wait(60) == 1


def test_sigterm_cleans_up_and_says_so(tmp_path):
    body = """
        from normlift_ns.core.files import new_file
        with new_file(Path(sys.argv[2]) / "a.txt") as draft:
            draft.write_text("half")
            say("ready")
            try:
                time.sleep(60)
            except Exception:
                say("swallowed")
    """
    process = start(body, "--word", str(tmp_path), state=tmp_path / "state")
    assert process.stdout is not None and process.stderr is not None
    assert process.stdout.readline() == b"ready\n"
    begun = time.monotonic()
    process.send_signal(signal.SIGTERM)
    assert process.stdout.read() == b""
    assert "Terminated. No partial files remain; rerun the command to resume." in process.stderr.read().decode()
    assert process.wait(60) == 143
    assert time.monotonic() - begun < 30
    assert list(tmp_path.iterdir()) == []


def test_warnings_of_ours_are_clipped(tmp_path):
    body = """
        import normlift_ns
        ours = normlift_ns.__file__
        warnings.warn_explicit("[red] is left out", UserWarning, ours, 1)
        warnings.warn_explicit("foreign", UserWarning, "elsewhere.py", 7)
    """
    code, out, err = ended(body, state=tmp_path)
    assert (code, out) == (0, "")
    assert "Warning: [red] is left out\n" in err
    assert "elsewhere.py:7: UserWarning: foreign" in err
    assert "__init__.py" not in err


@pytest.mark.parametrize(("body", "code"), [("print('done')", 0), ("print('done'); raise InputError('no')", 1)])
def test_a_process_ends_at_once_with_its_code_its_output_and_its_last_duties(body, code, tmp_path):
    slow = "class Slow:\n    def __del__(self):\n        print('taken down')\nkept = Slow()\n"
    program = PROGRAM.format(body=textwrap.indent(body, " " * 8)).replace("run_command", "run_process")
    program = slow + "import atexit; atexit.register(print, 'duty')\n" + program
    state = os.environ | {"XDG_STATE_HOME": str(tmp_path), "PYTHONUNBUFFERED": ""}
    done = subprocess.run([sys.executable, "-c", program], env=state, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout.split()) == (code, ["done", "duty"])


def test_a_server_ends_where_another_thread_gets_the_signal(tmp_path):
    """It wakes no wait of the main thread: a viewer that had been told to end went on."""
    body = """
        import signal, threading
        from normlift_ns.scripts.view import until_stopped
        def tell():
            time.sleep(0.5)
            signal.pthread_kill(threading.get_ident(), signal.SIGTERM)
        threading.Thread(target=tell).start()
        until_stopped()
    """
    code, _, err = ended(body, state=tmp_path)
    assert (code, "Terminated" in err) == (143, True)


@pytest.mark.parametrize(("given", "found"), [({}, "passive"), ({"OMP_WAIT_POLICY": "active"}, "active")])
def test_threads_that_wait_sleep_unless_the_user_says_otherwise(given, found, tmp_path):
    body = "print(os.environ['OMP_WAIT_POLICY'], 'torch' in sys.modules)"
    program = PROGRAM.format(body=textwrap.indent(body, " " * 8)).replace("run_command", "run_process")
    state = {name: value for name, value in os.environ.items() if name != "OMP_WAIT_POLICY"}
    state |= {"XDG_STATE_HOME": str(tmp_path), **given}
    done = subprocess.run([sys.executable, "-c", program], env=state, capture_output=True, text=True, check=True)
    assert done.stdout.split() == [found, "False"]


@pytest.mark.parametrize("command", ["lift", "query", "export", "evaluate", "view", "batch"])
def test_ctrl_c_while_a_command_is_loaded(command):
    """Its modules raise what Python raises for Ctrl-C."""
    program = f"""
import sys
class Stop:
    def find_spec(self, name, path=None, target=None):
        if name == "normlift_ns.scripts.{command}":
            raise KeyboardInterrupt
sys.meta_path.insert(0, Stop())
from normlift_ns.scripts import start
start.{command}()
"""
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stdout, ended.stderr) == (130, "", "Interrupted.\n")
