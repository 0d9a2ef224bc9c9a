"""The one way to write: completely or not at all, and over nothing that is there unless asked.

Everything is made in a temporary folder beside its place, flushed to the disk and renamed. A process keeps the lock of
its temporary folder as long as it lives, so that the next one can tell what is left over, and removes it.
"""

from __future__ import annotations

import os
import re
import secrets
import shutil
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from itertools import count
from pathlib import Path

from safetensors import SafetensorError

from normlift_ns.core.disk.atomic import exchange, held, hold, release, rename_new
from normlift_ns.core.disk.journal import complete, write_journal
from normlift_ns.errors import InputError

_TEMPORARY = ".normlift-"
_OURS = re.compile(r"\.normlift-[0-9a-f]{16}")
"""Names of temporary folders."""
_RUN_FILES = {"config.yml", "dataparser_transforms.json", "splat.json", "transforms.json"}
_RUN_FILES |= {"nerfstudio_models", "normlift"}
_AGE = 86400
"""Seconds after which a temporary folder counts as left over where the system has no locks."""


class NotWrittenError(OSError):
    """Something cannot be written: the message names it as it would be called, and says why."""


@contextmanager
def new_files(*paths: Path, overwrite: bool = False, remove: Sequence[Path] = ()) -> Iterator[tuple[Path, ...]]:
    """Yields a draft of every path, all of one folder; when they are written, they take their places together.

    Two processes that write the same paths at once never mix their files. If this one dies between the first rename and
    the last, the next that writes there completes them.

    Args:
        overwrite: replace what is there.
        remove: files that must not outlive those that are replaced.
    Raises:
        FileExistsError: something is there, and `overwrite` is False.
        NotWrittenError: the disk is full, or the like; nothing has changed then.

    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp()) / "new folder" / "a.txt"
    >>> with new_files(path) as (draft,):
    ...     _ = draft.write_text("text")
    >>> path.read_text()
    'text'
    """
    folder, taken = paths[0].parent, None
    with _draft_folder(*paths) as temporary:
        drafts = tuple(temporary / path.name for path in paths)
        yield drafts
        _flush(temporary)
        with held(folder):
            if not overwrite:
                taken = next((path for path in paths if os.path.lexists(path)), None)
            if taken is None:
                taken = _take_places(temporary, drafts, overwrite, remove)
        _flush_names(folder)
    if taken is not None:
        raise FileExistsError(f"{taken} exists; give another name, or allow to overwrite it")


@contextmanager
def new_file(path: Path, *, overwrite: bool = False) -> Iterator[Path]:
    """`new_files` for one."""
    with new_files(path, overwrite=overwrite) as (draft,):
        yield draft


def write_text(path: Path, text: str, *, overwrite: bool = False) -> None:
    """A text file in UTF-8; raises as `new_files`."""
    with new_file(path, overwrite=overwrite) as draft:
        draft.write_text(text, "utf8")


@contextmanager
def draft_directory(path: Path) -> Iterator[Path]:
    """Yields an empty folder, for `publish` to put in the place of `path` or of another name beside it.

    Raises:
        NotWrittenError: the disk is full, or the like.
    """
    with _draft_folder(path) as temporary:
        draft = temporary / path.name
        draft.mkdir()
        yield draft


def publish(draft: Path, path: Path, *, overwrite: bool = False) -> bool:
    """Renames a folder of `draft_directory` to its name; False if something is there and may not be replaced.

    What is replaced is there, old or new, at every instant: the two are exchanged. Where the system cannot, a journal
    says what is under way, so that the next command that opens or writes the run completes it.
    """
    _flush(draft)
    with held(path.parent):
        if not rename_new(draft, path):
            if not overwrite:
                return False
            if not exchange(draft, path):
                _replace_in_steps(draft, path)
    _flush_names(path.parent)
    return True


def _take_places(temporary: Path, drafts: Sequence[Path], overwrite: bool, remove: Sequence[Path]) -> Path | None:
    """Renames drafts to their places; returns one that somebody else has taken meanwhile, if there is one."""
    journal, folder = None, temporary.parent
    if len(drafts) + len(remove) > 1:
        clean(folder)  # an older export that was never completed must not be completed after this one
        names = {"files": [draft.name for draft in drafts], "remove": [path.name for path in remove]}
        journal = write_journal(temporary, names | {"overwrite": overwrite})
        _flush_names(temporary)
    for draft in drafts:
        if overwrite:
            os.replace(draft, folder / draft.name)
        elif not rename_new(draft, folder / draft.name):  # no process of ours put that there just now
            if journal is not None:
                journal.unlink()
            return folder / draft.name
    for path in remove:
        path.unlink(missing_ok=True)
    return None


def _replace_in_steps(draft: Path, path: Path) -> None:
    old, temporary = f"{path.name}.old", draft.parent
    write_journal(temporary, {"place": path.name, "new": draft.name, "old": old})
    _flush_names(temporary)
    try:
        os.rename(path, temporary / old)
        os.rename(draft, path)
    finally:
        complete(temporary)


def clean(folder: Path) -> None:
    """Removes what processes that ended half-way have left in a folder, and completes what they were replacing.

    What a running process writes is left alone.
    """
    for temporary in folder.glob(f"{_TEMPORARY}*"):
        if _OURS.fullmatch(temporary.name) is None or temporary.is_symlink():
            continue
        with suppress(OSError, ValueError, LookupError, TypeError, RecursionError):  # a process holds it, or no journal
            descriptor = hold(temporary)
            try:
                ours = complete(temporary)
                if ours and (descriptor is not None or time.time() - temporary.stat().st_mtime > _AGE):
                    shutil.rmtree(temporary, ignore_errors=True)
            finally:
                release(descriptor)


@contextmanager
def _draft_folder(*paths: Path) -> Iterator[Path]:
    """A temporary folder beside the paths; errors name the paths, not what is in it."""
    folder, temporary = paths[0].parent, None
    try:
        folder.mkdir(parents=True, exist_ok=True)
        clean(folder)
        temporary, descriptor = _temporary_folder(folder)
        try:
            yield temporary
        finally:
            try:
                complete(temporary)
                shutil.rmtree(temporary, ignore_errors=True)
            finally:
                release(descriptor)
    except (OSError, RuntimeError, SafetensorError) as error:  # what torch and safetensors make of a full disk
        reason = str(error)
        if temporary is not None:
            reason = reason.replace(f"{temporary}{os.sep}", f"{folder}{os.sep}")
        if not isinstance(error, NotWrittenError):
            names = ", ".join(map(str, paths))
            blocked = isinstance(error, IsADirectoryError | NotADirectoryError | FileExistsError)
            remedy = "delete what is in its place" if blocked else "free disk space or choose another folder"
            reason = f"{names} cannot be written ({reason}); {remedy}, then run again"
        raise NotWrittenError(reason) from error


def _temporary_folder(folder: Path) -> tuple[Path, int | None]:
    """A new folder and its lock. It is made as any other folder, because mkdtemp's would hide it from the group."""
    while True:
        temporary = folder / f"{_TEMPORARY}{secrets.token_hex(8)}"
        temporary.mkdir()
        with suppress(BlockingIOError, FileNotFoundError):  # a process that cleans was faster
            descriptor = hold(temporary)
            if temporary.exists():
                return temporary, descriptor
            release(descriptor)


def _flush(folder: Path) -> None:
    """Everything in a temporary folder reaches the disk, with the rights that new files have."""
    rights = folder.stat().st_mode & 0o666  # safetensors gives its files to their owner alone
    for parent, _, files in os.walk(folder):
        for name in files:
            path = os.path.join(parent, name)
            with suppress(OSError):  # a file system without rights
                os.chmod(path, rights)
            descriptor = os.open(path, os.O_RDWR)
            try:
                os.fsync(descriptor)
            finally:
                os.close(descriptor)
        _flush_names(Path(parent))


def _flush_names(folder: Path) -> None:
    """The names in a folder reach the disk, where the system can do that."""
    with suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def refuse_existing(*paths: Path, overwrite: bool, instead: str) -> None:
    """Says, before anything is computed, what a command would replace unasked.

    Args:
        instead: the flags that name another place.
    Raises:
        FileExistsError: one of the paths is there and `overwrite` is False.
        ValueError: as `refuse_run_files`.
    """
    refuse_run_files(*paths, instead=instead)
    for folder in {path.parent for path in paths}:
        clean(folder)
    for path in paths:
        if not overwrite and os.path.lexists(path):
            raise FileExistsError(f"{path} exists; give another {instead}, or --overwrite True.")


def file_name(text: str) -> str:
    """A text as part of a file name: letters and digits stay, 40 characters at most.

    >>> file_name("../tea pot")
    '___tea_pot'
    """
    return "".join(c if c.isalnum() else "_" for c in text[:40])


def numbered(path: Path) -> Iterator[Path]:
    """The path, then path_2, path_3, …

    >>> names = numbered(Path("red.ply"))
    >>> next(names).name, next(names).name
    ('red.ply', 'red_2.ply')
    """
    yield path
    yield from (path.with_name(f"{path.stem}_{number}{path.suffix}") for number in count(2))


def refuse_run_files(*paths: Path, instead: str) -> None:
    """Says, before anything is computed, that an output would take the place of a part of a run, asked or not.

    A run is a folder with config.yml and nerfstudio_models/ in it; pictures, tables and exports beside these are fine.

    Args:
        instead: the flags that name another place.
    Raises:
        ValueError: one of the paths, followed through links, is that of a run's file, or in a folder of its files.

    >>> refuse_run_files(Path("answers.json"), instead="--json")
    """
    for path in paths:
        place = path.resolve()
        for run in place.parents:
            inside = place.relative_to(run).parts[0]
            if inside in _RUN_FILES and (run / "config.yml").is_file() and (run / "nerfstudio_models").is_dir():
                raise InputError(
                    f"{path} is part of the run {run}, which it would destroy; give another {instead}, with or without "
                    "--overwrite True"
                )
