"""Text embeddings in a file, for features whose text encoder is not available."""

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

_MAX_VECTOR_BYTES, _MAX_FILE_BYTES = 2**20, 2**30
"""In bytes; a small archive can decompress to any number of equal bytes."""
_COMMENT_PREFIX = b"normlift_ns "
"""Prefix of the comment of archives that this package writes; the digest follows. NumPy's archives have no comment."""


@dataclass(frozen=True)
class TextVectors:
    """Text embeddings from an NPZ file that holds one vector [D] per text, with the text as the name of the array.

    Raises:
        FileNotFoundError: If the file does not exist.
    """

    file: Path

    def __post_init__(self) -> None:
        if not os.path.isfile(self.file):
            if os.path.lexists(self.file):
                raise InputError(f"{self.file} is not a file of text vectors; give an NPZ file with --text-vectors")
            raise FileNotFoundError(
                f"file of text vectors {self.file} does not exist; give an NPZ file with one vector per text with "
                "--text-vectors"
            )

    @property
    def identity(self) -> dict[str, Any]:
        """A digest of the content of the file, independent of its path."""
        return {"kind": "text_vectors", "content": blake2b(self.file.read_bytes(), digest_size=16).hexdigest()}

    @property
    def names(self) -> tuple[str, ...]:
        """The texts that have an embedding.

        Raises:
            ValueError: If the file is damaged, or holds anything but vectors of one length.
        """
        return tuple(self._vectors)

    @property
    def dimension(self) -> int | None:
        """Length D of the embeddings; None for an empty file. Raises as `names`."""
        return next((len(vector) for vector in self._vectors.values()), None)

    def text(self, prompts: Sequence[str]) -> Float32[Tensor, "q d"]:
        """Return one unit row per prompt.

        Raises:
            ValueError: If `prompts` or a prompt is empty, or one is not in the file; and as `names`.
        """
        import torch  # noqa: PLC0415 (queries can do without torch)

        return torch.from_numpy(self.rows(prompts))

    def rows(self, prompts: Sequence[str]) -> Float32[np.ndarray, "q d"]:
        """Return `text` as a NumPy array, without torch."""
        check_prompts(prompts)
        return look_up(prompts, self._vectors, str(self.file))

    @cached_property
    def _vectors(self) -> dict[str, np.ndarray]:
        try:
            with zipfile.ZipFile(self.file) as archive:
                arrays, comment = dict(_entries(archive)), archive.comment
            expected = _digest_comment(arrays)
            if comment.startswith(_COMMENT_PREFIX) and comment != expected:
                raise InputError(f"its digest is {expected.decode()!r}, expected {comment.decode('latin1')!r}")
        except (  # exceptions of zipfile and zlib
            OSError, ValueError, LookupError, EOFError, RuntimeError, NotImplementedError, OverflowError,
            zipfile.BadZipFile, zlib.error, struct.error,
        ) as error:  # fmt: skip
            raise InputError(
                f"file of text vectors {self.file} is damaged or not an NPZ file ({error}); write it again with "
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
    """Yield texts and vectors, unchecked. Declared sizes are compared with the limits before data is read.

    Raises:
        ValueError: If two entries have the same name, or an entry is too large or not an array; and as zipfile.
    """
    entries = archive.infolist()
    if sum(entry.file_size for entry in entries) > _MAX_FILE_BYTES:
        raise InputError(f"its vectors would take more than {_MAX_FILE_BYTES:,} bytes")
    names: set[str] = set()
    for entry in entries:
        name = entry.filename.removesuffix(".npy")
        if name in names:
            raise InputError(f"it has two vectors for {name!r}")
        names.add(name)
        if entry.file_size > _MAX_VECTOR_BYTES:
            raise InputError(f"the vector of {name!r} has {entry.file_size:,} bytes, more than {_MAX_VECTOR_BYTES:,}")
        try:
            yield name, read_array(archive.read(entry))
        except InputError as error:
            raise InputError(f"the entry {name!r} is not a valid vector: {error}") from None


def look_up(prompts: Sequence[str], vectors: Mapping[str, Any], where: str) -> Float32[np.ndarray, "q d"]:
    """Return one unit row per prompt.

    Args:
        vectors: Arrays, or tensors on the CPU.
        where: Origin of the vectors, for the message.
    Raises:
        ValueError: If a prompt has no vector.
    """
    for prompt in prompts:
        if prompt not in vectors:
            near = difflib.get_close_matches(prompt, vectors) or list(vectors)[:5]
            hint = f"which holds {len(vectors)}; closest: {', '.join(near)}" if len(vectors) > 0 else "which is empty"
            raise InputError(f"text {shortened(prompt)!r} has no vector in {where}, {hint}")
    return np.stack([unit_rows(vectors[prompt]) for prompt in prompts])


def write_text_vectors(file: Path, vectors: Mapping[str, Any]) -> None:
    """Write unit vectors in float32 and a digest, atomically, in the format that `TextVectors` reads.

    Raises:
        FileExistsError, OSError: As `new_file`.
    """
    units = {text: unit_rows(vector) for text, vector in vectors.items()}
    with new_file(file) as draft, zipfile.ZipFile(draft, "w") as archive:
        for text, unit in units.items():  # numpy.savez does not accept a text named "file"
            with archive.open(f"{text}.npy", "w") as entry:
                np.lib.format.write_array(entry, unit, allow_pickle=False)
        archive.comment = _digest_comment(units)


def _digest_comment(vectors: Mapping[str, np.ndarray]) -> bytes:
    """Return the archive comment, with the digest of the vectors."""
    return _COMMENT_PREFIX + array_digest(vectors, {}).encode()
