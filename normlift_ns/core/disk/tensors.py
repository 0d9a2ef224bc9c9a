"""Files of tensors with a digest of all that they hold: the face of `disk.arrays` for torch."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from safetensors.torch import save_file
from torch import Tensor

from normlift_ns.core.disk.arrays import DIGEST, LARGEST, digest_of, read_safetensors, sort_facts
from normlift_ns.core.files import new_file
from normlift_ns.errors import InputError


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
    parts = ((name, str(x.dtype), x.shape, _bytes(x) if x.numel() > 0 else b"") for name, x in sorted(tensors.items()))
    return digest_of(parts, facts, key)


def _bytes(tensor: Tensor) -> memoryview:
    flat = tensor.detach().cpu().reshape(-1).contiguous()
    return flat.as_strided(flat.shape, (1,)).view(torch.uint8).numpy().data  # a single number may have any stride


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
        save_file(content, draft, metadata={**given, DIGEST: digest})
        sort_facts(draft)
    return digest


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
    return TensorFile(*read_safetensors(path, "pt", tensor_digest, key, undigested, remedy))


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
    least, most = (x.item() for x in _extremes(tensor)) if tensor.numel() > 0 else (low, low)
    if not low <= least <= most <= high:
        raise InputError(f"{name} has numbers in {least}..{most}, expected {low:g}..{high:g}")


def _extremes(tensor: Tensor) -> tuple[Tensor, Tensor]:
    """The least and the largest number."""
    try:
        return tensor.aminmax()
    except RuntimeError:  # torch before 2.2 has none for half precision on the CPU
        return tensor.float().aminmax()
