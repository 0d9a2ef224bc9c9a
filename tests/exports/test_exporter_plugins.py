"""An exporter of another package."""

from pathlib import Path

import pytest

from normlift_ns.cli import export
from normlift_ns.exports import EXPORTERS
from tests.cli.conftest import run_entry, said
from tests.encoders.test_plugins import plugged

NOTE = """
from normlift_ns.exports import Exporter
def write(job, path):
    path.write_text(f"{len(job.rows)} {job.answer.texts}")
    return [f"A note in {path.name}"]
NOTE = Exporter(write, ".txt")
"""


def test_the_command_runs_it(lifted: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    flags = ("--load-config", lifted, "--output-dir", tmp_path / "out", "--exporters", "note")
    with plugged(tmp_path, "plug", f"[{EXPORTERS.group}]\nnote = plug:NOTE\n", NOTE):
        assert run_entry(monkeypatch, export.entrypoint, *flags, "--text", "red") == 0
        assert "A note in splat_note.txt" in said(capsys)
        count, texts = (tmp_path / "out" / "splat_note.txt").read_text().split(maxsplit=1)
        assert int(count) > 5000 and texts == "('red',)"
    assert run_entry(monkeypatch, export.entrypoint, *flags, "--overwrite", "True") == 1
    assert "unknown exporter 'note'" in said(capsys)
