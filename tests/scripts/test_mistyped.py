"""Flags that a command cannot read: one line that says what to type instead."""

import sys

from normlift_ns.scripts import evaluate, export, lift, query, view
from normlift_ns.scripts.mistyped import plain_errors
from tests.scripts.conftest import run_entry

ALL = "All options: command --help"
CASES = (
    (lift, "--load-confg x", "Unknown options: --load-confg, x.", "Perhaps you meant: --load-config", ALL),
    (lift, "--load-config x y", "Unknown options: y.", ALL),
    (lift, "--load-config", "--load-config needs a value.", ALL),
    (lift, "--refine perhaps", "--refine cannot be 'perhaps'.", "'True', 'False'", ALL),
    (lift, "--k many", "--k cannot be 'many'. --k INT: "),
    (lift, "--beta high", "--beta cannot be 'high'. --beta FLOAT: "),
    (lift, "--max-views few", "--max-views cannot be 'few'. --max-views {None}|INT: "),
    (query, "--load-config x --threshold low", "--threshold cannot be 'low'. --threshold"),
    (export, "--load-config x", "command needs: --output-dir PATH: "),
    (evaluate, "--studdy x", "Unknown options: --studdy x.", ALL),
    (view, "", "command needs: --load-config PATH: "),
)


def test_a_mistyped_flag_is_one_line_with_what_to_type(monkeypatch, capsys):
    for i, (command, words, *facts) in enumerate(CASES):
        monkeypatch.setenv("COLUMNS", "40" if i % 2 == 0 else "200")
        assert run_entry(monkeypatch, command.entrypoint, *words.split()) == 1, words
        shown = capsys.readouterr()
        title, line = shown.err.splitlines()
        assert (shown.out, title) == ("", "Error")
        assert [fact for fact in facts if fact not in line] == [], line
        assert not set("│╭╰─\\") & set(line)


def test_a_warning_meanwhile_is_not_lost_nor_is_help(monkeypatch, capsys) -> None:
    assert run_entry(monkeypatch, lift.entrypoint, "--help") == 0
    assert "usage: " in capsys.readouterr().out
    with plain_errors("command"):
        print("k is lowered", file=sys.stderr)
    assert capsys.readouterr().err == "k is lowered\n"
