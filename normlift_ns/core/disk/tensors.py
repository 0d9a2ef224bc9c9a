"""Files of tensors with a digest of all that they hold, which is checked before any of it is used.

The digest is XXH3's with 128 bits. It finds damage and files in the wrong place; it keeps nobody from forging one. On a
core of an AMD EPYC it reads 31 GB/s where BLAKE2b reads 0.9: 1.5 ms instead of 50 for a field of 44 MB.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor
from xxhash import xxh3_128

from normlift_ns.core.files import new_file
from normlift_ns.errors import InputError

_DIGEST = "digest"


LARGEST = torch.finfo(torch.float32).max
"""Of the numbers in a file."""


class TensorFile(NamedTuple):
    """What a file holds."""

    tensors: dict[str, Tensor]
    facts: dict[str, str]
    digest: str | None
    """None: a file of version 0.1."""


def tensor_digest(tensors: Mapping[str, Tensor], facts: Mapping[str, str], key: str = "") -> str:
    """Digest of names, types, shapes and numbers of tensors, of the facts beside them, and of a key.

    >>> table = {"a": torch.eye(2)}
    >>> tensor_digest(table, {}) == tensor_digest({"a": torch.eye(2)}, {})
    True
    >>> tensor_digest(table, {}) == tensor_digest(table, {}, "key") or tensor_digest(table, {}) == tensor_digest({}, {})
    False
    """
    state = xxh3_128(json.dumps([key, sorted(facts.items())]).encode())
    for name, tensor in sorted(tensors.items()):
        state.update(json.dumps([name, str(tensor.dtype), list(tensor.shape)]).encode())
        state.update(tensor.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy().data)
    return f"xxh3_128:{state.hexdigest()}"


def save_tensors(
    path: Path,
    tensors: Mapping[str, Tensor],
    facts: Mapping[str, str] | None = None,
    *,
    key: str = "",
    overwrite: bool = False,
) -> str:
    """Writes a safetensors file with facts and digest in its metadata; returns the digest.

    Args:
        key: what finds the file again, for a cache: under another one the file is refused.
    Raises:
        FileExistsError, OSError: as `new_files`.
    """
    given = dict(facts or {})
    content = {name: tensor.detach().contiguous().cpu() for name, tensor in tensors.items()}
    digest = tensor_digest(content, given, key)
    with new_file(path, overwrite=overwrite) as draft:
        save_file(content, draft, metadata={**given, _DIGEST: digest})
        _sort_facts(draft)
    return digest


def _sort_facts(path: Path) -> None:
    """safetensors writes facts in any order; what is the same shall be the same file, bit for bit."""
    with path.open("r+b") as file:
        size = int.from_bytes(file.read(8), "little")
        header = json.loads(file.read(size))
        header["__metadata__"] = dict(sorted(header["__metadata__"].items()))
        ordered = json.dumps(header, ensure_ascii=False, separators=(",", ":")).encode().ljust(size)
        if len(ordered) == size:  # else another release of safetensors writes its header in another way
            file.seek(8)
            file.write(ordered)


def load_tensors(
    path: Path, *, key: str = "", undigested: Collection[str] | None = None, remedy: str = "write it again"
) -> TensorFile:
    """Reads what `save_tensors` wrote.

    Args:
        key: as it was given then.
        undigested: names of all facts in files of version 0.1, which have no digest; None: there are none.
        remedy: what to do about a damaged file, for the message.
    Raises:
        FileNotFoundError: no such file.
        ValueError: another digest than the file names, or no safetensors file.
    """
    if path.exists() and not path.is_file():  # a pipe would never end
        raise InputError(f"{path} is no file; {remedy}")
    try:
        with safe_open(path, framework="pt") as file:
            facts = dict(file.metadata() or {})
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (safe_open is no mapping)
        expected = facts.pop(_DIGEST, None)
        digested = expected is not None or undigested is None or set(facts) != set(undigested)
        found = tensor_digest(tensors, facts, key) if digested else None
    except FileNotFoundError:
        raise FileNotFoundError(f"{path} is missing; {remedy}") from None
    except (SafetensorError, OSError, KeyError, TypeError, AttributeError, RuntimeError, UnicodeError) as error:
        raise InputError(f"{path} is damaged or no safetensors file ({error}); {remedy}") from error
    if found != expected:
        raise InputError(
            f"{path} is damaged: its content has digest {found}, expected {expected or 'one, but it names none'}; "
            f"{remedy}"
        )
    return TensorFile(tensors, facts, found)


def check_tensor(
    name: str, tensor: Tensor, dtype: torch.dtype, shape: Sequence[int], low: float | int, high: float | int = LARGEST
) -> None:
    """Makes sure that a tensor of a file is what the program is about to take it for.

    Args:
        low, high: the range of its numbers, which includes both; NaN and infinity are in none.
    Raises:
        ValueError: it is not; the message says what was found and expected.
    """
    if tensor.dtype != dtype or tuple(tensor.shape) != tuple(shape):
        raise InputError(f"{name} is {tensor.dtype} {tuple(tensor.shape)}, expected {dtype} {tuple(shape)}")
    least, most = (x.item() for x in tensor.aminmax()) if tensor.numel() > 0 else (low, low)
    if not low <= least <= most <= high:
        raise InputError(f"{name} has numbers in {least}..{most}, expected {low:g}..{high:g}")
