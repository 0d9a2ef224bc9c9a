"""Lifted runs to look at, and where the pictures go that the tests take."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from benchmarks.captures import SHARED
from normlift_ns.demo import demo_room, write_capture, write_splatfacto_run
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


@pytest.fixture(scope="session")
def demo_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """config.yml of the demo room, lifted with four queries, as `make demo` leaves it but smaller."""
    folder = tmp_path_factory.mktemp("demo")
    room = demo_room(12_000)
    write_capture(room, folder / "room", views=12)
    config = write_splatfacto_run(room, folder / "room", folder / "outputs")
    lifted = NormLift(config, source=SourceOptions(encoder="colour"), queries=TEXTS, timestamp="demo").main()
    return lifted.config


@pytest.fixture(scope="session")
def fox_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """config.yml of the fox capture, lifted from some of its views at half their size."""
    source = SHARED / "captures" / "outputs" / "fox" / "splatfacto" / "run" / "config.yml"
    options, folder = LiftOptions(max_views=12, lift_downscale=2), tmp_path_factory.mktemp("fox")
    colour = SourceOptions(encoder="colour")
    lifted = NormLift(source, source=colour, lift=options, output_dir=folder, timestamp="seen").main()
    return lifted.config
