"""What the commands print, and where: --quiet, --log-file, colours, warnings of others, errors that can be copied."""

import os
import re
import socket
import subprocess
import sys
import warnings
from pathlib import Path
from unittest.mock import Mock

import pytest

import normlift_ns
from normlift_ns.cli import common, export, lift, query, view
from normlift_ns.errors import InputError
from tests.cli.conftest import SMALL, run_entry


def talk(word: str) -> None:
    common.info_opening(Path("run"))
    common.info_progress("lift")
    common.info(f"answer {word}")
    for text, category in (("old", FutureWarning), ("wrong", UserWarning)):
        warnings.warn_explicit(text, category, "/site-packages/torch/jit.py", 7)
    warnings.warn_explicit("[red] is left out", UserWarning, normlift_ns.__file__, 1)
    sys.stdout.write("\x1b[31mred\x1b[0m\n")
    if word == "no":
        raise InputError("no")


def test_quiet_leaves_results_warnings_and_errors(ended) -> None:
    for words, quiet in (
        (("--word", "a"), False),
        (("--word", "a", "--quiet", "False"), False),
        (("--quiet", "--word", "a"), True),
        (("--word", "a", "--quiet", "True"), True),
    ):
        code, out, err = ended(talk, *words)
        assert (code, out.splitlines()[:-1]) == (0, ["answer a"] if quiet else ["lift", "answer a"])
        assert err.startswith("Opening run") != quiet and "jit.py:7: UserWarning: wrong" in err and "old" not in err
        assert "Warning: [red] is left out\n" in err and "__init__.py" not in err
    code, _, err = ended(talk, "--quiet", "--word", "no")
    assert (code, err.splitlines()[-2:]) == (1, ["Error", "no"])


def test_a_log_file_gets_everything_without_colours_and_is_added_to(ended, tmp_path: Path) -> None:
    log = tmp_path / "a.log"
    for word, ends in (("a", 0), ("no", 1)):
        code, out, _ = ended(talk, "--word", word, "--log-file", str(log))
        assert code == ends and "\x1b[31mred" in out
    text = log.read_text("utf8")
    assert "\x1b" not in text
    assert {"Opening run", "lift", "answer a", "answer no", "red", "Error", "no"} <= set(text.splitlines())
    assert text.count("FutureWarning: old") == 2 and text.count("UserWarning: wrong") == 2
    assert f"--word no --log-file {log}" in text


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="needs a pseudo-terminal")
@pytest.mark.parametrize("no_color", [True, False])
def test_a_terminal_has_colours_unless_it_is_told_otherwise(no_color: bool, tmp_path: Path) -> None:
    import pty  # noqa: PLC0415 (Windows has none)

    environment = {name: value for name, value in os.environ.items() if name not in ("FORCE_COLOR", "NO_COLOR")}
    environment |= {"TERM": "xterm-256color"} | ({"NO_COLOR": "1"} if no_color else {})
    program = "from normlift_ns.cli.start import lift; lift()"
    config = str(tmp_path / ("long-" * 30) / "no.yml")
    master, slave = pty.openpty()
    words = [sys.executable, "-c", program, "--load-config", config]
    subprocess.run(words, stdout=slave, stderr=slave, env=environment, check=False, timeout=60)
    os.close(slave)
    shown = os.read(master, 10**5).decode().replace("\r\n", "\n")
    os.close(master)
    assert ("\x1b[" in shown.replace("\x1b[0m", "").replace("\x1b[1m", "")) != no_color
    lines = shown.splitlines()
    assert lines[0].endswith("Error\x1b[0m") or lines[0] == "Error"
    assert config in re.sub(r"\x1b\[[\d;]*m", "", lines[1])  # one line, at the left, however long
    assert not set("│╭╰") & set(shown)


def test_the_next_command_is_a_line_of_its_own(little: Path, monkeypatch, capsys, tmp_path: Path) -> None:
    places = ("--output-dir", tmp_path / ("deep-" * 20), "--timestamp", "next", "--queries", "red mug", "blue")
    flags = ("--load-config", little, *SMALL, *places, "--max-views", "3")
    assert run_entry(monkeypatch, lift.entrypoint, *flags) == 0
    shown = capsys.readouterr().out
    config = next(tmp_path.glob("deep-*/*/normlift/next/config.yml"))
    assert shown.splitlines()[-1] == f"ns-normlift-query --load-config {config} --text 'red mug'"
    assert run_entry(monkeypatch, lift.entrypoint, *flags, "--overwrite", "True", "--quiet") == 0
    assert capsys.readouterr().out.splitlines() == [shown.splitlines()[-1]]


ALL = "All options: command --help"
CASES = (
    (lift, "--load-confg x", "Unknown options: --load-confg, x.", "Perhaps you meant: --load-config", ALL),
    (lift, "--load-config", "--load-config needs a value.", ALL),
    (lift, "--refine perhaps", "--refine cannot be 'perhaps'.", "'True', 'False'", ALL),
    (lift, "--vote-k many", "--vote-k cannot be 'many'. --vote-k INT: "),
    (lift, "--max-views few", "--max-views cannot be 'few'. --max-views {None}|INT: "),
    (query, "--load-config x --threshold low", "--threshold cannot be 'low'. --threshold"),
    (export, "--load-config x", "command needs: --output-dir PATH: "),
    (view, "", "command needs: --load-config PATH: "),
)


def test_a_mistyped_flag_is_one_line_without_colours_that_says_what_to_type(monkeypatch, capsys):
    monkeypatch.setenv("TERM", "xterm")
    for name in ("FORCE_COLOR", "NO_COLOR"):
        monkeypatch.delenv(name, raising=False)
    for i, (command, words, *facts) in enumerate(CASES):
        monkeypatch.setenv("COLUMNS", "40" if i % 2 == 0 else "200")
        assert run_entry(monkeypatch, command.entrypoint, *words.split()) == 1, words
        shown = capsys.readouterr()
        title, line = shown.err.splitlines()
        assert (shown.out, title) == ("", "Error")
        assert [fact for fact in facts if fact not in line] == [], line
        assert not set("│╭╰─\\\x1b") & set(line)


def test_a_warning_meanwhile_is_not_lost(capsys) -> None:
    with common.one_line_errors("command"):
        print("k is lowered", file=sys.stderr)
    assert capsys.readouterr().err == "k is lowered\n"


def test_a_port_that_is_taken_is_told(monkeypatch, capsys):
    opened = Mock(side_effect=KeyboardInterrupt)
    monkeypatch.setattr(view, "check_lifted_run", lambda *_: None)
    monkeypatch.setattr(view, "open_all", opened)
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        for host in ("127.0.0.1", "0.0.0.0"):
            view.NormLiftView(Path("config.yml"), host=host, port=port, max_gaussians=7).main()
    lines = capsys.readouterr().out.splitlines()
    assert str(port) in lines[0] and len(lines) == 7
    servers = [call.args[0] for call in opened.call_args_list]
    assert [server.runs._max_gaussians for server in servers] == [7, 7]
    assert all(server._server.should_exit for server in servers)
    for line in (lines[1], lines[4]):
        assert f"http://127.0.0.1:{port} " not in line and "http://127.0.0.1:" in line
    assert lines[2] == lines[6] == "Stopped." and "?access=" in lines[5]
    assert view.NormLiftView(Path("config.yml")).host == "127.0.0.1"
