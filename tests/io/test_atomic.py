"""Files appear completely or not at all, replace nothing unasked, and survive processes that are killed."""

import inspect
import json
import os
import resource
import shutil
import signal
import stat
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
import torch

from normlift_ns.io import atomic
from normlift_ns.io.arrays import save_arrays
from tests.processes import FORK, instants, killed_at, together

PROCESSES, TURNS = 4, 3
EVERY = [0, pytest.param(3, marks=pytest.mark.slow), pytest.param(1, marks=pytest.mark.extra)]
"""Accesses to the disk at which processes are killed, see `instants`."""


@pytest.fixture(params=["renames of Linux", "plain renames"])
def system(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """With what the system offers, and without it."""
    if request.param == "plain renames":
        monkeypatch.setattr(atomic, "_rename", lambda *_: False)
    return request.param


def names_in(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_a_text_never_leaves_its_folder(tmp_path: Path):
    texts = ["../../etc/passwd", 'a\\b:c*?"<>|', "x" * 300, "tea\npot\0", "..", "~", "größe 7"]
    for text in texts:
        path = tmp_path / f"{atomic.safe_file_name(text)}.ply"
        assert path.resolve().parent == tmp_path.resolve() and len(path.name) <= 44, text
        path.write_text("")
    assert len(names_in(tmp_path)) == len(texts)


def test_nothing_is_replaced_unasked(system: str, tmp_path: Path):
    path = tmp_path / "a" / "b.txt"
    atomic.write_text_file(path, "first")
    with pytest.raises(FileExistsError, match=rf"{path} exists"):
        atomic.write_text_file(path, "second")
    assert path.read_text() == "first"
    atomic.write_text_file(path, "second", overwrite=True)
    assert path.read_text() == "second"
    with pytest.raises(FileExistsError, match=r"b\.txt exists.* --output-json.*--overwrite"):
        atomic.refuse_existing(tmp_path / "c.txt", path, overwrite=False, flags="--output-json")
    atomic.refuse_existing(path, overwrite=True, flags="--output-json")
    path.unlink()
    path.symlink_to("nowhere")
    with pytest.raises(FileExistsError):
        atomic.write_text_file(path, "third")
    assert names_in(path.parent) == ["b.txt"]


def test_a_failure_leaves_what_was_there(tmp_path: Path):
    path = tmp_path / "a.txt"
    atomic.write_text_file(path, "before")
    for failure in (OSError(28, "No space left on device"), KeyboardInterrupt(), ValueError("bug")):
        with pytest.raises(type(failure)) as caught, atomic.atomic_file(path, overwrite=True) as draft:
            draft.write_text("half")
            raise failure
        assert not isinstance(failure, OSError) or str(caught.value).startswith(f"{path} cannot be written (")
        assert path.read_text() == "before"
        assert list(tmp_path.iterdir()) == [path]
    with pytest.raises(OSError, match=rf"{path}/sub/b.txt cannot be written \(.*delete"):
        atomic.write_text_file(path / "sub" / "b.txt", "")


def test_a_full_disk_names_the_final_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    numbers = torch.zeros(1000)

    def with_torch(path: Path) -> None:
        with atomic.atomic_file(path) as draft:
            torch.save(numbers, draft)

    def folder(path: Path) -> None:
        with atomic.draft_directory(path.parents[1]) as draft:
            atomic.write_text_file(draft / "inner" / "b.txt", "x" * 2000)

    ways: dict[str, Callable[[Path], Any]] = {
        "a": lambda path: atomic.write_text_file(path, "x" * 2000),
        "b": lambda path: save_arrays(path, {"a": numbers}),
        "c": with_torch,
        "run/inner/b.txt": folder,
    }
    monkeypatch.setattr(sys, "dont_write_bytecode", True)  # what is imported now would be cut off in Python's cache
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, hard))
    try:
        for name, write in ways.items():
            with pytest.raises(OSError, match="cannot be written") as caught:
                write(tmp_path / "out" / name)
            assert str(caught.value).startswith(f"{tmp_path / 'out' / name} cannot be written ("), name
            assert ".normlift-" not in str(caught.value) and str(caught.value).count("cannot be written") == 1, name
            assert not (tmp_path / "out").exists(), name
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_files_have_the_rights_of_new_files_and_reach_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    flushed, sync = [], os.fsync
    monkeypatch.setattr(os, "fsync", lambda number: flushed.append(os.fstat(number).st_ino) or sync(number))
    before = os.umask(0o027)
    try:
        save_arrays(tmp_path / "a.safetensors", {"a": torch.zeros(1)})
        with atomic.draft_directory(tmp_path / "run") as draft:
            save_arrays(draft / "b.safetensors", {"a": torch.zeros(1)})
            flushed.clear()  # of the draft
            assert atomic.commit_directory(draft, tmp_path / "run")
            assert {(tmp_path / name).stat().st_ino for name in (".", "run", "run/b.safetensors")} <= set(flushed)
        atomic.write_text_file(tmp_path / "c.txt", "")
    finally:
        os.umask(before)
    assert (tmp_path / "c.txt").stat().st_ino in flushed and flushed[-1] == tmp_path.stat().st_ino
    modes = [(tmp_path / name).stat().st_mode & 0o777 for name in ("a.safetensors", "run", "run/b.safetensors")]
    assert modes == [0o640, 0o750, 0o640]


def make_folder(path: Path, text: str, *, overwrite: bool = False) -> bool:
    with atomic.draft_directory(path) as draft:
        for i in range(2):
            atomic.write_text_file(draft / "inner" / f"{i}.txt", text)
        replaced = {f"inner/{i}.txt" for i in range(2)}
        return atomic.commit_directory(draft, path, replaced=(lambda _: replaced) if overwrite else None)


def content(path: Path) -> str:
    """The text of both files of a folder, which must be the same."""
    first, second = (path / "inner" / f"{i}.txt" for i in range(2))
    assert first.read_text() == second.read_text()
    assert sorted(path.rglob("*.txt")) == [first, second]
    return first.read_text()


def test_of_processes_that_write_at_once_none_loses_anything(system: str, tmp_path: Path):
    """One writes a new file or folder, each finds a numbered name, all replace a folder, and exports never mix."""
    paths = [tmp_path / "export" / name for name in ("a.ply", "a_rows", "a_objects")]
    make_folder(tmp_path / "replaced", "old")

    def number(i: int, place: Path) -> str:
        with atomic.draft_directory(place) as draft:
            atomic.write_text_file(draft / "name.txt", str(i))
            return next(path.name for path in atomic.numbered_paths(place) if atomic.commit_directory(draft, path))

    def work(i: int) -> list[tuple[bool, bool, str, bool]]:
        found = []
        for turn in range(TURNS):
            folder, won = tmp_path / str(turn), False
            with suppress(FileExistsError):
                atomic.write_text_file(folder / "file", str(i))
                won = True
            made, named = make_folder(folder / "new", str(i)), number(i, folder / "2024-05-01_120000")
            found.append((won, made, named, make_folder(tmp_path / "replaced", f"{i}", overwrite=True)))
            written, gone = (paths, []) if i % 2 else (paths[:2], paths[2:])
            with atomic.atomic_files(*written, overwrite=True, delete=gone) as drafts:
                for draft in drafts:
                    draft.write_text(f"{i} {turn}")
        return found

    found = together(PROCESSES, work)
    for turn, answers in enumerate(zip(*found)):
        folder = tmp_path / str(turn)
        won, made, names, replaced = zip(*answers)
        assert won.count(True) == made.count(True) == 1 and all(replaced)
        assert (folder / "file").read_text() == str(won.index(True))
        assert content(folder / "new") == str(made.index(True))
        assert sorted(names) == [f"2024-05-01_120000{end}" for end in ("", "_2", "_3", "_4")]
        assert [(folder / name / "name.txt").read_text() for name in names] == [str(i) for i in range(PROCESSES)]
        assert names_in(folder) == sorted([*names, "file", "new"])
    assert content(tmp_path / "replaced") in map(str, range(PROCESSES))
    texts = [path.read_text() for path in paths if path.exists()]
    assert len(set(texts)) == 1 and len(texts) == 2 + int(texts[0].split()[0]) % 2
    assert set((tmp_path / "export").iterdir()) <= set(paths)
    assert names_in(tmp_path) == sorted([*map(str, range(TURNS)), "export", "replaced"])


@pytest.fixture
def unsynced(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without waiting for the disk, of which killed processes need nothing."""
    monkeypatch.setattr(os, "fsync", lambda number: None)


def after_kills(action: Callable[[], object], reset: Callable[[], object], folder: Path, every: int) -> Iterator[int]:
    """After each kill of an action that is begun anew; the first is before it does anything, the last at its end."""
    for prepare in (reset, action, reset):  # what is imported or made but once is no step
        prepare()
    steps = instants(action, folder, every)
    assert len(steps) > 3 and steps[-1] > 12
    for step in steps:
        reset()
        assert killed_at(step, action, folder)
        yield step
    reset()
    assert not killed_at(steps[-1] + 1, action, folder)


@pytest.mark.usefixtures("unsynced")
@pytest.mark.parametrize("every", EVERY)
def test_a_killed_process_loses_no_folder(every: int, system: str, tmp_path: Path):
    """The old folder or the new one is there, at once or when the next command looks, with the files of others."""
    path, seen, gaps = tmp_path / "runs" / "now", [], 0
    new, old = (lambda text=text: make_folder(path, text, overwrite=True) for text in ("new", "old"))
    mine = {path / name: name for name in ("notes.md", "inner/2.md", "my files/deep/a.ply", ".hidden/b")}
    for file, text in mine.items():
        atomic.write_text_file(file, text)
    (path / "link").symlink_to("nowhere")
    for _ in after_kills(new, old, path.parent, every):
        gaps += not path.exists()
        atomic.complete_interrupted_writes(path.parent)
        seen.append(content(path))
        assert list(path.parent.iterdir()) == [path]
        assert {file: file.read_text() for file in mine} == mine and (path / "link").is_symlink()
    assert (seen[0], seen[-1], content(path)) == ("old", "new", "new")
    assert seen == sorted(seen, reverse=True)  # old, then new
    if every < 2:
        assert gaps == 0 if system == "renames of Linux" else gaps > 0  # that is what the journal is for


@pytest.mark.usefixtures("unsynced")
@pytest.mark.parametrize("every", EVERY)
@pytest.mark.parametrize("overwrite", [True, False])
def test_files_that_belong_together_are_completed_after_a_kill(every: int, overwrite: bool, tmp_path: Path):
    """All are old, or all are new once the next process looks; none is of another turn."""
    folder, seen, gaps = tmp_path / "out", [], 0
    paths = [folder / name for name in ("a.ply", "a_rows", "a_objects")]

    def texts() -> list[str]:
        return [path.read_text() for path in paths if path.exists()]

    def export() -> None:
        written, gone = (paths[:2], paths[2:]) if overwrite else (paths, [])
        with atomic.atomic_files(*written, overwrite=overwrite, delete=gone) as drafts:
            for draft in drafts:
                draft.write_text("new")

    def reset() -> None:
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        for path in paths if overwrite else ():
            path.write_text("old")

    for _ in after_kills(export, reset, folder, every):
        gaps += texts() not in (["old"] * 3, ["new"] * 2, ["new"] * 3, [])
        with suppress(FileExistsError):
            atomic.refuse_existing(*paths, overwrite=False, flags="--output-dir")  # as the next command does
        after = texts()
        assert after in ((["old"] * 3, ["new"] * 2) if overwrite else ([], ["new"] * 3))
        seen.append("new" in after)
        assert set(folder.iterdir()) <= set(paths)
    assert seen == sorted(seen) and set(seen) == {True, False}
    assert gaps > 0 or every > 1  # that is what the journal is for


def test_an_export_that_was_never_completed_is_not_completed_over_a_later_one(tmp_path: Path):
    paths = [tmp_path / "a", tmp_path / "b"]
    left = tmp_path / f".normlift-{'dead' * 4}"
    left.mkdir()
    (left / "b").write_text("older")
    atomic.write_journal(left, {"files": ["a", "b"], "remove": [], "overwrite": True})
    with atomic.atomic_files(*paths, overwrite=True) as drafts:
        for draft in drafts:
            draft.write_text("later")
    atomic.complete_interrupted_writes(tmp_path)
    assert [path.read_text() for path in paths] == ["later", "later"]
    assert sorted(tmp_path.iterdir()) == paths


def test_what_a_running_process_writes_is_left_alone(tmp_path: Path):
    begun = FORK.Event()

    def write() -> None:
        with atomic.atomic_file(tmp_path / "a.txt") as draft:
            draft.write_text("half")
            begun.set()
            time.sleep(600)

    process = FORK.Process(target=write)
    process.start()
    assert begun.wait(60)
    (temporary,) = tmp_path.iterdir()
    atomic.complete_interrupted_writes(tmp_path)
    atomic.write_text_file(tmp_path / "b.txt", "")
    assert (temporary / "a.txt").read_text() == "half"
    assert process.pid is not None
    os.kill(process.pid, signal.SIGKILL)
    process.join()
    atomic.complete_interrupted_writes(tmp_path)
    assert names_in(tmp_path) == ["b.txt"]


def test_without_locks_only_old_leftovers_are_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(atomic, "acquire_lock", lambda folder: None)
    ages = {f".normlift-{'1' * 16}": 23 * 3600, f".normlift-{'2' * 16}": 25 * 3600, ".other": 10**9}
    for name, seconds in ages.items():
        (tmp_path / name).mkdir()
        os.utime(tmp_path / name, (time.time() - seconds,) * 2)
    atomic.write_text_file(tmp_path / "a.txt", "text")
    assert names_in(tmp_path) == [f".normlift-{'1' * 16}", ".other", "a.txt"]


def test_a_folder_that_another_program_has_locked_can_be_written_to(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    assert atomic._LOCK_TIMEOUT == 60
    monkeypatch.setattr(atomic, "_LOCK_TIMEOUT", 0.02)
    descriptor = atomic.acquire_lock(tmp_path)
    atomic.write_text_file(tmp_path / "a.txt", "text")
    atomic.release_lock(descriptor)
    assert (tmp_path / "a.txt").read_text() == "text"


def test_a_journal_leads_nowhere_else(tmp_path: Path):
    temporary = tmp_path / "runs" / f".normlift-{'1' * 16}"
    (temporary / "x").mkdir(parents=True)
    atomic.write_journal(temporary, {"place": "../away", "new": "../../y", "old": "x"})
    other = tmp_path / "runs" / f".normlift-{'2' * 16}"
    other.mkdir()
    (other / "y").write_text("")
    (tmp_path / "kept").touch()
    atomic.write_journal(
        other, {"files": ["../../away", "../y"], "remove": ["../kept", "../../kept"], "overwrite": True}
    )
    atomic.complete_interrupted_writes(tmp_path / "runs")
    assert names_in(tmp_path) == ["kept", "runs"]
    assert names_in(tmp_path / "runs") == ["away", "y"]


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


def test_a_journal_of_somebody_else_is_not_followed(visited: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch):
    folder, sent = visited
    for text in (json.dumps(STEPS), f"{'0' * 64}\n{json.dumps(STEPS)}", "[" * 200_000, "", "\0"):
        (sent / "steps.journal").write_text(text)
        with pytest.warns(UserWarning, match=f"{sent.name} .* another user"):
            atomic.write_text_file(folder / "other", "", overwrite=True)
        assert [(folder / name).read_text() for name in ("mine", "thesis")] == ["precious"] * 2
        assert (sent / "mine").read_text() == "evil"
    atomic.write_journal(sent, STEPS)
    moved = sent.rename(folder / f".normlift-{'b' * 16}")
    with pytest.warns(UserWarning, match="another user or machine"):
        atomic.complete_interrupted_writes(folder)
    moved.rename(sent)
    with monkeypatch.context() as patch:
        patch.setattr(atomic, "_key", lambda: b"of another user")
        with pytest.warns(UserWarning, match="another user"):
            atomic.complete_interrupted_writes(folder)
    assert (folder / "thesis").exists()
    atomic.complete_interrupted_writes(folder)  # where it belongs
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
        atomic.complete_interrupted_writes(folder)
    assert len(list(folder.iterdir())) == 8 and len(list(folder.glob("*/notes"))) == 4


def test_the_key_is_the_users_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    make = inspect.unwrap(atomic._key)
    for state in ("new", "unwritable", "broken", "none"):
        folder = tmp_path / state / "normlift_ns"
        monkeypatch.setenv("XDG_STATE_HOME", str(folder.parent))
        if state == "unwritable":
            folder.parent.write_text("")
        elif state == "broken":
            folder.mkdir(parents=True)
            (folder / "key").write_text("short")
        elif state == "none":
            monkeypatch.setattr(atomic, "user_state_folder", lambda: None)
        first, second = make(), make()
        assert len(first) == len(second) == 32
        assert (first == second) == (state == "new"), state
    key = tmp_path / "new" / "normlift_ns" / "key"
    assert stat.S_IMODE(key.stat().st_mode) == 0o600
    assert names_in(key.parent) == ["key"]
