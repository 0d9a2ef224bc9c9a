"""Files of arrays with a digest of all that they hold, which is checked before any of it is used. Needs no torch.

The digest is XXH3's with 128 bits. It finds damage and files in the wrong place; it keeps nobody from forging one. On a
core of an AMD EPYC it reads 31 GB/s where BLAKE2b reads 0.9: 1.5 ms instead of 50 for a field of 44 MB.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file
from xxhash import xxh3_128

from normlift_ns.core.files import new_file
from normlift_ns.errors import InputError

LARGEST = float(np.finfo(np.float32).max)
"""Of the numbers in a file."""
DIGEST = "digest"
"""Among the facts of a file."""
Parts = Iterable[tuple[str, str, Sequence[int], Any]]
"""Names, types as torch writes them, shapes and bytes of arrays."""


class ArrayFile(NamedTuple):
    """What a file holds."""

    arrays: dict[str, np.ndarray]
    facts: dict[str, str]
    digest: str | None
    """None: a file of version 0.1."""


def digest_of(parts: Parts, facts: Mapping[str, str], key: str) -> str:
    """Digest of names, types, shapes and numbers, sorted by name, of the facts beside them, and of a key."""
    state = xxh3_128(json.dumps([key, sorted(facts.items())]).encode())
    for name, dtype, shape, content in parts:
        state.update(json.dumps([name, dtype, list(shape)]).encode())
        state.update(content)
    return f"xxh3_128:{state.hexdigest()}"


def array_digest(arrays: Mapping[str, np.ndarray], facts: Mapping[str, str], key: str = "") -> str:
    """As `tensors.tensor_digest`.

    >>> array_digest({"a": np.eye(2)}, {}) == array_digest({"a": np.eye(2, dtype=np.float32)}, {})
    False
    """
    parts = (
        (name, f"torch.{array.dtype}", array.shape, np.ascontiguousarray(array).reshape(-1).view(np.uint8).data)
        for name, array in sorted(arrays.items())
    )
    return digest_of(parts, facts, key)


def save_arrays(
    path: Path,
    arrays: Mapping[str, np.ndarray],
    facts: Mapping[str, str] | None = None,
    *,
    key: str = "",
    overwrite: bool = False,
) -> str:
    """As `tensors.save_tensors`."""
    given = dict(facts or {})
    content = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    digest = array_digest(content, given, key)
    with new_file(path, overwrite=overwrite) as draft:
        save_file(content, draft, metadata={**given, DIGEST: digest})
        sort_facts(draft)
    return digest


def sort_facts(path: Path) -> None:
    """safetensors writes facts in any order; what is the same shall be the same file, bit for bit."""
    with path.open("r+b") as file:
        size = int.from_bytes(file.read(8), "little")
        header = json.loads(file.read(size))
        header["__metadata__"] = dict(sorted(header["__metadata__"].items()))
        ordered = json.dumps(header, ensure_ascii=False, separators=(",", ":")).encode().ljust(size)
        if len(ordered) == size:  # else another release of safetensors writes its header in another way
            file.seek(8)
            file.write(ordered)


def load_arrays(
    path: Path, *, key: str = "", undigested: Collection[str] | None = None, remedy: str = "write it again"
) -> ArrayFile:
    """As `tensors.load_tensors`."""
    return ArrayFile(*read_safetensors(path, "np", array_digest, key, undigested, remedy))


def read_facts(path: Path) -> dict[str, str]:
    """The facts in the head of a file, which nothing has confirmed: the digest is of all that it holds.

    Raises:
        FileNotFoundError: no such file.
        ValueError: no safetensors file.
    """
    try:
        with safe_open(path, framework="np") as file:
            return dict(file.metadata() or {})
    except FileNotFoundError:
        raise
    except (SafetensorError, OSError, ValueError) as error:
        raise InputError(f"{path} is damaged or no safetensors file ({error})") from error


def read_safetensors(
    path: Path,
    framework: str,
    digest: Callable[[Any, dict[str, str], str], str],
    key: str,
    undigested: Collection[str] | None,
    remedy: str,
) -> tuple[dict[str, Any], dict[str, str], str | None]:
    """What a file holds, its facts and its digest.

    Args:
        framework: "np" or "pt", what the arrays are for.
        digest: of arrays, facts and key.
        key, undigested, remedy: as `tensors.load_tensors`, which also says what is raised.
    """
    if path.exists() and not path.is_file():  # a pipe would never end
        raise InputError(f"{path} is no file; {remedy}")
    try:
        with safe_open(path, framework=framework) as file:
            facts = dict(file.metadata() or {})
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (safe_open is no mapping)
        expected = facts.pop(DIGEST, None)
        digested = expected is not None or undigested is None or set(facts) != set(undigested)
        found = digest(arrays, facts, key) if digested else None
    except FileNotFoundError:
        raise FileNotFoundError(f"{path} is missing; {remedy}") from None
    except (SafetensorError, OSError, KeyError, TypeError, AttributeError, RuntimeError, ValueError) as error:
        raise InputError(f"{path} is damaged or no safetensors file ({error}); {remedy}") from error
    if found != expected:
        raise InputError(
            f"{path} is damaged: its content has digest {found}, expected {expected or 'one, but it names none'}; "
            f"{remedy}"
        )
    return arrays, facts, found


def check_array(
    name: str, array: np.ndarray, dtype: str, shape: Sequence[int], low: float | int, high: float | int = LARGEST
) -> None:
    """As `tensors.check_tensor`.

    >>> check_array("means", np.zeros((2, 3), np.float32), "float32", (2, 3), 0)
    """
    if array.dtype != dtype or array.shape != tuple(shape):
        raise InputError(f"{name} is {array.dtype} {array.shape}, expected {dtype} {tuple(shape)}")
    least, most = (array.min().item(), array.max().item()) if array.size > 0 else (low, low)
    if not low <= least <= most <= high:
        raise InputError(f"{name} has numbers in {least}..{most}, expected {low:g}..{high:g}")
