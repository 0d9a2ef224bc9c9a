"""Exporters by name: those of the package, and those of other packages by entry point."""

from __future__ import annotations

from pathlib import Path

import pytest

from normlift_ns.cli import export
from normlift_ns.errors import InputError
from normlift_ns.exports import EXPORTER_GROUP, EXPORTERS, find_exporter
from tests.encoders.test_kinds import plugged
from tests.scripts.conftest import run_entry, said


def points(**exporters: str) -> str:
    return f"[{EXPORTER_GROUP}]\n" + "".join(f"{name} = {value}\n" for name, value in exporters.items())


def test_those_of_the_package_need_no_metadata_and_cannot_be_replaced(tmp_path: Path) -> None:
    with plugged(tmp_path, "plug", points(ply="plug:KIND", other="plug:KIND"), "KIND = 3"):
        for name, exporter in EXPORTERS.items():
            assert find_exporter(name) is exporter
        with pytest.raises(InputError, match=r"unknown exporter 'csv'; .* arrays, cloud, masks, other, ply"):
            find_exporter("csv")


def test_a_broken_exporter_is_named(tmp_path: Path) -> None:
    for number, (value, code, message) in enumerate((
        ("nowhere:KIND", "", "ModuleNotFoundError"),
        ("plug:KIND", "1 / 0", "ZeroDivisionError"),
        ("plug:KIND", "raise SystemExit(3)", "SystemExit: 3"),
        ("plug:KIND", "KIND = 3", "plug:KIND is of type int, expected Exporter"),
    )):  # fmt: skip
        package = plugged(tmp_path / str(number), "plug", points(bad=value), code)
        with package, pytest.raises(InputError, match=f"exporter 'bad' .*{message}"):
            find_exporter("bad")


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
