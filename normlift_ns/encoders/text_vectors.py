"""Vectors of texts from a file, for features whose text encoder is not at hand."""

from __future__ import annotations

import difflib
from collections.abc import Sequence
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

from normlift_ns.encoders.source import check_prompts


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
        for prompt in prompts:
            if prompt not in self._vectors:
                near = difflib.get_close_matches(prompt, self.names) or self.names[:5]
                raise ValueError(
                    f"text {prompt!r} has no vector in {self.file}, which holds {len(self.names)}; near names: "
                    f"{', '.join(near)}"
                )
        return torch.stack([self._vectors[prompt] for prompt in prompts])

    @cached_property
    def _vectors(self) -> dict[str, Tensor]:
        try:
            with np.load(self.file, allow_pickle=False) as archive:
                arrays = {name: archive[name] for name in archive.files}
        except Exception as error:  # whatever a foreign file makes NumPy and zipfile raise
            raise ValueError(
                f"file of text vectors {self.file} is damaged or no NPZ file ({error}); write it again with "
                "numpy.savez(file, **{text: vector, ...})"
            ) from None
        lengths = {array.shape for array in arrays.values()}
        for name, array in arrays.items():
            if array.ndim != 1 or array.dtype.kind != "f" or len(lengths) > 1:
                raise ValueError(
                    f"{self.file}: the array of {name!r} is {array.dtype} {array.shape}; expected floats, [D], with "
                    f"the same D for every text (found {', '.join(map(str, sorted(lengths)))})"
                )
            if not np.isfinite(array).all() or not array.any():
                raise ValueError(f"{self.file}: the vector of {name!r} is zero or not finite; encode the text again")
        return {
            name: normalize(torch.tensor(array, dtype=torch.float64), dim=0).float() for name, array in arrays.items()
        }
