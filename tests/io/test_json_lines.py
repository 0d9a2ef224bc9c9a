"""Lines of JSON by several processes: what is whole is read, whatever a killed one has left."""

import os
from dataclasses import dataclass

from hypothesis import given
from hypothesis import strategies as st

from normlift_ns.io.file_lock import append_jsonl, read_jsonl


@dataclass(frozen=True)
class Line:
    name: str
    number: float


LINES = [Line('fox "\n\u2028 é 🦊', 1.5), Line("", 2.0), Line("}{", -3.0)]


@given(st.integers(0, 200))
def test_torn_lines_are_left_out(tmp_path_factory, cut):
    folder = tmp_path_factory.mktemp("lines")
    for line in LINES:
        append_jsonl(folder / "a.jsonl", line)
        append_jsonl(folder / "b.jsonl", line)
    whole = (folder / "a.jsonl").read_bytes()
    assert whole.count(b"\n") == len(LINES) and read_jsonl(folder, Line) == LINES * 2
    (folder / "a.jsonl").write_bytes(whole[:cut])
    ends = [i for i, byte in enumerate(whole) if byte == ord("\n")]
    assert read_jsonl(folder, Line) == LINES[: sum(end <= cut for end in ends)] + LINES


def test_what_is_no_line_of_that_kind_is_left_out(tmp_path):
    junk = (b"", b"\n\n", b"\xff\xfe\n", b"null\n", b"[1]\n", b'{"name": 1}\n', b"[" * 100_000 + b"\n", b"\0\n")
    for i, content in enumerate(junk):
        folder = tmp_path / str(i)
        folder.mkdir()
        append_jsonl(folder / "a.jsonl", LINES[0])
        with (folder / "a.jsonl").open("ab") as file:
            file.write(content)
        append_jsonl(folder / "a.jsonl", LINES[1])
        (folder / "notes.txt").write_text('{"name": "x", "number": 1}\n')
        assert read_jsonl(folder, Line) == LINES[:2], content[:20]
    assert read_jsonl(tmp_path / "nowhere", Line) == []


def test_a_line_reaches_the_disk(tmp_path, monkeypatch):
    flushed = []
    monkeypatch.setattr(os, "fsync", lambda number: flushed.append((os.fstat(number).st_ino, os.fstat(number).st_size)))
    append_jsonl(tmp_path / "a.jsonl", LINES[0])
    assert flushed == [((tmp_path / "a.jsonl").stat().st_ino, (tmp_path / "a.jsonl").stat().st_size)]
