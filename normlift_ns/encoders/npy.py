"""Reading arrays that others wrote, without running what may be in them."""

from __future__ import annotations

from pathlib import Path

import numpy as np


def read_npy(path: Path, what: str) -> np.ndarray:
    """The array of an NPY file, of any type but objects, mapped into memory and read-only.

    Args:
        what: what the file is, for the message.
    Raises:
        FileNotFoundError: no such file.
        ValueError: a file that is truncated, no NPY file or holds pickled objects.
    """
    try:
        return np.lib.format.open_memmap(path, mode="r")
    except FileNotFoundError:
        raise FileNotFoundError(f"{what} {path} does not exist; check the folder") from None
    except Exception as error:  # whatever a foreign header makes NumPy's parser raise
        raise ValueError(f"{what} {path} is damaged or no NPY file ({error}); write it again with numpy.save") from None
