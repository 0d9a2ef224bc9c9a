"""Atomic writes of files and folders, a journal for interrupted writes, and file digests."""

from __future__ import annotations

import ctypes
import errno
import hmac
import json
import os
import re
import secrets
import shutil
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import cache, partial
from hashlib import blake2b
from itertools import count
from pathlib import Path
from typing import Any

from safetensors import SafetensorError
from xxhash import xxh3_128

from normlift_ns.errors import InputError, user_state_folder
from normlift_ns.io.guard import file_kind, open_regular, read_file, refuse_inputs, refuse_other_kinds, suffix_kind

_BLOCK_SIZE = 2**20
_LEGACY_PREFIX = "blake2b:"
"""Prefix of the digests of weight files in version 0.1."""


def text_digest(text: str) -> str:
    """Return the digest of a string.

    >>> text_digest("fox")
    'xxh3_128:2acc0017ba959fe5c1cfee97854b92cf'
    """
    return f"xxh3_128:{xxh3_128(text.encode()).hexdigest()}"


def file_digest(*files: Path, compare_to: str = "") -> str:
    """Return the digest of the concatenated contents of files. It does not depend on their paths.

    One core reads and hashes several GB/s.

    Args:
        compare_to: Digest that the caller compares with the result. For a digest of version 0.1, the function uses the
            hash of that version, which is much slower.
    Raises:
        OSError, ValueError: A file does not exist, cannot be read, or is not a regular file.

    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp()) / "a.txt"
    >>> _ = path.write_text("fox")
    >>> file_digest(path) == text_digest("fox"), file_digest(path, compare_to="blake2b:0")
    (True, 'blake2b:af951fc8e5abe85ac01baf525102361b')
    """
    legacy = compare_to.startswith(_LEGACY_PREFIX)
    new_hash: Callable[[], Any] = partial(blake2b, digest_size=16) if legacy else xxh3_128
    state, block = new_hash(), bytearray(_BLOCK_SIZE)
    for file in files:
        with open_regular(file) as stream:
            while size := stream.readinto(block):
                state.update(memoryview(block)[:size])
    return f"{_LEGACY_PREFIX if legacy else 'xxh3_128:'}{state.hexdigest()}"


# Atomic system calls: locks that end with their process, renames that never overwrite, and exchanges of two paths.
#
# Windows and some network drives do not support them. The functions then return None or False, and their callers use a
# fallback.


_NO_REPLACE, _EXCHANGE = 1, 2
_AT_FDCWD = -100
"""Linux constant for renameat2: relative paths start at the working directory."""
_LOCK_TIMEOUT = 60.0
"""Maximum time in seconds that `locked` waits for a lock. normlift_ns itself holds such locks only briefly."""
_UNSUPPORTED = {errno.ENOSYS, errno.EINVAL, errno.ENOTSUP, errno.EPERM}
"""Error codes of renameat2 if the kernel, the file system or the container does not support it."""


def acquire_lock(folder: Path) -> int | None:
    """Lock a folder until the caller calls `release_lock` or the process ends.

    Returns:
        The file descriptor for `release_lock`, or None if the system or the file system does not support locks.
    Raises:
        BlockingIOError: The folder is already locked.
        OSError: The folder does not exist or cannot be opened.
    """
    if sys.platform == "win32":
        return None
    import fcntl  # noqa: PLC0415 (not available on Windows)

    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)  # without O_DIRECTORY, a pipe would block
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        raise
    except OSError:  # the file system does not support locks
        os.close(descriptor)
        return None
    return descriptor


def release_lock(descriptor: int | None) -> None:
    """Release the lock of a descriptor from `acquire_lock`; do nothing if the descriptor is None."""
    if descriptor is not None:
        os.close(descriptor)


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Hold the lock of a folder within a `with` block.

    If the folder is already locked, wait for at most 60 s, and then continue without the lock.
    """
    descriptor, deadline = None, time.monotonic() + _LOCK_TIMEOUT
    while time.monotonic() < deadline:
        try:
            descriptor = acquire_lock(folder)
            break
        except BlockingIOError:
            time.sleep(0.005)
    try:
        yield
    finally:
        release_lock(descriptor)


def rename_if_absent(source: Path, target: Path) -> bool:
    """Rename a file or a folder and return True; return False if the new name already exists.

    >>> import tempfile
    >>> folder = Path(tempfile.mkdtemp())
    >>> (folder / "a").touch()
    >>> rename_if_absent(folder / "a", folder / "b"), rename_if_absent(folder / "b", folder / "b")
    (True, False)
    """
    try:
        if not _rename(source, target, _NO_REPLACE):
            if os.path.lexists(target):
                return False
            os.rename(source, target)
    except FileExistsError:
        return False
    return True


def _rename(source: Path, target: Path, flag: int) -> bool:
    """Call Linux's renameat2; return False if it is not supported."""
    if sys.platform != "linux":
        return False
    try:
        function = ctypes.CDLL(None, use_errno=True).renameat2
    except AttributeError:  # the C library has no renameat2
        return False
    function.argtypes = [ctypes.c_int, ctypes.c_char_p, ctypes.c_int, ctypes.c_char_p, ctypes.c_uint]
    if function(_AT_FDCWD, os.fsencode(source), _AT_FDCWD, os.fsencode(target), flag) == 0:
        return True
    error = ctypes.get_errno()
    if error in _UNSUPPORTED:
        return False
    raise OSError(error, os.strerror(error), str(source), None, str(target))


# Write-ahead journal for replacing several files or a folder. After a crash, a later process completes its steps.
#
# These steps move and delete files, so `complete_journal` accepts only journals of the same user. The signature of a
# journal is made with a key in the user's state folder. A folder from somebody else cannot contain a valid signature.


JOURNAL_SUFFIX = ".journal"
_KEY_FILE, _KEY_BYTES, _MAX_JOURNAL_BYTES = "key", 32, 2**20


def write_journal(temporary: Path, steps: Mapping[str, Any]) -> Path:
    """Write a journal of the steps that move files from a temporary folder into its parent, and return its path.

    Args:
        temporary: Temporary folder with the new files, in which the journal is written.
        steps: Entries `files`, `remove` and `overwrite`, or `place`, `new` and `old`. File names have no folder part.
    """
    draft, journal = temporary / "steps.json", temporary / f"steps{JOURNAL_SUFFIX}"
    text = json.dumps(steps)
    draft.write_text(f"{_signature(temporary, text)}\n{text}", "utf8")
    _fsync(draft, os.O_RDWR)
    os.rename(draft, journal)
    return journal


def complete_journal(temporary: Path) -> bool:
    """Complete or undo the steps in the journal of a temporary folder.

    Returns:
        True if all steps are completed or undone, or no journal exists; False if the journal has no valid signature.
    """
    journal = temporary / f"steps{JOURNAL_SUFFIX}"
    if not os.path.lexists(journal):
        return True
    steps = _read(journal)
    if steps is None:
        warnings.warn(
            f"{temporary} contains new files of an interrupted command. They are not moved to {temporary.parent}, "
            "because another user or machine may have written them. Run the command again as the same user on the same "
            f"machine, or delete {temporary}.",
            stacklevel=2,
        )
        return False
    folder = temporary.parent
    if "place" in steps:
        target = folder / Path(steps["place"]).name
        for name in (steps["new"], steps["old"]):
            if not os.path.lexists(target) and (temporary / Path(name).name).exists():
                os.rename(temporary / Path(name).name, target)
        return True
    for name in (Path(name).name for name in steps["files"]):
        if (temporary / name).exists() and (steps["overwrite"] or not os.path.lexists(folder / name)):
            os.replace(temporary / name, folder / name)
    for name in steps["remove"]:
        (folder / Path(name).name).unlink(missing_ok=True)
    journal.unlink()
    return True


def _read(journal: Path) -> dict[str, Any] | None:
    """Return the steps of a journal; None if its signature is not valid."""
    if journal.is_symlink() or not journal.is_file():
        return None
    signature, _, text = read_file(journal, max_bytes=_MAX_JOURNAL_BYTES).decode("utf8", "replace").partition("\n")
    valid = hmac.compare_digest(signature.encode(), _signature(journal.parent, text).encode())
    return json.loads(text) if valid else None


def _signature(temporary: Path, text: str) -> str:
    """Sign the text of a journal together with the path of its folder, so that a moved journal is not valid."""
    message = f"{temporary.resolve()}\n{text}".encode("utf8", "surrogateescape")
    return hmac.new(_key(), message, "sha256").hexdigest()


@cache
def _key() -> bytes:
    """Return the user's key of 32 bytes, and create it if it does not exist.

    If the key cannot be stored, return a new key that only this process uses.
    """
    folder, new = user_state_folder(), secrets.token_bytes(_KEY_BYTES)
    if folder is None:
        return new
    with suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True)
        path, draft = folder / _KEY_FILE, folder / f"{_KEY_FILE}.{secrets.token_hex(8)}"
        if not path.exists():
            descriptor = os.open(draft, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
            with os.fdopen(descriptor, "wb") as file:
                file.write(new)
            rename_if_absent(draft, path)  # another process may have created the key first
            draft.unlink(missing_ok=True)
        stored = read_file(path) if path.is_file() else b""
        if len(stored) == _KEY_BYTES and (os.name == "nt" or path.stat().st_uid == os.getuid()):
            return stored
    return new


# Atomic file writes, which replace existing files only if the caller allows it.
#
# New files are written into a temporary folder next to their destination, flushed to the disk and renamed. A process
# holds the lock of its temporary folder while it writes. Later processes delete unlocked temporary folders.


_TEMPORARY_PREFIX = ".normlift-"
_TEMPORARY_NAME = re.compile(r"\.normlift-[0-9a-f]{16}")
_MAX_AGE = 86400
"""Age in seconds after which temporary folders are deleted on systems without locks."""


class NotWrittenError(OSError):
    """Failure to write a file or folder; the message gives the final path and the reason."""


@contextmanager
def atomic_files(
    *paths: Path, overwrite: bool = False, delete: Sequence[Path] = (), own: bool = False
) -> Iterator[tuple[Path, ...]]:
    """Yield a temporary path for each path; if the block succeeds, rename all files to their final paths together.

    If two processes write the same paths simultaneously, their files are never mixed. If this process dies between the
    first rename and the last, the next process that writes to the folder completes the renames.

    Args:
        paths: Final paths, all in one folder.
        overwrite: Replace existing files of the same kind.
        delete: Files to delete in the same step, if they exist.
        own: Skip the checks of inputs and kinds, for files of runs and caches that this package wrote itself.
    Raises:
        FileExistsError: A path exists, and `overwrite` is False.
        ValueError: The errors of `refuse_inputs`. With `overwrite`, also if an existing file is of a different kind. No
            file has changed.
        NotWrittenError: Writing failed, for instance because the disk is full. No file has changed unless a rename
            failed.

    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp()) / "new folder" / "a.txt"
    >>> with atomic_files(path) as (draft,):
    ...     _ = draft.write_text("text")
    >>> path.read_text()
    'text'
    """
    folder, existing = paths[0].parent, None
    if not own:
        refuse_inputs((*paths, *delete))
    with _draft_folder(*paths) as temporary:
        drafts = tuple(temporary / path.name for path in paths)
        yield drafts
        _flush(temporary)
        with locked(folder):
            if not overwrite:
                existing = next((path for path in paths if os.path.lexists(path)), None)
            elif not own:
                kinds = (*map(file_kind, drafts), *map(suffix_kind, delete))
                for path, kind in zip((*paths, *delete), kinds):
                    refuse_other_kinds(path, kind)
            if existing is None:
                existing = _rename_drafts(temporary, drafts, overwrite, delete)
        _flush_names(folder)
    if existing is not None:
        raise FileExistsError(f"{existing} exists; give another name, or set overwrite to True")


@contextmanager
def atomic_file(path: Path, *, overwrite: bool = False, own: bool = False) -> Iterator[Path]:
    """Yield a temporary path for a single file; see `atomic_files` for the arguments and errors."""
    with atomic_files(path, overwrite=overwrite, own=own) as (draft,):
        yield draft


def write_text_file(path: Path, text: str, *, overwrite: bool = False, own: bool = False) -> None:
    """Write a UTF-8 text file atomically; see `atomic_files` for the other arguments and errors."""
    with atomic_file(path, overwrite=overwrite, own=own) as draft:
        draft.write_text(text, "utf8")


@contextmanager
def draft_directory(path: Path) -> Iterator[Path]:
    """Yield an empty temporary folder, which `commit_directory` can rename to `path` or to another name next to it.

    Raises:
        NotWrittenError: Writing failed, for instance because the disk is full.
    """
    with _draft_folder(path) as temporary:
        draft = temporary / path.name
        draft.mkdir()
        yield draft


def commit_directory(draft: Path, path: Path, *, replaced: Callable[[Path], Collection[str]] | None = None) -> bool:
    """Rename a folder from `draft_directory` to its final path; return False if the path exists and `replaced` is None.

    The system exchanges an existing folder with the new one, so the path exists at every instant. If the system cannot
    exchange folders, two renames replace the folder. A journal records them, so that after a crash, the next command
    that opens or writes the run completes them.

    Args:
        replaced: Function that returns the relative paths of the files in an existing folder that the new folder
            replaces. All other files are kept.
    Raises:
        ValueError: Both folders have a file at the same path, and `replaced` does not return this path. The existing
            folder is unchanged.
    """
    _flush(draft)
    with locked(path.parent):
        if not rename_if_absent(draft, path):
            if replaced is None:
                return False
            old, names = draft, replaced(path)
            _link_others(path, draft, names)
            if not _rename(draft, path, _EXCHANGE):  # the system does not support exchanges
                temporary = draft.parent
                old = temporary / f"{path.name}.old"
                write_journal(temporary, {"place": path.name, "new": draft.name, "old": old.name})
                _flush_names(temporary)
                try:
                    os.rename(path, old)
                    os.rename(draft, path)
                finally:
                    complete_journal(temporary)
            _link_others(old, path, names, keep_new=True)  # files written after the first call
    _flush_names(path.parent)
    return True


def _link_others(old: Path, new: Path, replaced: Collection[str], *, keep_new: bool = False) -> None:
    """Hard-link the files that are not replaced from an old folder into a new one; copy a file if linking it fails."""
    for parent, folders, files in os.walk(old):
        source, target = Path(parent), new / Path(parent).relative_to(old)
        if not target.is_dir():
            target.mkdir()
            shutil.copystat(source, target)
        for name in (*files, *(name for name in folders if (source / name).is_symlink())):
            file = target / name
            if file.relative_to(new).as_posix() in replaced or (keep_new and os.path.lexists(file)):
                continue
            if os.path.lexists(file):
                raise InputError(
                    f"the new lift would replace {source / name}, which the old lift did not write; move it elsewhere"
                )
            try:
                os.link(source / name, file, follow_symlinks=False)
            except OSError:
                shutil.copy2(source / name, file, follow_symlinks=False)
        _flush_names(target)


def _rename_drafts(temporary: Path, drafts: Sequence[Path], overwrite: bool, remove: Sequence[Path]) -> Path | None:
    """Rename drafts to their final paths, and delete the files in `remove`.

    Return a path that another program has created in the meantime, or None.
    """
    journal, folder = None, temporary.parent
    if len(drafts) + len(remove) > 1:
        complete_interrupted_writes(folder)  # if completed later, an older export would overwrite this one
        names = {"files": [draft.name for draft in drafts], "remove": [path.name for path in remove]}
        journal = write_journal(temporary, names | {"overwrite": overwrite})
        _flush_names(temporary)
    for draft in drafts:
        if overwrite:
            os.replace(draft, folder / draft.name)
        elif not rename_if_absent(draft, folder / draft.name):  # created by a program without our lock
            if journal is not None:
                journal.unlink()
            return folder / draft.name
    for path in remove:
        path.unlink(missing_ok=True)
    if journal is not None:  # completing this journal later would delete newer files of other processes
        journal.unlink()
    return None


def complete_interrupted_writes(folder: Path) -> None:
    """Complete the interrupted replacements in a folder, and delete the temporary folders of ended processes."""
    for temporary in folder.glob(f"{_TEMPORARY_PREFIX}*"):
        if _TEMPORARY_NAME.fullmatch(temporary.name) is None or temporary.is_symlink():
            continue
        with suppress(OSError, ValueError, LookupError, TypeError, RecursionError):  # locked, or an invalid journal
            descriptor = acquire_lock(temporary)
            try:
                removable = complete_journal(temporary)
                if removable and (descriptor is not None or time.time() - temporary.stat().st_mtime > _MAX_AGE):
                    shutil.rmtree(temporary, ignore_errors=True)
            finally:
                release_lock(descriptor)


@contextmanager
def deferred_signals() -> Iterator[None]:
    """Delay Ctrl-C and SIGTERM until the end of the `with` block, which must be short.

    Outside the main thread, which handles all signals, this has no effect.
    """
    if threading.current_thread() is not threading.main_thread():  # only the main thread handles signals
        yield
        return
    arrived, before = list[int](), dict[int, Any]()
    try:
        for number in (signal.SIGINT, signal.SIGTERM):
            before[number] = signal.signal(number, lambda number, _: arrived.append(number))
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler or signal.SIG_DFL)
        for number in arrived:
            signal.raise_signal(number)


@contextmanager
def _draft_folder(*paths: Path) -> Iterator[Path]:
    """Yield a temporary folder next to the paths. Error messages give the paths, not those in the temporary folder."""
    folder, temporary = paths[0].parent, None
    new_folders = [place for place in (folder, *folder.parents) if not place.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        complete_interrupted_writes(folder)
        descriptor = None
        try:
            with deferred_signals():
                temporary, descriptor = _temporary_folder(folder)
            yield temporary
        finally:
            try:
                _discard(temporary)
            finally:
                _discard(temporary)  # again, because a signal may have interrupted the first call
                release_lock(descriptor)
    except (OSError, RuntimeError, SafetensorError) as error:  # full disk: torch and safetensors raise the latter two
        reason = str(error)
        if temporary is not None:
            reason = reason.replace(f"{temporary}{os.sep}", f"{folder}{os.sep}")
        if not isinstance(error, NotWrittenError):
            names = ", ".join(map(str, paths))
            blocked = isinstance(error, IsADirectoryError | NotADirectoryError | FileExistsError)
            remedy = "delete the file or folder in the way" if blocked else "free disk space or choose another folder"
            reason = f"{names} cannot be written ({reason}); {remedy}, then try again"
        raise NotWrittenError(reason) from error
    finally:
        for place in new_folders:
            with suppress(OSError):  # the folder is not empty
                place.rmdir()


def _discard(temporary: Path | None) -> None:
    if temporary is not None and temporary.exists():
        with deferred_signals():
            complete_journal(temporary)
            shutil.rmtree(temporary, ignore_errors=True)


def _temporary_folder(folder: Path) -> tuple[Path, int | None]:
    """Create and lock a temporary folder with default permissions; return its path and the descriptor of its lock."""
    while True:
        temporary = folder / f"{_TEMPORARY_PREFIX}{secrets.token_hex(8)}"
        temporary.mkdir()
        with suppress(BlockingIOError, FileNotFoundError):  # another process is deleting this folder
            descriptor = acquire_lock(temporary)
            if temporary.exists():
                return temporary, descriptor
            release_lock(descriptor)


def _flush(folder: Path) -> None:
    """Flush a temporary folder and all its files to the disk, and give the files default permissions."""
    mode = folder.stat().st_mode & 0o666  # safetensors writes files that only their owner can read
    for parent, _, files in os.walk(folder):
        for name in files:
            path = os.path.join(parent, name)
            with suppress(OSError):  # the file system has no permissions
                os.chmod(path, mode)
            _fsync(path, os.O_RDWR)
        _flush_names(Path(parent))


def _flush_names(folder: Path) -> None:
    """Flush the entries of a folder to the disk, if the system supports it."""
    with suppress(OSError):
        _fsync(folder, os.O_RDONLY)


def _fsync(path: str | Path, flags: int) -> None:
    """Flush a file or a folder to the disk. `flags` are those of `os.open`."""
    descriptor = os.open(path, flags)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def refuse_existing(*paths: Path, overwrite: bool, flags: str) -> None:
    """Raise before a command starts its work if it would replace a file that it must not replace.

    Args:
        flags: Flags for choosing another path, quoted in the error message.
    Raises:
        FileExistsError: One of the paths exists, and `overwrite` is False.
        ValueError: The errors of `refuse_inputs`, or the content of an existing file does not match its suffix.
    """
    refuse_inputs(paths, instead=flags)
    for folder in {path.parent for path in paths}:
        complete_interrupted_writes(folder)
    for path in paths:
        if not overwrite and os.path.lexists(path):
            raise FileExistsError(f"{path} exists; give another {flags}, or --overwrite True.")
        refuse_other_kinds(path, suffix_kind(path), flags)


def safe_file_name(text: str) -> str:
    """Return the first 40 characters of a string for use in a file name.

    Each character except letters and digits becomes `_`.

    >>> safe_file_name("../tea pot")
    '___tea_pot'
    """
    return "".join(c if c.isalnum() else "_" for c in text[:40])


def numbered_paths(path: Path) -> Iterator[Path]:
    """Yield the path, then the path with _2, _3 and so on before its suffix.

    >>> names = numbered_paths(Path("red.ply"))
    >>> next(names).name, next(names).name
    ('red.ply', 'red_2.ply')
    """
    yield path
    yield from (path.with_name(f"{path.stem}_{number}{path.suffix}") for number in count(2))
