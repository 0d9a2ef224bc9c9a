"""Files of arrays: safetensors files with a digest of their whole content, and NPY files of other programs.

Loading checks the digest before it returns any content. Saving or loading NumPy arrays does not import torch. The
digest is a 128-bit XXH3 hash. It detects damaged and misplaced files, but does not protect against forgery. One core
of an AMD EPYC hashes 31 GB/s with XXH3 and 0.9 GB/s with BLAKE2b. Hashing a field of 44 MB takes 1.5 ms instead of
50 ms.
"""

from __future__ import annotations

import io
import json
import math
import os
import re
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
from safetensors import SafetensorError, safe_open
from xxhash import xxh3_128

from normlift_ns.errors import InputError
from normlift_ns.io.atomic import atomic_file
from normlift_ns.io.guard import check_regular, open_regular
from normlift_ns.io.memory import check_free_memory

FLOAT32_MAX = float(np.finfo(np.float32).max)
"""Largest float32 number, the default upper bound of `check_array`."""
_BLOCK = 2**20
"""Number of float16 numbers that `_extremes` compares at a time."""
_SMALL_FILE = 2**20
"""Size in bytes up to which a file is read without checking the free memory, because the check would take longer."""
DIGEST_KEY = "digest"
"""Metadata key of the digest."""
_Array = Any
"""A NumPy array or a tensor."""


class ArrayFile(NamedTuple):
    """Content of a file that `save_arrays` wrote."""

    arrays: dict[str, _Array]
    metadata: dict[str, str]
    """Metadata, without the digest."""
    digest: str | None
    """Digest of the content; None for files of version 0.1."""


def array_digest(arrays: Mapping[str, _Array], facts: Mapping[str, str], key: str = "") -> str:
    """Return a digest of metadata, a key, and the names, types, shapes and values of arrays or tensors.

    >>> import torch
    >>> table = {"a": np.eye(2)}
    >>> array_digest(table, {}) == array_digest({"a": torch.eye(2, dtype=torch.float64)}, {})
    True
    >>> array_digest(table, {}) == array_digest(table, {}, "key") or array_digest(table, {}) == array_digest({}, {})
    False
    """
    state = xxh3_128(json.dumps([key, sorted(facts.items())]).encode())
    for name, array in sorted(arrays.items()):
        dtype = f"torch.{array.dtype}" if isinstance(array, np.ndarray) else str(array.dtype)
        state.update(json.dumps([name, dtype, list(array.shape)]).encode())
        state.update(_bytes(array))
    return f"xxh3_128:{state.hexdigest()}"


def _bytes(array: _Array) -> memoryview | bytes:
    if isinstance(array, np.ndarray):
        return np.ascontiguousarray(array).reshape(-1).view(np.uint8).data
    import torch  # noqa: PLC0415 (queries without torch import this module)

    flat = array.detach().cpu().reshape(-1).contiguous()
    # a tensor of one element may have any stride
    return flat.as_strided(flat.shape, (1,)).view(torch.uint8).numpy().data if array.numel() > 0 else b""


def save_arrays(
    path: Path,
    arrays: Mapping[str, _Array],
    facts: Mapping[str, str] | None = None,
    *,
    key: str = "",
    overwrite: bool = False,
) -> str:
    """Write a safetensors file, and return its digest, which is also stored in its metadata.

    Args:
        arrays: NumPy arrays only, or tensors only.
        facts: Metadata in addition to the digest.
        key: Key of the file in a cache. Loading the file with a different key raises an error.
        overwrite: Replace an existing file.
    Raises:
        FileExistsError, OSError: The errors of `atomic_files`.
        ValueError: The metadata cannot be encoded as UTF-8.
    """
    if invalid := next((text for text in (facts or {}).values() if re.search("[\ud800-\udfff]", text)), ""):
        raise InputError(f"the metadata of {path} contains {invalid!a}, expected text that UTF-8 can encode; change it")
    if all(isinstance(array, np.ndarray) for array in arrays.values()):
        from safetensors.numpy import save_file  # noqa: PLC0415 (only one of the two is needed)

        content: dict[str, Any] = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    else:
        from safetensors.torch import save_file  # noqa: PLC0415 (as in `_bytes`)

        content = {name: tensor.detach().contiguous().cpu() for name, tensor in arrays.items()}
    metadata = dict(facts or {})
    digest = array_digest(content, metadata, key)
    with atomic_file(path, overwrite=overwrite, own=True) as draft:
        save_file(content, draft, metadata={**metadata, DIGEST_KEY: digest})
        sort_metadata(draft)
    return digest


def sort_metadata(path: Path) -> None:
    """Sort the metadata in the header of a safetensors file, so that equal contents give bit-for-bit equal files.

    The safetensors library itself writes metadata in arbitrary order.
    """
    with path.open("r+b") as file:
        size = int.from_bytes(file.read(8), "little")
        header = json.loads(file.read(size))
        header["__metadata__"] = dict(sorted(header["__metadata__"].items()))
        ordered = json.dumps(header, ensure_ascii=False, separators=(",", ":")).encode().ljust(size)
        if len(ordered) == size:  # otherwise the installed safetensors formats headers differently
            file.seek(8)
            file.write(ordered)


def read_metadata(path: Path) -> dict[str, str]:
    """Read the metadata in the header of a safetensors file. The digest of the file is not checked.

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: The file is damaged or not a safetensors file.
    """
    try:
        check_regular(path)
        with safe_open(path, framework="np") as file:
            return dict(file.metadata() or {})
    except FileNotFoundError:
        raise
    except (SafetensorError, OSError, ValueError) as error:
        raise InputError(f"{path} is damaged, cannot be read, or is not a safetensors file ({error})") from error


def load_arrays(
    path: Path,
    *,
    key: str = "",
    legacy_keys: Collection[str] | None = None,
    remedy: str = "write it again",
    framework: str = "np",
) -> ArrayFile:
    """Read a file that `save_arrays` wrote, and check its digest.

    Args:
        key: Key that the file was saved with.
        legacy_keys: Metadata keys of this kind of file in version 0.1, which wrote no digests. A file with exactly
            these keys is read without a check. If None, every file must have a digest.
        remedy: Advice in the error message if the file is missing or damaged.
        framework: "np" for NumPy arrays, "pt" for tensors.
    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: The digest does not match, or the file is not a safetensors file.
        MemoryError: The file does not fit into memory.
    """
    try:
        check_regular(path)
        size = path.stat().st_size
        with safe_open(path, framework=framework) as file:
            if size > _SMALL_FILE:  # safetensors aborts if memory runs out
                check_free_memory(size, f"Reading {path}", {"ulimit -v": 2 * size})
            facts = dict(file.metadata() or {})
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (safe_open is not a mapping)
        expected = facts.pop(DIGEST_KEY, None)
        has_digest = expected is not None or legacy_keys is None or set(facts) != set(legacy_keys)
        actual = array_digest(arrays, facts, key) if has_digest else None
    except FileNotFoundError:
        raise FileNotFoundError(f"{path} is missing; {remedy}") from None
    except (SafetensorError, OSError, KeyError, TypeError, AttributeError, RuntimeError, ValueError) as error:
        raise InputError(
            f"{path} is damaged, cannot be read, or is not a safetensors file ({error}); {remedy}"
        ) from error
    if actual != expected:
        problem = f"expected {expected}" if expected else "but its metadata has none"
        raise InputError(f"{path} is damaged: its content has digest {actual}, {problem}; {remedy}")
    return ArrayFile(arrays, facts, actual)


def check_array(
    name: str, array: np.ndarray, dtype: str, shape: Sequence[int], low: float | int, high: float | int = FLOAT32_MAX
) -> None:
    """Raise if the type, shape or value range of an array is not as expected.

    Args:
        name: Name of the array, for the error message.
        low, high: Bounds of its values, both inclusive. NaN is always out of range.
    Raises:
        ValueError: The array is not as expected. The message gives the actual and the expected properties.

    >>> check_array("means", np.zeros((2, 3), np.float32), "float32", (2, 3), 0)
    """
    if array.dtype != dtype or array.shape != tuple(shape):
        raise InputError(f"{name} is {array.dtype} {array.shape}, expected {dtype} {tuple(shape)}")
    least, most = _extremes(array) if array.size > 0 else (low, low)
    if not low <= least <= most <= high:
        raise InputError(f"{name} has values in {least}..{most}, expected {low:.9g}..{high:.9g}")


def _extremes(array: np.ndarray) -> tuple[float, float]:
    """Return the smallest and the largest value of an array; one or both are NaN if it contains NaN.

    NumPy compares float16 numbers one at a time. Their bits, read as int16, have the same order after
    `_flip_negative`, and NumPy compares int16 numbers twenty times as fast.

    >>> _extremes(np.array([[0.5, -2], [-0.0, 3]], np.float16))
    (-2.0, 3.0)
    """
    if array.dtype != np.float16:
        return array.min().item(), array.max().item()
    bits = array.reshape(-1).view(np.int16)
    blocks = (bits[first : first + _BLOCK] for first in range(0, len(bits), _BLOCK))
    ends = np.array([(order.min(), order.max()) for order in map(_flip_negative, blocks)])
    least, most = _flip_negative(np.array([ends.min(), ends.max()])).view(np.float16).tolist()
    return least, most


def _flip_negative(bits: np.ndarray) -> np.ndarray:
    """Invert all bits of negative int16 numbers except the sign. The function is its own inverse."""
    return bits ^ ((bits >> 15) & 0x7FFF)


# NPY files: their size is compared with their header before NumPy allocates memory, and pickles are never loaded.


_HEADER_READERS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
    (3, 0): np.lib.format.read_array_header_2_0,  # differs only in the names of records, which are not read
}
_NUMERIC_KINDS = "biuf"
"""NumPy's codes for booleans, signed and unsigned integers, and floats."""
_MAX_NUMBERS = 2**60
"""Upper limit for the product of the dimensions of an array, with dimensions of 0 counted as 1."""


def read_npy(path: Path, description: str) -> np.ndarray:
    """Return the numeric array in an NPY file, memory-mapped and read-only.

    Args:
        description: Kind of file, for error messages.
    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: The file is not an NPY file, or does not have the size that its header declares. Also if it contains
            anything except booleans and real numbers of at most 64 bits.
    """
    if not os.path.isfile(path):
        if os.path.lexists(path):
            raise InputError(f"{description} {path} is not a file; expected an NPY file as written by numpy.save")
        raise FileNotFoundError(f"{description} {path} does not exist; check the path")
    try:
        with open_regular(path) as file:
            _check_npy(file)
        return np.load(path, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError) as error:
        raise InputError(
            f"{description} {path} cannot be read as an NPY file of numbers ({error}); write it again with numpy.save"
        ) from None


def read_npy_bytes(data: bytes) -> np.ndarray:
    """Return the numeric array in the bytes of an NPY file, in native byte order.

    Raises:
        ValueError: The bytes are not a valid NPY file; see `read_npy`.
    """
    _check_npy(io.BytesIO(data))
    values = np.load(io.BytesIO(data), allow_pickle=False)
    return values.astype(values.dtype.newbyteorder("="))


def _check_npy(file: IO[bytes]) -> None:
    """Raise InputError unless an NPY file contains only numbers and has the size that its header declares."""
    try:
        shape, _, dtype = _HEADER_READERS[np.lib.format.read_magic(file)](file)
    except Exception as error:  # a header is a Python literal, and its parser raises any kind of exception
        raise InputError(f"its NPY header cannot be read: {type(error).__name__}") from None
    if dtype.kind not in _NUMERIC_KINDS or dtype.itemsize > 8:
        kind = "objects" if dtype.hasobject else str(dtype)[:80]
        raise InputError(f"it contains {kind}, expected booleans, integers or floats of at most 64 bits")
    if len(shape) > 8 or min(shape, default=0) < 0 or math.prod(length or 1 for length in shape) > _MAX_NUMBERS:
        raise InputError("its header declares more than 8 dimensions, a negative dimension, or too many numbers")
    start, expected = file.tell(), math.prod(shape) * dtype.itemsize
    found = file.seek(0, os.SEEK_END) - start
    if expected != found:
        described = f"an array of shape {str(shape)[:80]} and type {dtype}"
        raise InputError(f"{described} needs {expected:,} bytes, but {found:,} bytes follow the header of the file")
