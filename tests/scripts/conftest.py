"""Commands, as the tests give them."""

from __future__ import annotations

import shutil
import sys
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import pytest

from normlift_ns.scripts.shared import run_command

SMALL = ("--encoder", "colour", "--k", "12")
"""Flags that lift the small demo room in a moment."""
QUICK = (*SMALL, "--check", "False")
"""The same without comparing the photographs first."""


def said(capsys: pytest.CaptureFixture[str]) -> str:
    """What was printed, results and then errors, without line breaks."""
    shown = capsys.readouterr()
    return " ".join((shown.out + shown.err).split())


def run_entry(monkeypatch: pytest.MonkeyPatch, entrypoint, *flags: object) -> int:
    """Exit code of a command."""
    monkeypatch.setattr(sys, "argv", ["command", *map(str, flags)])
    try:
        entrypoint()
    except SystemExit as stop:
        return int(stop.code or 0)
    return 0


@dataclass
class Command:
    """A command."""

    word: str = "x"
    """A word."""
    body: ClassVar[Callable[[str], Any]]

    def main(self) -> None:
        type(self).body(self.word)


@pytest.fixture
def ended(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> Callable[..., tuple[int, str, str]]:
    """Runs a command in this process, whose main is a function of --word: exit code, output and errors.

    Logs are in the folder state of tmp_path.
    """

    def show(message: Any, category: Any, filename: str, line: int, *_: object) -> None:
        sys.stderr.write(warnings.formatwarning(message, category, filename, line, ""))

    def run(body: Callable[[str], Any], *flags: str) -> tuple[int, str, str]:
        monkeypatch.setattr(Command, "body", staticmethod(body), raising=False)
        code = run_entry(monkeypatch, lambda: run_command(Command), *flags)
        return code, *capsys.readouterr()

    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.setattr(warnings, "showwarning", show)  # as without pytest
    return run


@pytest.fixture
def own(lifted: Path, tmp_path: Path) -> Path:
    """config.yml of the trained run, in a copy of everything that the test may change; `lifted` is in it too."""
    shutil.copytree(lifted.parents[4], tmp_path / "own")
    (config,) = (tmp_path / "own").glob("outputs/room/splatfacto/*/config.yml")
    return config
