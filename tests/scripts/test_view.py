"""ns-normlift-view, before it serves anything."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from normlift_ns.scripts import view

_ROOT = str(Path(__file__).parents[2])
_PROGRAM = "from normlift_ns.scripts.view import main; main()"


def ran(*flags: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": _ROOT, "COLUMNS": "120", "NO_COLOR": "1"}
    words = [sys.executable, "-c", _PROGRAM, *flags]
    return subprocess.run(words, env=environment, capture_output=True, text=True, check=False, timeout=60)


def test_help_tells_every_flag_and_loads_nothing_heavy():
    done = ran("--help")
    assert done.returncode == 0, done.stderr
    for flag in ("--load-config", "--host", "--port", "--share-readonly", "--most-drawn", "--text-vectors", "--data"):
        assert flag in done.stdout
    assert "127.0.0.1" in done.stdout
    heavy = "import sys, normlift_ns.scripts.view; print({'torch', 'viser', 'numpy', 'nerfstudio'} & set(sys.modules))"
    environment = {**os.environ, "PYTHONPATH": _ROOT}
    found = subprocess.run([sys.executable, "-c", heavy], env=environment, capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "set()"


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (
            ("--load-config", "nowhere/config.yml"),
            "No config at nowhere/config.yml. Expected the config.yml that ns-normlift wrote",
        ),
        (("--load-config", "config.yml", "--port", "70000"), "--port"),
        (("--load-config", "config.yml", "--most-drawn", "0"), "--most-drawn"),
        (("--load-config", "config.yml", "--device", "tpu"), "tpu"),
        (("--load-config", "config.yml", "--host", "192.0.2.1"), "--host 192.0.2.1 is no address that this machine"),
        (("--load-config", "config.yml", "--host", "no-such-host.invalid"), "--host no-such-host.invalid is no"),
        (("--load-config", "config.yml", "--host", "a" * 70), "is no address that this machine can listen at"),
    ],
)
def test_mistakes_are_told_before_anything_is_loaded(flags, message, tmp_path):
    done = ran(*flags)
    assert done.returncode == 1
    assert message in done.stderr
    assert "Traceback" not in done.stderr


def test_a_port_that_is_taken_is_told(monkeypatch, capsys):
    door = SimpleNamespace(server=SimpleNamespace(port=7010))
    monkeypatch.setattr("normlift_ns.viewer.serving.door.Door", lambda host, port: door)
    monkeypatch.setattr(view, "check_lifted", lambda *_: None)
    monkeypatch.setattr(view.NormLiftView, "open", interrupted)
    for port in (7008, 7010):
        view.NormLiftView(Path("config.yml"), port=port).main()
    told = ["Port 7008 is taken.", "The viewer is at http://127.0.0.1:7010 (Ctrl-C ends it)", "Stopped."]
    assert capsys.readouterr().out.splitlines() == [*told, *told[1:]]


def interrupted(*_: object) -> None:
    raise KeyboardInterrupt
