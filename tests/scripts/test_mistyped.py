"""Flags that a command cannot read: one line that says what to type instead."""

import os
import re
import sys

import pytest

from normlift_ns.scripts import evaluate, export, lift, query, view
from normlift_ns.scripts.mistyped import plain_errors
from tests.scripts.conftest import run_entry


@pytest.mark.parametrize(
    ("command", "words", "message"),
    [
        (lift, ["--load-confg", "x"], "Unknown options: --load-confg, x. Perhaps you meant: --load-config"),
        (lift, ["--load-config", "x", "y"], "Unknown options: y. All options: command --help"),
        (lift, ["--load-config"], "--load-config needs a value. All options: command --help"),
        (lift, ["--refine", "perhaps"], "--refine cannot be 'perhaps'. Expected one of 'True', 'False'. All"),
        (lift, ["--k", "many"], "--k cannot be 'many'. --k INT: Number of neighbours K in the vote"),
        (lift, ["--beta", "high"], "--beta cannot be 'high'. --beta FLOAT: Strength of the prior"),
        (lift, ["--max-views", "few"], "--max-views cannot be 'few'. --max-views {None}|INT: Use at most"),
        (query, ["--load-config", "x", "--threshold", "low"], "--threshold cannot be 'low'. --threshold"),
        (export, ["--load-config", "x"], "command needs: --output-dir PATH: Folder to write to"),
        (evaluate, ["--studdy", "x"], "Unknown options: --studdy x. All options: command --help"),
        (view, [], "command needs: --load-config PATH: Path to config YAML file of the lifted run"),
    ],
)
@pytest.mark.parametrize("width", ["40", "200"])
def test_a_mistyped_flag_is_one_line_with_what_to_type(monkeypatch, capsys, command, words, message, width) -> None:
    monkeypatch.setenv("COLUMNS", width)
    assert run_entry(monkeypatch, command.entrypoint, *words) == 1
    shown = capsys.readouterr()
    assert shown.out == ""
    title, line = shown.err.splitlines()
    assert title == "Error"
    assert message in line
    assert not set("│╭╰─\\") & set(line)


@pytest.mark.skipif(sys.platform == "win32", reason="needs a pseudo-terminal of Unix")
def test_in_a_terminal_too() -> None:
    import pty  # noqa: PLC0415

    said = []
    program = "from normlift_ns.scripts.lift import entrypoint; entrypoint()"
    pty.spawn([sys.executable, "-c", program, "--k", "many"], lambda fd: said.append(os.read(fd, 1024)) or said[-1])
    shown = re.sub(r"\x1b\[[\d;]*m", "", b"".join(said).decode())
    assert "--k cannot be 'many'. --k INT: Number of neighbours" in shown
    assert not set("│╭╰") & set(shown)


def test_a_warning_meanwhile_is_not_lost(capsys) -> None:
    with plain_errors("command"):
        print("k is lowered", file=sys.stderr)
    assert capsys.readouterr().err == "k is lowered\n"


def test_other_errors_and_help_are_as_before(monkeypatch, capsys) -> None:
    assert run_entry(monkeypatch, lift.entrypoint, "--help") == 0
    assert "usage: " in capsys.readouterr().out
    assert run_entry(monkeypatch, lift.entrypoint, "--load-config", "nowhere/config.yml") == 1
    assert "nowhere" in capsys.readouterr().err
