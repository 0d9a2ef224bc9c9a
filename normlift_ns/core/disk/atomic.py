"""Atomic system calls: locks that end with their process, renames that never overwrite, and exchanges of two paths.

Some systems do not support them (Windows, some network drives). The functions then return None or False, and the caller
uses a fallback.
"""

from __future__ import annotations

import ctypes
import errno
import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_NO_REPLACE, _EXCHANGE = 1, 2
_AT_FDCWD = -100
"""Relative paths start at the working directory."""
_LOCK_TIMEOUT = 10.0
"""Seconds to wait for a lock; normlift_ns itself holds one only briefly."""
_UNSUPPORTED = {errno.ENOSYS, errno.EINVAL, errno.ENOTSUP, errno.EPERM}
"""Errors of kernels, file systems and containers that do not support renameat2."""


def hold(folder: Path) -> int | None:
    """Lock a folder until `release` or until the process ends, even if it is killed.

    Returns:
        A file descriptor for `release`; None if the system does not support locks.
    Raises:
        BlockingIOError: another process holds the lock.
        OSError: the folder does not exist.
    """
    if sys.platform == "win32":
        return None
    import fcntl  # noqa: PLC0415 (not available on Windows)

    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)  # opening a pipe would block forever
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        raise
    except OSError:  # a file system without locks
        os.close(descriptor)
        return None
    return descriptor


def release(descriptor: int | None) -> None:
    """Release a lock of `hold`."""
    if descriptor is not None:
        os.close(descriptor)


@contextmanager
def held(folder: Path) -> Iterator[None]:
    """Hold the lock of a folder, after waiting for it for at most 10 seconds.

    If the lock is still taken then, continue without it: another program may hold it for as long as it runs.
    """
    descriptor, deadline = None, time.monotonic() + _LOCK_TIMEOUT
    while time.monotonic() < deadline:
        try:
            descriptor = hold(folder)
            break
        except BlockingIOError:
            time.sleep(0.005)
    try:
        yield
    finally:
        release(descriptor)


def rename_new(source: Path, target: Path) -> bool:
    """Rename a file or a folder and return True; return False if the new name already exists.

    >>> import tempfile
    >>> folder = Path(tempfile.mkdtemp())
    >>> (folder / "a").touch()
    >>> rename_new(folder / "a", folder / "b"), rename_new(folder / "b", folder / "b")
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


def exchange(first: Path, second: Path) -> bool:
    """Exchange two files or folders, with both names existing at all times; return False if that is not supported."""
    return _rename(first, second, _EXCHANGE)


def _rename(source: Path, target: Path, flag: int) -> bool:
    """Call Linux's renameat2; return False if it is not supported."""
    if sys.platform != "linux":
        return False
    try:
        function = ctypes.CDLL(None, use_errno=True).renameat2
    except AttributeError:  # a C library without it
        return False
    function.argtypes = [ctypes.c_int, ctypes.c_char_p, ctypes.c_int, ctypes.c_char_p, ctypes.c_uint]
    if function(_AT_FDCWD, os.fsencode(source), _AT_FDCWD, os.fsencode(target), flag) == 0:
        return True
    error = ctypes.get_errno()
    if error in _UNSUPPORTED:
        return False
    raise OSError(error, os.strerror(error), str(source), None, str(target))
