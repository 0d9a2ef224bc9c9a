"""The help of every command, word by word, without its line breaks and boxes.

After a change that is wanted: NORMLIFT_SNAPSHOTS=write pytest tests/scripts/test_help.py
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import pytest

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

COMMANDS = {
    "lift": "ns-normlift",
    "query": "ns-normlift-query",
    "export": "ns-normlift-export",
    "eval": "ns-normlift-eval",
    "view": "ns-normlift-view",
    "batch": "ns-normlift-batch",
    "check": "ns-normlift-check",
}
SCRIPTS = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text("utf8"))["project"]["scripts"]
FOLDER = Path(__file__).with_name("help")
BOXES = re.compile("[─-╿]+")


def shown(command: str, *flags: str, columns: int = 80) -> str:
    """What a command prints to a terminal of some width; its exit code must be 0."""
    place, name = SCRIPTS[command].split(":")
    program = f"import sys; sys.argv[0] = {command!r}; from {place} import {name}; {name}()"
    words = [sys.executable, "-c", program, *flags]
    environment = os.environ | {"COLUMNS": str(columns), "TERM": "dumb", "NO_COLOR": "1"}
    done = subprocess.run(words, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    return done.stdout


def sentences(text: str) -> str:
    """One line per flag or title, whatever the width and the boxes were."""
    words = " ".join(BOXES.sub(" ", text).split())
    return re.sub(r" (?=(--|[a-z]+ options\b))", "\n", words.split("] ", 1)[1]) + "\n"


@pytest.mark.parametrize("name", COMMANDS)
def test_help_is_as_it_was(name):
    found, file = sentences(shown(COMMANDS[name], "--help")), FOLDER / f"{name}.txt"
    if os.environ.get("NORMLIFT_SNAPSHOTS") == "write":
        file.write_text(found, "utf8")
    assert found == file.read_text("utf8")


@pytest.mark.parametrize("name", COMMANDS)
def test_help_reads_well(name):
    text = shown(COMMANDS[name], "--help", columns=80)
    assert "options options" not in text
    assert "Raises" not in text
    assert ">>>" not in text
    assert not re.search(r"\w+\.\w+ options", text)
    lines = [line.removeprefix("│ ").removesuffix(" │").rstrip() for line in text.splitlines()]
    width = 80 - len("│  │")
    for line, after in pairwise(lines):  # a line of help ends where the next word has no room
        if all(x.startswith(" " * 20) for x in (line, after)):
            assert len(line) + 1 + len(after.split()[0]) > width, (line, after)
    flags = [line.split()[0] for line in lines if line.startswith("--")]
    assert len(flags) == len(set(flags)) > (5 if name != "batch" else 2)  # which has ns-normlift's after --


@pytest.mark.parametrize("command", COMMANDS.values())
def test_version(command):
    assert re.fullmatch(r"normlift_ns \d+\.\d+\.\d+\n", shown(command, "--version"))
