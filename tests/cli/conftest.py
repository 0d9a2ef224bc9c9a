"""Commands, as the tests give them."""

import shutil
import sys
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar
from unittest.mock import MagicMock

import pytest

from normlift_ns.cli.common import run_command
from normlift_ns.demo.room import DemoRoom
from tests.conftest import make_lifted, make_trained

SMALL = ("--encoder", "color", "--vote-k", "12")
"""Flags that lift the small demo room in a moment."""
QUICK = (*SMALL, "--check-alignment", "False")
"""The same without comparing the photographs first."""


def said(capsys: pytest.CaptureFixture[str]) -> str:
    """What was printed, results and then errors, without line breaks."""
    shown = capsys.readouterr()
    return " ".join((shown.out + shown.err).split())


def run_entry(monkeypatch: pytest.MonkeyPatch, entrypoint, *flags: object) -> int:
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
def ended(monkeypatch, capsys, tmp_path: Path) -> Callable[..., tuple[int, str, str]]:
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
def ns_export(nerfstudio, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """nerfstudio's exporter; open3d, which it imports for meshes, needs system libraries."""
    monkeypatch.setitem(sys.modules, "open3d", MagicMock())
    from nerfstudio.scripts import exporter  # noqa: PLC0415

    yield exporter
    sys.modules.pop("nerfstudio.scripts.exporter")


@pytest.fixture(scope="session")
def little_room() -> DemoRoom:
    from tests.plain_room import plain_room  # noqa: PLC0415

    return plain_room(3000)


@pytest.fixture(scope="session")
def little(little_room: DemoRoom, made_once: Any) -> Path:
    """config.yml of a trained run with few Gaussians and 6 small photographs, for tests that lift or evaluate."""
    return make_trained(made_once, "little", little_room, views=6, width=96, height=72)


@pytest.fixture(scope="session")
def little_lifted(little: Path, made_once: Any) -> Path:
    return make_lifted(made_once, little, "t", "--region-count", "300")


@pytest.fixture
def own(little_lifted: Path, tmp_path: Path) -> Path:
    """config.yml of `little`, in a copy of everything that the test may change; `little_lifted` is in it too."""
    shutil.copytree(little_lifted.parents[4], tmp_path / "own")
    (config,) = (tmp_path / "own").glob("outputs/room/splatfacto/*/config.yml")
    return config
