"""Safetensors files of torch tensors with a digest of their whole content; `disk.arrays` is the NumPy counterpart."""

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
    """Content of a file."""

    tensors: dict[str, Tensor]
    facts: dict[str, str]
    """Metadata, without the digest."""
    digest: str | None
    """None for files of version 0.1."""


def tensor_digest(tensors: Mapping[str, Tensor], facts: Mapping[str, str], key: str = "") -> str:
    """Return the digest of metadata, a key, and the names, types, shapes and values of tensors.

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
        FileExistsError, OSError: as in `new_files`.
    """
    metadata = dict(facts or {})
    content = {name: tensor.detach().contiguous().cpu() for name, tensor in tensors.items()}
    digest = tensor_digest(content, metadata, key)
    with new_file(path, overwrite=overwrite) as draft:
        save_file(content, draft, metadata={**metadata, DIGEST: digest})
        sort_facts(draft)
    return digest


def load_tensors(
    path: Path, *, key: str = "", undigested: Collection[str] | None = None, remedy: str = "write it again"
) -> TensorFile:
    """Read a file of `save_tensors` and check its digest.

    Args:
        key: the key that the file was saved with.
        undigested: all metadata keys of this kind of file in version 0.1, which wrote no digest. A file with exactly
            these keys is read without a check. None: every file must have a digest.
        remedy: what the error message suggests if the file is missing or damaged.
    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: the digest does not match, or the file is not a safetensors file.
    """
    return TensorFile(*read_safetensors(path, "pt", tensor_digest, key, undigested, remedy))


def check_tensor(
    name: str, tensor: Tensor, dtype: torch.dtype, shape: Sequence[int], low: float | int, high: float | int = LARGEST
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
