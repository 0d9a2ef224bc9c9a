"""Files of arrays: safetensors with a digest of their whole content, and NPY files of other programs.

The digest is checked before any content is used. NumPy arrays need no torch. The digest is the 128-bit XXH3: it detects
damaged and misplaced files, but it does not protect against forgery. One core of an AMD EPYC hashes 31 GB/s with XXH3
and 0.9 GB/s with BLAKE2b. For a field of 44 MB, this is 1.5 ms instead of 50 ms.
"""

from __future__ import annotations

import io
import json
import math
import os
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, NamedTuple

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file
from xxhash import xxh3_128

from normlift_ns.errors import InputError
from normlift_ns.io.atomic import atomic_file

if TYPE_CHECKING:
    import torch
    from torch import Tensor

FLOAT32_MAX = float(np.finfo(np.float32).max)
"""Largest number allowed in a file."""
DIGEST_KEY = "digest"
"""Metadata key of the digest."""
ArrayParts = Iterable[tuple[str, str, Sequence[int], Any]]
"""Name, type in torch's notation, shape and bytes of each array."""


class ArrayFile(NamedTuple):
    """Content of a file."""

    arrays: dict[str, np.ndarray]
    metadata: dict[str, str]
    """Metadata, without the digest."""
    digest: str | None
    """None for files of version 0.1."""


def content_digest(parts: ArrayParts, metadata: Mapping[str, str], key: str) -> str:
    """Return the digest of a key, metadata, and the names, types, shapes and values of arrays.

    Args:
        parts: the arrays, sorted by name.
        metadata: metadata.
        key: cache key, or an empty string.
    """
    state = xxh3_128(json.dumps([key, sorted(metadata.items())]).encode())
    for name, dtype, shape, content in parts:
        state.update(json.dumps([name, dtype, list(shape)]).encode())
        state.update(content)
    return f"xxh3_128:{state.hexdigest()}"


def array_digest(arrays: Mapping[str, np.ndarray], facts: Mapping[str, str], key: str = "") -> str:
    """Return the digest of arrays and metadata, which equals `tensors.tensor_digest` of the same content.

    >>> array_digest({"a": np.eye(2)}, {}) == array_digest({"a": np.eye(2, dtype=np.float32)}, {})
    False
    """
    parts = (
        (name, f"torch.{array.dtype}", array.shape, np.ascontiguousarray(array).reshape(-1).view(np.uint8).data)
        for name, array in sorted(arrays.items())
    )
    return content_digest(parts, facts, key)


def save_arrays(
    path: Path,
    arrays: Mapping[str, np.ndarray],
    facts: Mapping[str, str] | None = None,
    *,
    key: str = "",
    overwrite: bool = False,
) -> str:
    """Write a safetensors file and return its digest; see `save_tensors`."""
    metadata = dict(facts or {})
    content = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    digest = array_digest(content, metadata, key)
    with atomic_file(path, overwrite=overwrite) as draft:
        save_file(content, draft, metadata={**metadata, DIGEST_KEY: digest})
        sort_metadata(draft)
    return digest


def sort_metadata(path: Path) -> None:
    """Sort the metadata in a file's header, so that equal content gives bit-for-bit equal files.

    safetensors itself writes metadata in arbitrary order.
    """
    with path.open("r+b") as file:
        size = int.from_bytes(file.read(8), "little")
        header = json.loads(file.read(size))
        header["__metadata__"] = dict(sorted(header["__metadata__"].items()))
        ordered = json.dumps(header, ensure_ascii=False, separators=(",", ":")).encode().ljust(size)
        if len(ordered) == size:  # otherwise this release of safetensors formats its header differently
            file.seek(8)
            file.write(ordered)


def load_arrays(
    path: Path, *, key: str = "", legacy_keys: Collection[str] | None = None, remedy: str = "write it again"
) -> ArrayFile:
    """Read a file and check its digest; see `tensors.load_tensors`."""
    return ArrayFile(*read_safetensors(path, "np", array_digest, key, legacy_keys, remedy))


def read_metadata(path: Path) -> dict[str, str]:
    """Read the metadata in a file's header without checking the digest, which covers the whole file.

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: the file is damaged or not a safetensors file.
    """
    try:
        with safe_open(path, framework="np") as file:
            return dict(file.metadata() or {})
    except FileNotFoundError:
        raise
    except (SafetensorError, OSError, ValueError) as error:
        raise InputError(f"{path} is damaged or not a safetensors file ({error})") from error


def read_safetensors(
    path: Path,
    framework: str,
    digest: Callable[[Any, dict[str, str], str], str],
    key: str,
    legacy_keys: Collection[str] | None,
    remedy: str,
) -> tuple[dict[str, Any], dict[str, str], str | None]:
    """Read a file, check its digest, and return its arrays, metadata and digest.

    Args:
        framework: "np" or "pt", the type of the returned arrays.
        digest: computes the digest of arrays, metadata and key.
        key, legacy_keys, remedy: as in `tensors.load_tensors`.
    Raises:
        FileNotFoundError, ValueError: as in `tensors.load_tensors`.
    """
    if path.exists() and not path.is_file():  # reading a pipe would never end
        raise InputError(f"{path} is not a regular file; {remedy}")
    try:
        with safe_open(path, framework=framework) as file:
            facts = dict(file.metadata() or {})
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (safe_open is not a mapping)
        expected = facts.pop(DIGEST_KEY, None)
        has_digest = expected is not None or legacy_keys is None or set(facts) != set(legacy_keys)
        actual = digest(arrays, facts, key) if has_digest else None
    except FileNotFoundError:
        raise FileNotFoundError(f"{path} is missing; {remedy}") from None
    except (SafetensorError, OSError, KeyError, TypeError, AttributeError, RuntimeError, ValueError) as error:
        raise InputError(f"{path} is damaged or not a safetensors file ({error}); {remedy}") from error
    if actual != expected:
        problem = f"expected {expected}" if expected else "but the file does not record one"
        raise InputError(f"{path} is damaged: its content has digest {actual}, {problem}; {remedy}")
    return arrays, facts, actual


def check_array(
    name: str, array: np.ndarray, dtype: str, shape: Sequence[int], low: float | int, high: float | int = FLOAT32_MAX
) -> None:
    """Raise if the type, shape or value range of an array is not as expected; see `tensors.check_tensor`.

    >>> check_array("means", np.zeros((2, 3), np.float32), "float32", (2, 3), 0)
    """
    if array.dtype != dtype or array.shape != tuple(shape):
        raise InputError(f"{name} is {array.dtype} {array.shape}, expected {dtype} {tuple(shape)}")
    least, most = (array.min().item(), array.max().item()) if array.size > 0 else (low, low)
    if not low <= least <= most <= high:
        raise InputError(f"{name} has values in {least}..{most}, expected {low:g}..{high:g}")


# NPY files: their size is compared with their header before NumPy allocates anything, and pickles are never loaded.


_HEADER_READERS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
    (3, 0): np.lib.format.read_array_header_2_0,  # differs in the names of records only, which are not read
}
_NUMERIC_KINDS = "biuf"
"""Booleans, integers and floats, of at most 64 bits."""
_MAX_NUMBERS = 2**60
"""Largest product of the side lengths of an array, in which lengths of 0 count as 1."""


def read_npy(path: Path, description: str) -> np.ndarray:
    """Return the numeric array in an NPY file, memory-mapped and read-only.

    Args:
        description: Kind of file, for messages.
    Raises:
        FileNotFoundError: If the file does not exist.
        ValueError: If the file is not an NPY file, holds anything but numbers, or is shorter or longer than its header
            says.
    """
    if not os.path.isfile(path):
        if os.path.lexists(path):
            raise InputError(f"{description} {path} is not a file; expected an NPY file as written by numpy.save")
        raise FileNotFoundError(f"{description} {path} does not exist; check the folder")
    try:
        with path.open("rb") as file:
            _check_npy(file)
        return np.load(path, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError) as error:
        raise InputError(
            f"{description} {path} is damaged or not an NPY file ({error}); write it again with numpy.save"
        ) from None


def read_npy_bytes(data: bytes) -> np.ndarray:
    """Return the numeric array in the bytes of an NPY file; raises ValueError as `read_npy` does."""
    _check_npy(io.BytesIO(data))
    values = np.load(io.BytesIO(data), allow_pickle=False)
    return values.astype(values.dtype.newbyteorder("="))


def _check_npy(file: IO[bytes]) -> None:
    """Raise InputError unless a file holds numbers, and exactly as many bytes of them as its header says."""
    try:
        shape, _, dtype = _HEADER_READERS[np.lib.format.read_magic(file)](file)
    except Exception as error:  # a header is a Python literal; its parsers raise any kind of exception
        raise InputError(f"its NPY header cannot be read: {type(error).__name__}") from None
    if dtype.kind not in _NUMERIC_KINDS or dtype.itemsize > 8:
        kind = "objects" if dtype.hasobject else str(dtype)[:80]
        raise InputError(f"it holds {kind}; expected integers or floats")
    if len(shape) > 8 or min(shape, default=0) < 0 or math.prod(length or 1 for length in shape) > _MAX_NUMBERS:
        raise InputError("its header has an invalid shape: too many lengths, or lengths that are negative or too large")
    start, expected = file.tell(), math.prod(shape) * dtype.itemsize
    found = file.seek(0, os.SEEK_END) - start
    if expected != found:
        lengths = " x ".join(map(str, shape))
        raise InputError(f"{lengths[:80]} {dtype} needs {expected:,} bytes, found {found:,}")


class TensorFile(NamedTuple):
    """Content of a file."""

    tensors: dict[str, Tensor]
    metadata: dict[str, str]
    """Metadata, without the digest."""
    digest: str | None
    """None for files of version 0.1."""


def tensor_digest(tensors: Mapping[str, Tensor], facts: Mapping[str, str], key: str = "") -> str:
    """Return the digest of metadata, a key, and the names, types, shapes and values of tensors.

    >>> import torch
    >>> table = {"a": torch.eye(2)}
    >>> tensor_digest(table, {}) == tensor_digest({"a": torch.eye(2)}, {})
    True
    >>> tensor_digest(table, {}) == tensor_digest(table, {}, "key") or tensor_digest(table, {}) == tensor_digest({}, {})
    False
    """
    parts = ((name, str(x.dtype), x.shape, _bytes(x) if x.numel() > 0 else b"") for name, x in sorted(tensors.items()))
    return content_digest(parts, facts, key)


def _bytes(tensor: Tensor) -> memoryview:
    import torch  # noqa: PLC0415 (a query without torch loads this module)

    flat = tensor.detach().cpu().reshape(-1).contiguous()
    return flat.as_strided(flat.shape, (1,)).view(torch.uint8).numpy().data  # a single element may have any stride


def save_tensors(
    path: Path,
    tensors: Mapping[str, Tensor],
    facts: Mapping[str, str] | None = None,
    *,
    key: str = "",
    overwrite: bool = False,
) -> str:
    """Write a safetensors file and return its digest, which its metadata also records.

    Args:
        facts: further metadata.
        key: key of the file in a cache; loading with a different key raises an error.
        overwrite: replace an existing file.
    Raises:
        FileExistsError, OSError: as in `atomic_files`.
    """
    from safetensors.torch import save_file as save_tensor_file  # noqa: PLC0415 (as above)

    metadata = dict(facts or {})
    content = {name: tensor.detach().contiguous().cpu() for name, tensor in tensors.items()}
    digest = tensor_digest(content, metadata, key)
    with atomic_file(path, overwrite=overwrite) as draft:
        save_tensor_file(content, draft, metadata={**metadata, DIGEST_KEY: digest})
        sort_metadata(draft)
    return digest


def load_tensors(
    path: Path, *, key: str = "", legacy_keys: Collection[str] | None = None, remedy: str = "write it again"
) -> TensorFile:
    """Read a file of `save_tensors` and check its digest.

    Args:
        key: the key that the file was saved with.
        legacy_keys: all metadata keys of this kind of file in version 0.1, which wrote no digest. A file with exactly
            these keys is read without a check. None: every file must have a digest.
        remedy: what the error message suggests if the file is missing or damaged.
    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: the digest does not match, or the file is not a safetensors file.
    """
    return TensorFile(*read_safetensors(path, "pt", tensor_digest, key, legacy_keys, remedy))


def check_tensor(
    name: str,
    tensor: Tensor,
    dtype: torch.dtype,
    shape: Sequence[int],
    low: float | int,
    high: float | int = FLOAT32_MAX,
) -> None:
    """Raise if the type, shape or value range of a tensor is not as expected.

    Args:
        name: name of the tensor, for the error message.
        low, high: bounds of its values, both inclusive; NaN and infinity are always out of range.
    Raises:
        ValueError: the tensor differs; the message has the actual and the expected properties.
    """
    if tensor.dtype != dtype or tuple(tensor.shape) != tuple(shape):
        raise InputError(f"{name} is {tensor.dtype} {tuple(tensor.shape)}, expected {dtype} {tuple(shape)}")
    least, most = (x.item() for x in _extremes(tensor)) if tensor.numel() > 0 else (low, low)
    if not low <= least <= most <= high:
        raise InputError(f"{name} has values in {least}..{most}, expected {low:g}..{high:g}")


def _extremes(tensor: Tensor) -> tuple[Tensor, Tensor]:
    """Return the minimum and the maximum."""
    try:
        return tensor.aminmax()
    except RuntimeError:  # torch before 2.2 lacks aminmax for half precision on the CPU
        return tensor.float().aminmax()
