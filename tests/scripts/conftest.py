"""A small demo room, trained and lifted, for the tests of the commands."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from normlift_ns.demo import DemoRoom, demo_room, write_capture, write_splatfacto_run
from normlift_ns.scripts import lift

SMALL = ("--encoder", "colour", "--k", "12")


def run_entry(monkeypatch: pytest.MonkeyPatch, entrypoint, *flags: object) -> int:
    """Exit code of a command."""
    monkeypatch.setattr(sys, "argv", ["command", *map(str, flags)])
    try:
        entrypoint()
    except SystemExit as stop:
        return int(stop.code or 0)
    return 0


@pytest.fixture(scope="session")
def room() -> DemoRoom:
    return demo_room(6000)


@pytest.fixture(scope="session")
def trained(room: DemoRoom, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """config.yml of a run of stock splatfacto in the room."""
    folder = tmp_path_factory.mktemp("room")
    write_capture(room, folder / "room", views=12, held_out=2, width=160, height=120)
    return write_splatfacto_run(room, folder / "room", folder / "outputs")


@pytest.fixture(scope="session")
def lifted(trained: Path) -> Path:
    """config.yml of the lifted run."""
    with pytest.MonkeyPatch.context() as monkeypatch:
        flags = ("--load-config", trained, *SMALL, "--timestamp", "one", "--queries", "red", "yellow")
        assert run_entry(monkeypatch, lift.entrypoint, *flags) == 0
    return trained.parents[2] / "normlift" / "one" / "config.yml"
