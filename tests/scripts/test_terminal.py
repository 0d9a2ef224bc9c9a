"""What the commands print, and where: --quiet, --log-file, colours, warnings of others, errors that can be copied."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from normlift_ns.errors import InputError
from normlift_ns.scripts import lift
from normlift_ns.scripts.terminal import Terminal, terminal_flags
from tests.scripts.conftest import SMALL, run_entry
from tests.scripts.test_ending import ended

BODY = """
    from normlift_ns.scripts.shared import say_opening, say_progress
    from pathlib import Path
    say_opening(Path("run"))
    say_progress("lift")
    say("answer " + self.word)
    warnings.warn_explicit("old", FutureWarning, "/site-packages/torch/jit.py", 7)
    warnings.warn_explicit("wrong", UserWarning, "/site-packages/torch/jit.py", 7)
    sys.stdout.write("\\x1b[31mred\\x1b[0m\\n")
"""


def test_quiet_leaves_results_warnings_and_errors(tmp_path: Path) -> None:
    code, out, err = ended(BODY, "--word", "a", state=tmp_path)
    assert (code, out.splitlines()[:2]) == (0, ["lift", "answer a"])
    assert err.startswith("Opening run") and "wrong" in err and "old" not in err
    for words in (("--quiet", "--word", "a"), ("--word", "a", "--quiet", "True")):
        code, out, err = ended(BODY, *words, state=tmp_path)
        assert (code, out.splitlines()[0]) == (0, "answer a")
        assert "Opening" not in err and "wrong" in err
    code, _, err = ended(f"{BODY}    raise InputError('no')", "--quiet", state=tmp_path)
    assert code == 1
    assert err.splitlines()[-2:] == ["Error", "no"]


def test_a_log_file_gets_everything_without_colours_and_is_added_to(tmp_path: Path) -> None:
    log = tmp_path / "a.log"
    for word in ("a", "b"):
        body = f"{BODY}    raise InputError('no {word}')"
        code, out, _ = ended(body, "--word", word, "--log-file", str(log), state=tmp_path)
        assert code == 1 and "\x1b[31mred" in out
    text = log.read_text("utf8")
    assert "\x1b" not in text
    for line in ("Opening run", "lift", "answer a", "answer b", "red", "Error", "no a", "no b"):
        assert line in text.splitlines()
    assert text.count("FutureWarning: old") == 2 and text.count("UserWarning: wrong") == 2
    assert f"--word b --log-file {log}" in text


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (("--log-file", "."), "is there and is no file"),
        (("--log-file", "nowhere/a.log"), "nowhere/a.log, given with --log-file, cannot be written: No such file"),
        (("--log-file",), "--log-file needs the name of a file"),
        (("--quiet", "yes"), "--quiet is True or False, got 'yes'"),
    ],
)
def test_mistakes_are_messages(flags: tuple[str, ...], message: str, tmp_path: Path) -> None:
    code, out, err = ended("say('a')", *flags, state=tmp_path)
    assert (code, out) == (1, "")
    assert message in err and "Traceback" not in err


def test_words_for_another_command_stay() -> None:
    words = ["list.txt", "--quiet", "False", "--", "--quiet", "--log-file", "x"]
    assert terminal_flags(words) == (["list.txt", *words[3:]], Terminal())
    with pytest.raises(InputError):
        terminal_flags(["--log-file", "--k"])


def test_pipes_and_no_color_have_no_colours(tmp_path: Path) -> None:
    program = "from normlift_ns.scripts.start import lift; lift()"
    environment = {name: value for name, value in os.environ.items() if name not in ("FORCE_COLOR", "NO_COLOR")}
    for flags in (("--help",), ("--load-config", str(tmp_path / "no.yml")), ("--wrod",)):
        words = [sys.executable, "-c", program, *flags]
        done = subprocess.run(words, capture_output=True, text=True, check=False, env=environment | {"TERM": "xterm"})
        assert "\x1b" not in done.stdout + done.stderr
    assert done.returncode == 1


@pytest.mark.skipif(sys.platform == "win32", reason="needs a pseudo-terminal")
@pytest.mark.parametrize("no_color", [True, False])
def test_a_terminal_has_colours_unless_it_is_told_otherwise(no_color: bool, tmp_path: Path) -> None:
    import pty  # noqa: PLC0415 (Windows has none)

    master, slave = pty.openpty()
    environment = {name: value for name, value in os.environ.items() if name not in ("FORCE_COLOR", "NO_COLOR")}
    environment |= {"TERM": "xterm-256color"} | ({"NO_COLOR": "1"} if no_color else {})
    program = "from normlift_ns.scripts.start import lift; lift()"
    words = [sys.executable, "-c", program, "--load-config", str(tmp_path / ("long-" * 30) / "no.yml")]
    process = subprocess.Popen(words, stdout=slave, stderr=slave, env=environment)
    process.wait(60)
    os.close(slave)
    shown = os.read(master, 10**5).decode().replace("\r\n", "\n")
    os.close(master)
    assert ("\x1b[" in shown.replace("\x1b[0m", "").replace("\x1b[1m", "")) != no_color
    lines = shown.splitlines()
    assert lines[0].endswith("Error\x1b[0m") or lines[0] == "Error"
    assert lines[1].startswith("No config at") and str(tmp_path) in lines[1]  # one line, at the left, however long


def test_the_next_command_is_a_line_of_its_own(trained: Path, monkeypatch, capsys, tmp_path: Path) -> None:
    places = ("--output-dir", tmp_path / ("deep-" * 20), "--timestamp", "next", "--queries", "red mug", "blue")
    assert run_entry(monkeypatch, lift.entrypoint, "--load-config", trained, *SMALL, *places) == 0
    shown = capsys.readouterr().out
    config = next(tmp_path.glob("deep-*/*/normlift/next/config.yml"))
    assert shown.splitlines()[-1] == f"ns-normlift-query --load-config {config} --text 'red mug'"
    words = " ".join(shown.replace("│", " ").split())
    assert "half of the Gaussians above 0." in words and "of Gaussians took over a neighbour's feature" in words
    assert "show in no image" in words
    quiet = ("--overwrite", "True", "--quiet")
    assert run_entry(monkeypatch, lift.entrypoint, "--load-config", trained, *SMALL, *places, *quiet) == 0
    assert capsys.readouterr().out.splitlines() == [shown.splitlines()[-1]]
