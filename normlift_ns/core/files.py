"""Atomic file writes, which replace existing files only if asked to.

New files are written into a temporary folder next to their destination, flushed to the disk and renamed. A process
holds the lock of its temporary folder for as long as it runs; later processes remove folders that are not locked.
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

_TEMPORARY_PREFIX = ".normlift-"
_TEMPORARY_NAME = re.compile(r"\.normlift-[0-9a-f]{16}")
_RUN_FILES = {"config.yml", "dataparser_transforms.json", "splat.json", "transforms.json"}
_RUN_FILES |= {"nerfstudio_models", "normlift"}
_MAX_AGE = 86400
"""Seconds after which a temporary folder counts as left over on systems without locks."""


class NotWrittenError(OSError):
    """Failure to write a file or folder; the message has its final path and the reason."""


@contextmanager
def new_files(*paths: Path, overwrite: bool = False, remove: Sequence[Path] = ()) -> Iterator[tuple[Path, ...]]:
    """Yield a temporary path for each path; when the block ends, rename all of them to their final paths together.

    If two processes write the same paths simultaneously, their files are never mixed. If this process dies between the
    first rename and the last, the next process that writes to the folder completes the renames.

    Args:
        paths: the final paths, all in one folder.
        overwrite: replace existing files.
        remove: existing files to delete in the same step.
    Raises:
        FileExistsError: a path exists, and `overwrite` is False.
        NotWrittenError: writing failed, for instance because the disk is full; nothing has changed then.

    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp()) / "new folder" / "a.txt"
    >>> with new_files(path) as (draft,):
    ...     _ = draft.write_text("text")
    >>> path.read_text()
    'text'
    """
    folder, existing = paths[0].parent, None
    with _draft_folder(*paths) as temporary:
        drafts = tuple(temporary / path.name for path in paths)
        yield drafts
        _flush(temporary)
        with held(folder):
            if not overwrite:
                existing = next((path for path in paths if os.path.lexists(path)), None)
            if existing is None:
                existing = _rename_drafts(temporary, drafts, overwrite, remove)
        _flush_names(folder)
    if existing is not None:
        raise FileExistsError(f"{existing} exists; give another name, or allow overwriting it")


@contextmanager
def new_file(path: Path, *, overwrite: bool = False) -> Iterator[Path]:
    """Yield a temporary path for a single file; see `new_files`."""
    with new_files(path, overwrite=overwrite) as (draft,):
        yield draft


def write_text(path: Path, text: str, *, overwrite: bool = False) -> None:
    """Write a UTF-8 text file atomically; raises the errors of `new_files`."""
    with new_file(path, overwrite=overwrite) as draft:
        draft.write_text(text, "utf8")


@contextmanager
def draft_directory(path: Path) -> Iterator[Path]:
    """Yield an empty temporary folder, which `publish` can rename to `path` or to another name next to it.

    Raises:
        NotWrittenError: writing failed, for instance because the disk is full.
    """
    with _draft_folder(path) as temporary:
        draft = temporary / path.name
        draft.mkdir()
        yield draft


def publish(draft: Path, path: Path, *, overwrite: bool = False) -> bool:
    """Rename a folder of `draft_directory` to its final path; return False if that exists and `overwrite` is False.

    A replaced folder exists at every instant, old or new, because the two are exchanged. If the system cannot exchange
    folders, a journal records the steps, and the next command that opens or writes the run completes them.
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


def _rename_drafts(temporary: Path, drafts: Sequence[Path], overwrite: bool, remove: Sequence[Path]) -> Path | None:
    """Rename drafts to their final paths; return a path that another program has created meanwhile, if any."""
    journal, folder = None, temporary.parent
    if len(drafts) + len(remove) > 1:
        clean(folder)  # complete an older interrupted export now: completing it later would overwrite this one
        names = {"files": [draft.name for draft in drafts], "remove": [path.name for path in remove]}
        journal = write_journal(temporary, names | {"overwrite": overwrite})
        _flush_names(temporary)
    for draft in drafts:
        if overwrite:
            os.replace(draft, folder / draft.name)
        elif not rename_new(draft, folder / draft.name):  # created just now by a program that ignores our lock
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
    """Complete the interrupted replacements in a folder, and remove temporary folders that were left behind.

    Temporary folders of running processes are left unchanged.
    """
    for temporary in folder.glob(f"{_TEMPORARY_PREFIX}*"):
        if _TEMPORARY_NAME.fullmatch(temporary.name) is None or temporary.is_symlink():
            continue
        with suppress(OSError, ValueError, LookupError, TypeError, RecursionError):  # locked, or an invalid journal
            descriptor = hold(temporary)
            try:
                removable = complete(temporary)
                if removable and (descriptor is not None or time.time() - temporary.stat().st_mtime > _MAX_AGE):
                    shutil.rmtree(temporary, ignore_errors=True)
            finally:
                release(descriptor)


@contextmanager
def _draft_folder(*paths: Path) -> Iterator[Path]:
    """Yield a temporary folder next to the paths; error messages name these paths, not the temporary ones."""
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
    except (
        OSError,
        RuntimeError,
        SafetensorError,
    ) as error:  # torch and safetensors raise the latter if a disk is full
        reason = str(error)
        if temporary is not None:
            reason = reason.replace(f"{temporary}{os.sep}", f"{folder}{os.sep}")
        if not isinstance(error, NotWrittenError):
            names = ", ".join(map(str, paths))
            blocked = isinstance(error, IsADirectoryError | NotADirectoryError | FileExistsError)
            remedy = "delete what blocks this path" if blocked else "free disk space or choose another folder"
            reason = f"{names} cannot be written ({reason}); {remedy}, then run again"
        raise NotWrittenError(reason) from error


def _temporary_folder(folder: Path) -> tuple[Path, int | None]:
    """Create and lock a temporary folder. Unlike a folder of mkdtemp, it has the default permissions of new folders."""
    while True:
        temporary = folder / f"{_TEMPORARY_PREFIX}{secrets.token_hex(8)}"
        temporary.mkdir()
        with suppress(BlockingIOError, FileNotFoundError):  # another process is in `clean`
            descriptor = hold(temporary)
            if temporary.exists():
                return temporary, descriptor
            release(descriptor)


def _flush(folder: Path) -> None:
    """Flush a temporary folder with all its files to the disk, and give the files default permissions."""
    mode = folder.stat().st_mode & 0o666  # safetensors writes files that only their owner can read
    for parent, _, files in os.walk(folder):
        for name in files:
            path = os.path.join(parent, name)
            with suppress(OSError):  # a file system without permissions
                os.chmod(path, mode)
            descriptor = os.open(path, os.O_RDWR)
            try:
                os.fsync(descriptor)
            finally:
                os.close(descriptor)
        _flush_names(Path(parent))


def _flush_names(folder: Path) -> None:
    """Flush the entries of a folder to the disk, if the system supports it."""
    with suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def refuse_existing(*paths: Path, overwrite: bool, instead: str) -> None:
    """Raise, before anything is computed, if a command would overwrite an existing file without being asked to.

    Args:
        instead: flags with which the user can choose another path, for the error message.
    Raises:
        FileExistsError: one of the paths exists and `overwrite` is False.
        ValueError: as in `refuse_run_files`.
    """
    refuse_run_files(*paths, instead=instead)
    for folder in {path.parent for path in paths}:
        clean(folder)
    for path in paths:
        if not overwrite and os.path.lexists(path):
            raise FileExistsError(f"{path} exists; give another {instead}, or --overwrite True.")


def file_name(text: str) -> str:
    """Return a string as part of a file name: at most 40 characters, with `_` for all but letters and digits.

    >>> file_name("../tea pot")
    '___tea_pot'
    """
    return "".join(c if c.isalnum() else "_" for c in text[:40])


def numbered(path: Path) -> Iterator[Path]:
    """Yield the path, then path_2, path_3, …

    >>> names = numbered(Path("red.ply"))
    >>> next(names).name, next(names).name
    ('red.ply', 'red_2.ply')
    """
    yield path
    yield from (path.with_name(f"{path.stem}_{number}{path.suffix}") for number in count(2))


def refuse_run_files(*paths: Path, instead: str) -> None:
    """Raise, before anything is computed, if an output would replace a part of a run, even with --overwrite.

    A run is a folder that has config.yml and nerfstudio_models/. Figures, tables and exports next to these are allowed.

    Args:
        instead: flags with which the user can choose another path, for the error message.
    Raises:
        ValueError: a path, with links resolved, is a file of a run or inside one of its folders.

    >>> refuse_run_files(Path("answers.json"), instead="--json")
    """
    for path in paths:
        resolved = path.resolve()
        for run in resolved.parents:
            entry = resolved.relative_to(run).parts[0]
            if entry in _RUN_FILES and (run / "config.yml").is_file() and (run / "nerfstudio_models").is_dir():
                raise InputError(
                    f"{path} is part of the run {run}, and replacing it would destroy the run; give another {instead} "
                    "(--overwrite True does not allow this)"
                )
