"""Vectors of texts from a file, for features whose text encoder is not at hand."""

from __future__ import annotations

import difflib
import os
import struct
import zipfile
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from hashlib import blake2b
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float32

from normlift_ns.core.disk.arrays import array_digest
from normlift_ns.core.files import new_file
from normlift_ns.encoders.npy import read_array
from normlift_ns.encoders.texts.prompts import check_prompts, unit_rows
from normlift_ns.errors import InputError, shortened

if TYPE_CHECKING:
    from torch import Tensor

_LARGEST_VECTOR, _LARGEST_FILE = 2**20, 2**30
"""Bytes; few bytes of an archive can hold any number of equal ones."""
_SEAL = b"normlift_ns "
"""How the comment begins of an archive that we wrote; the digest follows. Those of NumPy have none."""


@dataclass(frozen=True)
class TextVectors:
    """Texts are looked up in an NPZ file that holds one vector [D] per text, under the text as its name.

    Raises:
        FileNotFoundError: no such file.
    """

    file: Path

    def __post_init__(self) -> None:
        if not os.path.isfile(self.file):
            if os.path.lexists(self.file):
                raise InputError(f"{self.file} is no file of text vectors; give an NPZ file with --text-vectors")
            raise FileNotFoundError(
                f"file of text vectors {self.file} does not exist; say where it is with --text-vectors, an NPZ file "
                "with one vector per text"
            )

    @property
    def identity(self) -> dict[str, Any]:
        """The file counts by its content, wherever it lies."""
        return {"kind": "text_vectors", "content": blake2b(self.file.read_bytes(), digest_size=16).hexdigest()}

    @property
    def names(self) -> tuple[str, ...]:
        """The texts that can be asked.

        Raises:
            ValueError: a file that is damaged, or holds anything but vectors of one length.
        """
        return tuple(self._vectors)

    @property
    def dimension(self) -> int | None:
        """D; None in an empty file. Raises as `names`."""
        return next((len(vector) for vector in self._vectors.values()), None)

    def text(self, prompts: Sequence[str]) -> Float32[Tensor, "q d"]:
        """One unit row per prompt.

        Raises:
            ValueError: no prompt, an empty one, or one that is not in the file; a file as in `names`.
        """
        import torch  # noqa: PLC0415 (a question that needs no more is asked without)

        return torch.from_numpy(self.rows(prompts))

    def rows(self, prompts: Sequence[str]) -> Float32[np.ndarray, "q d"]:
        """As `text`, without torch."""
        check_prompts(prompts)
        return look_up(prompts, self._vectors, str(self.file))

    @cached_property
    def _vectors(self) -> dict[str, np.ndarray]:
        try:
            with zipfile.ZipFile(self.file) as archive:
                arrays, comment = dict(_entries(archive)), archive.comment
            expected = _seal(arrays)
            if comment.startswith(_SEAL) and comment != expected:
                raise InputError(f"its content has {expected.decode()!r}, expected {comment.decode('latin1')!r}")
        except (  # what zipfile and zlib raise
            OSError, ValueError, LookupError, EOFError, RuntimeError, NotImplementedError, OverflowError,
            zipfile.BadZipFile, zlib.error, struct.error,
        ) as error:  # fmt: skip
            raise InputError(
                f"file of text vectors {self.file} is damaged or no NPZ file ({error}); write it again with "
                "numpy.savez(file, **{text: vector, ...})"
            ) from None
        lengths = {array.shape for array in arrays.values()}
        for name, array in arrays.items():
            if array.ndim != 1 or array.dtype.kind != "f" or len(lengths) > 1:
                raise InputError(
                    f"{self.file}: the array of {name!r} is {array.dtype} {array.shape}; expected floats, [D], with "
                    f"the same D for every text (found {', '.join(map(str, sorted(lengths)))})"
                )
            if not np.isfinite(array).all() or not array.any():
                raise InputError(f"{self.file}: the vector of {name!r} is zero or not finite; encode the text again")
        return {name: array.astype(np.float64) for name, array in arrays.items()}


def _entries(archive: zipfile.ZipFile) -> Iterator[tuple[str, np.ndarray]]:
    """Texts and vectors, unchecked. What an entry says of its size is held against bounds before it is read.

    Raises:
        ValueError: two entries of one name, entries that are too large or no arrays; and what zipfile raises.
    """
    entries = archive.infolist()
    if sum(entry.file_size for entry in entries) > _LARGEST_FILE:
        raise InputError(f"its vectors would take more than {_LARGEST_FILE:,} bytes")
    seen: set[str] = set()
    for entry in entries:
        name = entry.filename.removesuffix(".npy")
        if name in seen:
            raise InputError(f"it has two vectors of {name!r}")
        seen.add(name)
        if entry.file_size > _LARGEST_VECTOR:
            raise InputError(f"the vector of {name!r} takes {entry.file_size:,} bytes, at most {_LARGEST_VECTOR:,}")
        try:
            yield name, read_array(archive.read(entry))
        except InputError as error:
            raise InputError(f"the vector of {name!r} is none: {error}") from None


def look_up(prompts: Sequence[str], vectors: Mapping[str, Any], where: str) -> Float32[np.ndarray, "q d"]:
    """One unit row per prompt.

    Args:
        vectors: arrays, or tensors on the CPU.
        where: the vectors come from, for the message.
    Raises:
        ValueError: a prompt without a vector.
    """
    for prompt in prompts:
        if prompt not in vectors:
            near = difflib.get_close_matches(prompt, vectors) or list(vectors)[:5]
            hint = (
                f"which holds {len(vectors)}; near names: {', '.join(near)}" if len(vectors) > 0 else "which holds none"
            )
            raise InputError(f"text {shortened(prompt)!r} has no vector in {where}, {hint}")
    return np.stack([unit_rows(vectors[prompt]) for prompt in prompts])


def write_text_vectors(file: Path, vectors: Mapping[str, Any]) -> None:
    """Writes what `TextVectors` reads, as unit vectors in float32, complete or not at all, with a digest.

    Raises:
        FileExistsError, OSError: as `new_file`.
    """
    units = {text: unit_rows(vector) for text, vector in vectors.items()}
    with new_file(file) as draft, zipfile.ZipFile(draft, "w") as archive:
        for text, unit in units.items():  # numpy.savez takes no text that is called "file"
            with archive.open(f"{text}.npy", "w") as entry:
                np.lib.format.write_array(entry, unit, allow_pickle=False)
        archive.comment = _seal(units)


def _seal(vectors: Mapping[str, np.ndarray]) -> bytes:
    """The comment of an archive of ours, with its digest."""
    return _SEAL + array_digest(vectors, {}).encode()
