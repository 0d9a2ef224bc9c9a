"""Exporters by name: those of the package, and those of other packages by entry point."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from normlift_ns.cli import export
from normlift_ns.errors import InputError
from normlift_ns.exports import ARRAYS, CLOUD, EXPORTERS, MASKS, PLY
from tests.encoders.test_kinds import plugged
from tests.scripts.conftest import run_entry, said

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).parents[2]


def points(**exporters: str) -> str:
    return f"[{EXPORTERS.group}]\n" + "".join(f"{name} = {value}\n" for name, value in exporters.items())


def test_those_of_the_package_are_in_pyproject_and_cannot_be_replaced(tmp_path: Path) -> None:
    registered = tomllib.loads((ROOT / "pyproject.toml").read_text("utf8"))["project"]["entry-points"]
    assert registered[EXPORTERS.group] == EXPORTERS.built_in
    with plugged(tmp_path, "plug", points(ply="plug:KIND", other="plug:KIND"), "KIND = 3"):
        assert [EXPORTERS.load(name) for name in EXPORTERS.built_in] == [PLY, MASKS, ARRAYS, CLOUD]
        for name, message in (("csv", "arrays, cloud, masks, other, ply"), ("other", "type int, expected Exporter")):
            with pytest.raises(InputError, match=f"exporter '{name}'.*{message}"):
                EXPORTERS.load(name)


NOTE = """
from normlift_ns.exports import Exporter
def write(job, path):
    path.write_text(f"{len(job.rows)} {job.answer.texts}")
    return [f"A note in {path.name}"]
NOTE = Exporter(write, ".txt")
"""


def test_the_command_runs_it(lifted: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    flags = ("--load-config", lifted, "--output-dir", tmp_path / "out", "--exporters", "note")
    with plugged(tmp_path, "plug", points(note="plug:NOTE"), NOTE):
        assert run_entry(monkeypatch, export.entrypoint, *flags, "--text", "red") == 0
        assert "A note in splat_note.txt" in said(capsys)
        count, texts = (tmp_path / "out" / "splat_note.txt").read_text().split(maxsplit=1)
        assert int(count) > 5000 and texts == "('red',)"
    assert run_entry(monkeypatch, export.entrypoint, *flags, "--overwrite", "True") == 1
    assert "unknown exporter 'note'" in said(capsys)
