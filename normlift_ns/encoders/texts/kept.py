"""A cache of text embeddings: prompts that were encoded before need neither the network nor torch."""

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
"""Part of every cache key; to be increased when labels or features change for the same settings."""
_ARRAY = "text"


def cache_path(folder: Path, identity: Mapping[str, Any], *content: bytes) -> Path:
    """Return the cache path of a result with the given settings and content, whether the file exists or not."""
    parts = (FORMAT.encode(), json.dumps(identity, sort_keys=True).encode(), *content)
    key = blake2b(b"".join(xxh3_128(part).digest() for part in parts), digest_size=16).hexdigest()
    return folder / f"{key}.safetensors"


@dataclass(frozen=True)
class KeptTexts:
    """A text encoder that caches its embeddings. The key: the text, and the settings that change its vector."""

    settings: Callable[[], dict[str, Any]]
    """Returns every setting that changes `text`, as JSON-serializable values; weight files are identified by their
    content."""
    network: Callable[[], TextEncoder]
    """Makes the encoder; called only for texts that are not cached."""
    folder: Path | None
    """Contains one safetensors file per text; created if it does not exist. If the folder is None or cannot be written
    to, nothing is cached."""

    def text(self, prompts: Sequence[str]) -> Float32[Tensor, "q d"]:
        """Return `rows` as a torch tensor."""
        import torch  # noqa: PLC0415 (queries can do without torch)

        return torch.from_numpy(self.rows(prompts))

    def rows(self, prompts: Sequence[str]) -> Float32[np.ndarray, "q d"]:
        """Return one unit row per prompt.

        Raises:
            ValueError, FileNotFoundError, MemoryError: As the network and its `text`.
        """
        check_prompts(prompts)
        rows = {prompt: self._load(prompt) for prompt in prompts}
        new = [prompt for prompt, row in rows.items() if row is None]
        for prompt, row in zip(new, self._encoder.text(new).numpy() if len(new) > 0 else []):
            rows[prompt] = row
            with suppress(OSError):
                self._save(prompt, row)
        return np.stack([row for prompt in prompts if (row := rows[prompt]) is not None])

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

    def _load(self, prompt: str) -> Float32[np.ndarray, " d"] | None:
        """Return the cached vector of a prompt; None if it is missing, damaged, or not a unit vector."""
        path = self._path(prompt)
        try:
            row = None if path is None or not os.path.isfile(path) else load_arrays(path, key=path.stem).arrays[_ARRAY]
        except (FileNotFoundError, ValueError, KeyError):
            return None
        if row is None or row.dtype != np.float32 or row.ndim != 1 or row.size == 0:
            return None
        return row if abs(float(np.linalg.norm(row)) - 1) < UNIT_TOLERANCE else None

    def _save(self, prompt: str, row: Float32[np.ndarray, " d"]) -> None:
        path = self._path(prompt)
        if path is not None:
            save_arrays(path, {_ARRAY: row}, key=path.stem, overwrite=True)


def text_identity(model: str, pretrained: str, template: str) -> dict[str, Any]:
    """Return every setting of an OpenCLIP model that changes its text embeddings."""
    weights = file_digest(Path(pretrained)) if os.path.isfile(pretrained) else pretrained
    return {"model": model, "pretrained": weights, "template": template}
