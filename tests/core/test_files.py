"""Files appear completely or not at all, replace nothing unasked, and survive processes that are killed."""

from __future__ import annotations

import inspect
import json
import os
import resource
import shutil
import signal
import stat
import sys
import time
from contextlib import suppress
from pathlib import Path

import pytest
import torch

from normlift_ns.core import files
from normlift_ns.core.disk import atomic, journal
from normlift_ns.core.disk.journal import write_journal
from normlift_ns.core.disk.tensors import save_tensors
from normlift_ns.core.files import (
    clean,
    draft_directory,
    file_name,
    new_file,
    new_files,
    numbered,
    publish,
    refuse_existing,
    write_text,
)
from tests.processes import FORK, killed_at, together


@pytest.fixture(params=["renames of Linux", "plain renames"])
def system(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """With what the system offers, and without it."""
    if request.param == "plain renames":
        monkeypatch.setattr(atomic, "_rename", lambda *_: False)
    return request.param


@pytest.mark.parametrize("text", ["../../etc/passwd", 'a\\b:c*?"<>|', "x" * 300, "tea\npot\0", "..", "~", "größe 7"])
def test_a_text_never_leaves_its_folder(text: str, tmp_path: Path):
    path = tmp_path / f"{file_name(text)}.ply"
    assert path.resolve().parent == tmp_path.resolve()
    assert len(path.name) <= 44
    path.write_text("")
    assert list(tmp_path.iterdir()) == [path]


def test_nothing_is_replaced_unasked(system: str, tmp_path: Path):
    path = tmp_path / "a" / "b.txt"
    write_text(path, "first")
    with pytest.raises(FileExistsError, match=rf"{path} exists; give another name"):
        write_text(path, "second")
    assert path.read_text() == "first"
    write_text(path, "second", overwrite=True)
    assert path.read_text() == "second"
    with pytest.raises(FileExistsError, match=r"b\.txt exists; give another --json, or --overwrite True"):
        refuse_existing(tmp_path / "c.txt", path, overwrite=False, instead="--json")
    refuse_existing(path, overwrite=True, instead="--json")
    path.unlink()
    path.symlink_to("nowhere")
    with pytest.raises(FileExistsError):
        write_text(path, "third")
    assert [p.name for p in path.parent.iterdir()] == ["b.txt"]


@pytest.mark.parametrize("failure", [OSError(28, "No space left on device"), KeyboardInterrupt(), ValueError("bug")])
def test_a_failure_leaves_what_was_there(failure: BaseException, tmp_path: Path):
    path = tmp_path / "a.txt"
    write_text(path, "before")
    with pytest.raises(type(failure)) as caught, new_file(path, overwrite=True) as draft:
        draft.write_text("half")
        raise failure
    if isinstance(failure, OSError):
        assert str(caught.value).startswith(f"{path} cannot be written (")
        assert "free disk space or choose another folder" in str(caught.value)
    assert path.read_text() == "before"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("kind", ["text", "safetensors", "torch", "folder"])
def test_a_full_disk_names_the_final_file(kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path, numbers = tmp_path / "out" / "a.bin", torch.zeros(1000)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)  # what is imported now would be cut off in Python's cache
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, hard))
    try:
        with pytest.raises(OSError, match="cannot be written") as caught:
            if kind == "text":
                write_text(path, "x" * 2000)
            elif kind == "safetensors":
                save_tensors(path, {"a": numbers})
            elif kind == "torch":
                with new_file(path) as draft:
                    torch.save(numbers, draft)
            else:
                with draft_directory(path) as folder:
                    write_text(folder / "inner" / "b.txt", "x" * 2000)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    named = path / "inner" / "b.txt" if kind == "folder" else path
    assert str(caught.value).startswith(f"{named} cannot be written (")
    assert ".normlift-" not in str(caught.value)
    assert str(caught.value).count("cannot be written") == 1
    assert list(path.parent.iterdir()) == []


def test_a_folder_that_cannot_be_made_is_named(tmp_path: Path):
    (tmp_path / "file").touch()
    with pytest.raises(OSError, match=rf"{tmp_path}/file/sub/a.txt cannot be written \(.*Not a directory"):
        write_text(tmp_path / "file" / "sub" / "a.txt", "")


def test_files_have_the_rights_of_new_files(tmp_path: Path):
    before = os.umask(0o027)
    try:
        save_tensors(tmp_path / "a.safetensors", {"a": torch.zeros(1)})
        with draft_directory(tmp_path / "run") as draft:
            save_tensors(draft / "b.safetensors", {"a": torch.zeros(1)})
            assert publish(draft, tmp_path / "run")
    finally:
        os.umask(before)
    modes = [(tmp_path / name).stat().st_mode & 0o777 for name in ("a.safetensors", "run", "run/b.safetensors")]
    assert modes == [0o640, 0o750, 0o640]


def test_one_of_eight_processes_writes_a_new_file(system: str, tmp_path: Path):
    for turn in range(5):
        path = tmp_path / f"{turn}.txt"
        found = together(8, lambda i, path=path: write_text(path, str(i)))
        winners = [i for i, error in enumerate(found) if error is None]
        assert path.read_text() == str(*winners)
        assert all(isinstance(error, FileExistsError) for i, error in enumerate(found) if i not in winners)


def test_files_of_two_writers_never_mix(tmp_path: Path):
    paths = [tmp_path / name for name in ("a.ply", "a_rows.npy", "a_objects.json")]

    def export(i: int) -> None:
        for turn in range(15):
            written, gone = (paths, []) if i % 2 else (paths[:2], paths[2:])
            with new_files(*written, overwrite=True, remove=gone) as drafts:
                for draft in drafts:
                    draft.write_text(f"{i} {turn}")

    assert together(8, export) == [None] * 8
    texts = [path.read_text() for path in paths if path.exists()]
    assert len(set(texts)) == 1
    assert len(texts) == 2 + int(texts[0].split()[0]) % 2
    assert set(tmp_path.iterdir()) <= set(paths)


def make_folder(path: Path, text: str, *, overwrite: bool = False) -> bool:
    with draft_directory(path) as draft:
        for i in range(2):
            write_text(draft / "inner" / f"{i}.txt", text)
        return publish(draft, path, overwrite=overwrite)


def content(path: Path) -> str:
    """The text of both files of a folder, which must be the same."""
    first, second = (path / "inner" / f"{i}.txt" for i in range(2))
    assert first.read_text() == second.read_text()
    assert sorted(path.rglob("*.txt")) == [first, second]
    return first.read_text()


def test_eight_processes_with_one_name_lose_nothing(system: str, tmp_path: Path):
    place = tmp_path / "2024-05-01_120000"

    def lift(i: int) -> str:
        with draft_directory(place) as draft:
            write_text(draft / "name.txt", str(i))
            return next(path.name for path in numbered(place) if publish(draft, path))

    names = together(8, lift)
    assert sorted(names) == sorted([place.name, *(f"{place.name}_{i}" for i in range(2, 9))])
    assert [(tmp_path / name / "name.txt").read_text() for name in names] == [str(i) for i in range(8)]
    assert together(8, lambda i: make_folder(tmp_path / "now", str(i))).count(True) == 1
    assert len(list(tmp_path.iterdir())) == 9


def test_eight_processes_replace_one_folder(system: str, tmp_path: Path):
    path = tmp_path / "now"
    make_folder(path, "old")
    assert together(8, lambda i: make_folder(path, str(i), overwrite=True)) == [True] * 8
    assert content(path) in map(str, range(8))
    assert list(tmp_path.iterdir()) == [path]


def test_a_killed_process_loses_no_folder(system: str, tmp_path: Path):
    """At every access to the disk: the old folder or the new one is there, at once or when the next command looks."""
    path, step, seen, gaps = tmp_path / "runs" / "now", 0, [], 0
    while True:
        make_folder(path, "old", overwrite=True)
        step += 2 if system == "renames of Linux" else 1
        if not killed_at(step, lambda: make_folder(path, "new", overwrite=True), path.parent):
            break
        gaps += not path.exists()
        clean(path.parent)
        seen.append(content(path))
        assert list(path.parent.iterdir()) == [path]
    assert step > 30
    assert (seen[0], seen[-1], content(path)) == ("old", "new", "new")
    assert seen == sorted(seen, reverse=True)  # old, then new
    assert gaps == 0 if system == "renames of Linux" else gaps > 0  # that is what the journal is for


def test_a_killed_process_writes_no_half_file(tmp_path: Path):
    path, step, seen = tmp_path / "a" / "a.txt", 0, []
    while True:
        write_text(path, "old", overwrite=True)
        step += 1
        if not killed_at(step, lambda: write_text(path, "new", overwrite=True), path.parent):
            break
        seen.append(path.read_text())
    assert set(seen) == {"old", "new"}
    assert list(path.parent.iterdir()) == [path]  # the last one cleaned up after all others


@pytest.mark.parametrize("overwrite", [True, False])
def test_files_that_belong_together_are_completed_after_a_kill(overwrite: bool, tmp_path: Path):
    """At every access to the disk: all are old, or all are new once the next process looks; none is of another turn."""
    names, step, seen, gaps = ("a.ply", "a_rows.npy", "a_objects.json"), 0, [], 0
    folder = tmp_path / "out"
    paths = [folder / name for name in names]

    def export(text: str) -> None:
        written, gone = (paths[:2], paths[2:]) if overwrite else (paths, [])
        with new_files(*written, overwrite=overwrite, remove=gone) as drafts:
            for draft in drafts:
                draft.write_text(text)

    while True:
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        if overwrite:
            for path in paths:
                write_text(path, "old")
        step += 1
        if not killed_at(step, lambda: export("new"), folder):
            break
        before = [path.read_text() for path in paths if path.exists()]
        gaps += before not in (["old"] * 3, ["new"] * 2, ["new"] * 3, [])
        with suppress(FileExistsError):
            refuse_existing(*paths, overwrite=False, instead="--output-dir")  # as the next command does
        after = [path.read_text() for path in paths if path.exists()]
        assert after in ((["old"] * 3, ["new"] * 2) if overwrite else ([], ["new"] * 3))
        seen.append("new" in after)
        assert {path.name for path in folder.iterdir()} <= set(names)
    assert seen == sorted(seen)
    assert set(seen) == {True, False}
    assert gaps > 0  # that is what the journal is for


def test_an_export_that_was_never_completed_is_not_completed_over_a_later_one(tmp_path: Path):
    paths = [tmp_path / "a", tmp_path / "b"]
    left = tmp_path / f".normlift-{'dead' * 4}"
    left.mkdir()
    (left / "b").write_text("older")
    write_journal(left, {"files": ["a", "b"], "remove": [], "overwrite": True})
    with new_files(*paths, overwrite=True) as drafts:
        for draft in drafts:
            draft.write_text("later")
    clean(tmp_path)
    assert [path.read_text() for path in paths] == ["later", "later"]
    assert sorted(tmp_path.iterdir()) == paths


def test_what_a_running_process_writes_is_left_alone(tmp_path: Path):
    begun = FORK.Event()

    def write() -> None:
        with new_file(tmp_path / "a.txt") as draft:
            draft.write_text("half")
            begun.set()
            time.sleep(600)

    process = FORK.Process(target=write)
    process.start()
    assert begun.wait(60)
    (temporary,) = tmp_path.iterdir()
    clean(tmp_path)
    write_text(tmp_path / "b.txt", "")
    assert (temporary / "a.txt").read_text() == "half"
    assert process.pid is not None
    os.kill(process.pid, signal.SIGKILL)
    process.join()
    clean(tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["b.txt"]


def test_without_locks_only_old_leftovers_are_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """As on Windows and on some network drives."""
    for module in (files, atomic):
        monkeypatch.setattr(module, "hold", lambda folder: None)
    new, old, other = (tmp_path / name for name in (f".normlift-{'1' * 16}", f".normlift-{'2' * 16}", ".other"))
    for folder in (new, old, other):
        folder.mkdir()
    os.utime(old, (0, 0))
    os.utime(other, (0, 0))
    write_text(tmp_path / "a.txt", "text")
    assert sorted(p.name for p in tmp_path.iterdir()) == [new.name, ".other", "a.txt"]


def test_a_folder_that_another_program_has_locked_can_be_written_to(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(atomic, "_PATIENCE", 0.1)
    descriptor = atomic.hold(tmp_path)
    write_text(tmp_path / "a.txt", "text")
    atomic.release(descriptor)
    assert (tmp_path / "a.txt").read_text() == "text"


def test_a_journal_leads_nowhere_else(tmp_path: Path):
    temporary = tmp_path / "runs" / f".normlift-{'1' * 16}"
    (temporary / "x").mkdir(parents=True)
    write_journal(temporary, {"place": "../away", "new": "../../y", "old": "x"})
    other = tmp_path / "runs" / f".normlift-{'2' * 16}"
    other.mkdir()
    (other / "y").write_text("")
    (tmp_path / "kept").touch()
    write_journal(other, {"files": ["../../away", "../y"], "remove": ["../kept", "../../kept"], "overwrite": True})
    clean(tmp_path / "runs")
    assert not (tmp_path / "away").exists()
    assert {p.name for p in tmp_path.iterdir()} == {"runs", "kept"}
    assert {p.name for p in (tmp_path / "runs").iterdir()} == {"away", "y"}


STEPS = {"files": ["mine"], "remove": ["thesis"], "overwrite": True}


@pytest.fixture
def visited(tmp_path: Path) -> tuple[Path, Path]:
    """A folder with two files of a user, and one that somebody sent, which looks like a leftover of ours."""
    for name in ("mine", "thesis"):
        (tmp_path / name).write_text("precious")
    sent = tmp_path / f".normlift-{'a' * 16}"
    sent.mkdir()
    (sent / "mine").write_text("evil")
    return tmp_path, sent


@pytest.mark.parametrize("text", [json.dumps(STEPS), f"{'0' * 64}\n{json.dumps(STEPS)}", "[" * 200_000, "", "\0"])
def test_a_journal_of_somebody_else_is_not_followed(text: str, visited: tuple[Path, Path]):
    folder, sent = visited
    (sent / "steps.journal").write_text(text)
    with pytest.warns(UserWarning, match=f"{sent.name} holds files that another user"):
        write_text(folder / "other", "")
    assert [(folder / name).read_text() for name in ("mine", "thesis")] == ["precious"] * 2
    assert (sent / "mine").read_text() == "evil"


def test_a_journal_that_was_moved_is_not_followed(visited: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch):
    folder, sent = visited
    write_journal(sent, STEPS)
    moved = sent.rename(folder / f".normlift-{'b' * 16}")
    with pytest.warns(UserWarning, match="another machine"):
        clean(folder)
    moved.rename(sent)
    with monkeypatch.context() as patch:
        patch.setattr(journal, "_key", lambda: b"of another user")
        with pytest.warns(UserWarning, match="another user"):
            clean(folder)
    assert (folder / "thesis").exists()
    clean(folder)  # where it belongs
    assert (folder / "mine").read_text() == "evil" and not (folder / "thesis").exists() and not sent.exists()


def test_nothing_but_leftovers_of_ours_is_touched_and_nothing_makes_us_wait(visited: tuple[Path, Path]):
    folder, sent = visited
    for name in (".normlift-backup", ".normlift-0", f".normlift-{'A' * 16}"):
        (folder / name).mkdir()
        (folder / name / "notes").write_text("")
    os.mkfifo(folder / f".normlift-{'c' * 16}")
    (folder / f".normlift-{'d' * 16}").symlink_to(folder / ".normlift-backup")
    os.mkfifo(sent / "steps.journal")
    with pytest.warns(UserWarning, match="another user"):
        clean(folder)
    assert len(list(folder.iterdir())) == 8 and len(list(folder.glob("*/notes"))) == 4


@pytest.mark.parametrize("state", ["new", "unwritable", "broken", "none"])
def test_the_key_is_the_users_own(state: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    folder, make = tmp_path / "state" / "normlift_ns", inspect.unwrap(journal._key)
    if state == "unwritable":
        (tmp_path / "state").write_text("")
    if state == "broken":
        folder.mkdir(parents=True)
        (folder / "key").write_text("short")
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    if state == "none":
        monkeypatch.setattr(journal, "state_folder", lambda: None)
    first, second = make(), make()
    assert len(first) == len(second) == 32
    assert (first == second) == (state == "new")
    if state == "new":
        assert stat.S_IMODE((folder / "key").stat().st_mode) == 0o600
        assert [path.name for path in folder.iterdir()] == ["key"]
