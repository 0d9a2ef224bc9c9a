"""ns-normlift-view, before it serves anything."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

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
        (("--load-config", "nowhere/config.yml"), "No config at nowhere/config.yml"),
        (("--load-config", "config.yml", "--port", "70000"), "--port"),
        (("--load-config", "config.yml", "--most-drawn", "0"), "--most-drawn"),
        (("--load-config", "config.yml", "--device", "tpu"), "tpu"),
    ],
)
def test_mistakes_are_told_before_anything_is_loaded(flags, message, tmp_path):
    done = ran(*flags)
    assert done.returncode == 1
    assert message in done.stderr
    assert "Traceback" not in done.stderr
