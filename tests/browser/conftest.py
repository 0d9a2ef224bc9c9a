"""Lifted runs to look at, and where the pictures go that the tests take."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

from benchmarks.captures import SHARED
from benchmarks.plain_room import plain_room
from normlift_ns.demo import write_capture, write_splatfacto_run
from normlift_ns.options import LiftOptions, SourceOptions
from normlift_ns.scripts.lift import NormLift

TEXTS = ("red", "yellow", "sky blue", "dark green")


@pytest.fixture(scope="session")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder for screenshots; NORMLIFT_SCREENSHOTS names one that is kept."""
    kept = os.environ.get("NORMLIFT_SCREENSHOTS")
    folder = tmp_path_factory.mktemp("screenshots") if kept is None else Path(kept)
    folder.mkdir(parents=True, exist_ok=True)
    print(f"screenshots in {folder}")
    return folder


@pytest.fixture(scope="module")
def demo_run(lifted_room: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """config.yml of a lifted demo room, a copy for each file of tests: what one saves, no other finds."""
    copy = tmp_path_factory.mktemp("copied") / "outputs"
    shutil.copytree(lifted_room / "outputs", copy)
    return next(copy.glob("*/normlift/*/config.yml"))


@pytest.fixture(scope="session")
def lifted_room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The demo room, lifted with four queries into its folder outputs, as `make demo` leaves it but smaller."""
    folder = tmp_path_factory.mktemp("demo")
    room = plain_room(12_000)
    write_capture(room, folder / "room", views=12, width=320, height=240)
    config = write_splatfacto_run(room, folder / "room", folder / "outputs")
    NormLift(config, source=SourceOptions(encoder="colour"), queries=TEXTS, timestamp="demo").main()
    return folder


@pytest.fixture(scope="session")
def fox_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """config.yml of the fox capture, lifted from some of its views at half their size."""
    source = SHARED / "captures" / "outputs" / "fox" / "splatfacto" / "run" / "config.yml"
    options, folder = LiftOptions(max_views=12, lift_downscale=2), tmp_path_factory.mktemp("fox")
    colour = SourceOptions(encoder="colour")
    lifted = NormLift(source, source=colour, lift=options, output_dir=folder, timestamp="seen").main()
    return lifted.config
