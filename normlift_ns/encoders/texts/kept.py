"""Texts that a network has read before: asked again, they need neither the network nor torch."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from hashlib import blake2b
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float32
from xxhash import xxh3_128

from normlift_ns.core.disk.arrays import load_arrays, save_arrays
from normlift_ns.core.disk.digests import file_digest
from normlift_ns.encoders.texts.prompts import UNIT_TOLERANCE, check_prompts

if TYPE_CHECKING:
    from torch import Tensor

    from normlift_ns.encoders.source import TextEncoder

FORMAT = "normlift_ns.encoders/3"
"""Part of every key: to be raised when labels or features change for the same settings."""
_TEXT = "text"


def cache_path(folder: Path, identity: Mapping[str, Any], *content: bytes) -> Path:
    """Where a cache keeps what was made from some content with some settings, whether it is there or not."""
    parts = (FORMAT.encode(), json.dumps(identity, sort_keys=True).encode(), *content)
    key = blake2b(b"".join(xxh3_128(part).digest() for part in parts), digest_size=16).hexdigest()
    return folder / f"{key}.safetensors"


@dataclass(frozen=True)
class KeptTexts:
    """Texts of a network. The key of what is kept: the text, and the settings that change its vector."""

    settings: Callable[[], dict[str, Any]]
    """Every setting that changes `text`, ready for JSON; files of weights count by their content."""
    network: Callable[[], TextEncoder]
    """Makes the encoder, where a text is new."""
    folder: Path | None
    """Holds one safetensors file per text; made if it does not exist. Where it cannot be written to, nothing is kept.
    None: nothing is."""

    def text(self, prompts: Sequence[str]) -> Float32[Tensor, "q d"]:
        """As `rows`, for torch."""
        import torch  # noqa: PLC0415 (a question that needs no more is asked without)

        return torch.from_numpy(self.rows(prompts))

    def rows(self, prompts: Sequence[str]) -> Float32[np.ndarray, "q d"]:
        """One unit row per prompt.

        Raises:
            ValueError, FileNotFoundError, MemoryError: as the network and its `text`.
        """
        check_prompts(prompts)
        found = {prompt: self._kept(prompt) for prompt in prompts}
        new = [prompt for prompt, row in found.items() if row is None]
        for prompt, row in zip(new, self._encoder.text(new).numpy() if len(new) > 0 else []):
            found[prompt] = row
            with suppress(OSError):
                self._keep(prompt, row)
        return np.stack([row for prompt in prompts if (row := found[prompt]) is not None])

    @cached_property
    def _encoder(self) -> TextEncoder:
        return self.network()

    @property
    def identity(self) -> dict[str, Any]:
        """Every setting that changes `text`."""
        return self._identity

    @cached_property
    def _identity(self) -> dict[str, Any]:
        return self.settings()

    def _path(self, prompt: str) -> Path | None:
        return None if self.folder is None else cache_path(self.folder, self.identity, prompt.encode())

    def _kept(self, prompt: str) -> Float32[np.ndarray, " d"] | None:
        """None also where the file is damaged, or holds no unit vector."""
        path = self._path(prompt)
        try:
            row = None if path is None or not os.path.isfile(path) else load_arrays(path, key=path.stem).arrays[_TEXT]
        except (FileNotFoundError, ValueError, KeyError):
            return None
        if row is None or row.dtype != np.float32 or row.ndim != 1 or row.size == 0:
            return None
        return row if abs(float(np.linalg.norm(row)) - 1) < UNIT_TOLERANCE else None

    def _keep(self, prompt: str, row: Float32[np.ndarray, " d"]) -> None:
        path = self._path(prompt)
        if path is not None:
            save_arrays(path, {_TEXT: row}, key=path.stem, overwrite=True)


def text_identity(model: str, pretrained: str, template: str) -> dict[str, Any]:
    """Every setting of an OpenCLIP model that changes what it makes of a text."""
    weights = file_digest(Path(pretrained)) if os.path.isfile(pretrained) else pretrained
    return {"model": model, "pretrained": weights, "template": template}
