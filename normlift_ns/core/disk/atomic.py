"""What the system does in one step: locks that end with their process, renames that replace nothing, exchanges.

Where a system has none of it (Windows, some network drives), the functions say so and the caller makes do.
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
_HERE = -100
"""AT_FDCWD: relative paths start at the working directory."""
_PATIENCE = 10.0
"""Seconds; no process of ours needs more than a moment."""
_UNKNOWN = {errno.ENOSYS, errno.EINVAL, errno.ENOTSUP, errno.EPERM}
"""What kernels, file systems and containers answer that know no such rename."""


def hold(folder: Path) -> int | None:
    """Locks a folder until `release`, or until the process ends, however it does; None where there are no locks.

    Raises:
        BlockingIOError: another process holds it.
        OSError: no such folder.
    """
    if sys.platform == "win32":
        return None
    import fcntl  # noqa: PLC0415 (Windows has none)

    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)  # a pipe would make it wait for ever
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
    """Gives back what `hold` returned."""
    if descriptor is not None:
        os.close(descriptor)


@contextmanager
def held(folder: Path) -> Iterator[None]:
    """Waits for the lock of a folder, but not for ever: another program may have locked it for all of its work."""
    descriptor, end = None, time.monotonic() + _PATIENCE
    while time.monotonic() < end:
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
    """Renames a file or a folder, unless something of the new name is there: False then.

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
    """Exchanges two files or folders, so that both names exist at all times; False where the system cannot."""
    return _rename(first, second, _EXCHANGE)


def _rename(source: Path, target: Path, flag: int) -> bool:
    """Linux's renameat2; False where there is none."""
    if sys.platform != "linux":
        return False
    try:
        function = ctypes.CDLL(None, use_errno=True).renameat2
    except AttributeError:  # a C library without it
        return False
    function.argtypes = [ctypes.c_int, ctypes.c_char_p, ctypes.c_int, ctypes.c_char_p, ctypes.c_uint]
    if function(_HERE, os.fsencode(source), _HERE, os.fsencode(target), flag) == 0:
        return True
    error = ctypes.get_errno()
    if error in _UNKNOWN:
        return False
    raise OSError(error, os.strerror(error), str(source), None, str(target))
