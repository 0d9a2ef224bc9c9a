"""Fields and answers are those of version 0.1, number by number."""

import json
from pathlib import Path

import pytest

from normlift_ns.demo.capture import write_capture, write_splatfacto_run
from tests.captures import SHARED, needs_shared
from tests.golden.summary import compare, run_commands, summarize
from tests.plain_room import plain_room

GOLDEN = Path(__file__).with_name("golden.json")
pytestmark = pytest.mark.slow


def differences_from_golden(scene: str, config: Path, folder: Path) -> list[str]:
    run_commands(scene, config, folder)
    return compare(summarize(folder), json.loads(GOLDEN.read_text())[scene], 1e-5)


def test_the_demo_room(tmp_path: Path) -> None:
    room = plain_room()
    write_capture(room, tmp_path / "room", width=320, height=240)
    config = write_splatfacto_run(room, tmp_path / "room", tmp_path / "outputs")
    assert differences_from_golden("demo", config, tmp_path / "lifted") == []


@needs_shared
@pytest.mark.extra
@pytest.mark.parametrize("scene", ["fox", "tabletop"])
def test_real_captures(scene: str, tmp_path: Path) -> None:
    config = SHARED / "captures" / "outputs" / scene / "splatfacto" / "run" / "config.yml"
    assert differences_from_golden(scene, config, tmp_path) == []
