"""Fields and answers are those of version 0.1, number by number."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from benchmarks.captures import SHARED
from normlift_ns.demo import demo_room, write_capture, write_splatfacto_run
from tests.captures import needs_shared
from tests.golden.summary import compare, run_commands, summarize

GOLDEN = Path(__file__).with_name("golden.json")
pytestmark = pytest.mark.slow


def _check(scene: str, config: Path, folder: Path) -> None:
    run_commands(scene, config, folder)
    assert compare(summarize(folder), json.loads(GOLDEN.read_text())[scene], 1e-5) == []


def test_the_demo_room(tmp_path: Path) -> None:
    room = demo_room()
    write_capture(room, tmp_path / "room")
    _check("demo", write_splatfacto_run(room, tmp_path / "room", tmp_path / "outputs"), tmp_path / "lifted")


@needs_shared
@pytest.mark.parametrize("scene", ["fox", "tabletop"])
def test_real_captures(scene: str, tmp_path: Path) -> None:
    _check(scene, SHARED / "captures" / "outputs" / scene / "splatfacto" / "run" / "config.yml", tmp_path)
