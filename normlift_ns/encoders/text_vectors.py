"""Vectors of texts from a file, for features whose text encoder is not at hand."""

from __future__ import annotations

import difflib
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor
from torch.nn.functional import normalize

from normlift_ns.core.disk.tensors import tensor_digest
from normlift_ns.core.files import new_file
from normlift_ns.encoders.source import check_prompts
from normlift_ns.errors import InputError

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
        if not self.file.is_file():
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

    def text(self, prompts: Sequence[str]) -> Float32[Tensor, "q d"]:
        """One unit row per prompt.

        Raises:
            ValueError: no prompt, an empty one, or one that is not in the file; a file as in `names`.
        """
        check_prompts(prompts)
        return look_up(prompts, self._vectors, str(self.file))

    @cached_property
    def _vectors(self) -> dict[str, Tensor]:
        try:
            with np.load(self.file, allow_pickle=False) as archive:
                arrays, comment = {name: archive[name] for name in archive.files}, archive.zip.comment
            expected = _seal({name: torch.from_numpy(array) for name, array in arrays.items()})
            if comment.startswith(_SEAL) and comment != expected:
                raise InputError(f"its content has {expected.decode()!r}, expected {comment.decode()!r}")
        except Exception as error:  # whatever a foreign file makes NumPy and zipfile raise
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
        return {name: torch.tensor(array, dtype=torch.float64) for name, array in arrays.items()}


def look_up(prompts: Sequence[str], vectors: Mapping[str, Tensor], where: str) -> Float32[Tensor, "q d"]:
    """One unit row per prompt.

    Args:
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
            raise InputError(f"text {prompt!r} has no vector in {where}, {hint}")
    return torch.stack([normalize(vectors[prompt].double().cpu(), dim=0).float() for prompt in prompts])


def write_text_vectors(file: Path, vectors: Mapping[str, Tensor]) -> None:
    """Writes what `TextVectors` reads, as unit vectors in float32, complete or not at all, with a digest.

    Raises:
        FileExistsError, OSError: as `new_file`.
    """
    units = {text: normalize(vector.double().cpu(), dim=0).float() for text, vector in vectors.items()}
    with new_file(file) as draft, zipfile.ZipFile(draft, "w") as archive:
        for text, unit in units.items():  # numpy.savez takes no text that is called "file"
            with archive.open(f"{text}.npy", "w") as entry:
                np.lib.format.write_array(entry, unit.numpy(), allow_pickle=False)
        archive.comment = _seal(units)


def _seal(vectors: Mapping[str, Tensor]) -> bytes:
    """The comment of an archive of ours, with its digest."""
    return _SEAL + tensor_digest(vectors, {}).encode()
