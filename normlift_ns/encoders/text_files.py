"""Prompts, prompt templates, and prompt embeddings in files and in the cache. This module does not import torch."""

from __future__ import annotations

import difflib
import json
import os
import re
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from hashlib import blake2b
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from jaxtyping import Float32
from xxhash import xxh3_128

from normlift_ns.errors import InputError, truncate_text
from normlift_ns.io.arrays import array_digest, load_arrays, read_npy_bytes, save_arrays
from normlift_ns.io.atomic import atomic_file, file_digest
from normlift_ns.io.guard import open_regular, read_file

if TYPE_CHECKING:
    from torch import Tensor


class TextEncoder(Protocol):
    """The text part of an encoder, which is sufficient for queries."""

    @property
    def identity(self) -> dict[str, Any]:
        """Settings that identify the encoder, as JSON-serializable values; see `FeatureSource.identity`."""
        ...

    def text(self, prompts: Sequence[str]) -> Float32[Tensor, "q d"]:
        """See `FeatureSource.text`."""
        ...


class LazyTextEncoder(TextEncoder, Protocol):
    """A text encoder that imports torch only if it has to run a network."""

    def rows(self, prompts: Sequence[str]) -> Float32[np.ndarray, "q d"]:
        """Return one unit vector per prompt; raise ValueError if the encoder cannot embed a prompt."""
        ...

    def text(self, prompts: Sequence[str]) -> Float32[Tensor, "q d"]:
        """Return `rows` as a torch tensor."""
        import torch  # noqa: PLC0415 (queries do not need torch)

        return torch.from_numpy(self.rows(prompts))


UNIT_TOLERANCE = 1e-3
"""Largest accepted difference between the length of a unit vector and 1. Half precision causes up to 5e-4."""


def check_prompts(prompts: Sequence[str]) -> None:
    """Raise ValueError unless `prompts` is a sequence of one or more prompts that are not blank.

    A prompt must be a string without null characters or surrogates.
    """
    if isinstance(prompts, str):
        raise InputError(f"prompts must be a list of strings, got the single string {prompts!r}; write [{prompts!r}]")
    if len(prompts) == 0:
        raise InputError('no prompt is given; name at least one object to search for, such as "orange"')
    for prompt in prompts:
        if not isinstance(prompt, str) or re.search("[\0\ud800-\udfff]", prompt):
            raise InputError(f"a prompt must be a string without null characters or surrogates, got {prompt!r:.60}")
    empty = [i for i, prompt in enumerate(prompts) if not prompt.strip()]
    if len(empty) > 0:
        raise InputError(
            f"prompt {empty[0] + 1} of {len(prompts)} is empty ({prompts[empty[0]]!r}); remove it, or name an object "
            "to search for"
        )


def unit_rows(vectors: Any) -> Float32[np.ndarray, "*n d"]:
    """Normalize vectors to unit length without overflow or underflow. They must be finite and not zero.

    >>> unit_rows(np.array([3e-320, 4e-320])), unit_rows(np.array([3e38, 3e38], np.float32))
    (array([0.6, 0.8], dtype=float32), array([0.70710677, 0.70710677], dtype=float32))
    """
    rows = np.asarray(vectors).astype(np.float64)
    rows = rows / np.abs(rows).max(axis=-1, keepdims=True)
    return (rows / np.linalg.norm(rows, axis=-1, keepdims=True)).astype(np.float32)


ENSEMBLE = "ensemble"
"""Name that selects open_clip's seven prompt templates."""


def check_template(template: str) -> None:
    """Raise InputError if a prompt template has no placeholder."""
    if template != ENSEMBLE and "{}" not in template:
        raise InputError(
            f"prompt template {template!r} has no placeholder {{}}; give a template such as "
            f'"a photo of a {{}}", or {ENSEMBLE} for the mean of several templates'
        )


def prompt_templates(template: str) -> Sequence[Callable[[str], str]]:
    """Return the functions that fill the prompt templates. The embedding of a prompt is the mean over all templates.

    >>> [make("mug") for make in prompt_templates("a {}, a big {}")]
    ['a mug, a big mug']
    """
    if template == ENSEMBLE:
        from normlift_ns.encoders.open_clip import import_open_clip_module  # noqa: PLC0415 (rarely needed)

        return import_open_clip_module("zero_shot_metadata").SIMPLE_IMAGENET_TEMPLATES
    return [lambda text: template.replace("{}", text)]


_MAX_VECTOR_BYTES, _MAX_FILE_BYTES = 2**20, 2**30
"""Limits on the decompressed sizes of one vector and of a whole file in bytes, because a small archive can decompress
to a very large size."""
_COMMENT_PREFIX = b"normlift_ns "
"""Prefix of the digest in the comment of archives that this package writes. NumPy's archives have no comment."""


@dataclass(frozen=True)
class TextEmbeddingFile(LazyTextEncoder):
    """A text encoder that reads embeddings from an NPZ file with one vector [D] per prompt, named by the prompt.

    Raises:
        FileNotFoundError: If the file does not exist.
        ValueError: If the path is not a file.
    """

    file: Path

    def __post_init__(self) -> None:
        if not os.path.isfile(self.file):
            if os.path.lexists(self.file):
                raise InputError(f"{self.file} is not a file of text embeddings; set --text-embeddings to an NPZ file")
            raise FileNotFoundError(
                f"file of text embeddings {self.file} does not exist; set --text-embeddings to an NPZ file with one "
                "vector per prompt"
            )

    @property
    def identity(self) -> dict[str, Any]:
        """Digest of the content of the file, independent of its path."""
        content = read_file(self.file, max_bytes=_MAX_FILE_BYTES)
        return {"kind": "text_vectors", "content": blake2b(content, digest_size=16).hexdigest()}

    @property
    def texts(self) -> tuple[str, ...]:
        """Prompts that have an embedding.

        Raises:
            ValueError: If the file is damaged, or does not consist of vectors of the same length.
        """
        return tuple(self._vectors)

    @property
    def dimension(self) -> int | None:
        """Length D of the embeddings, or None for an empty file. Raises the same errors as `texts`."""
        return next((len(vector) for vector in self._vectors.values()), None)

    def rows(self, prompts: Sequence[str]) -> Float32[np.ndarray, "q d"]:
        """Return one unit vector per prompt.

        Raises:
            ValueError: If `prompts` or a prompt is empty, or a prompt is not in the file.
            ValueError: For the same reasons as `texts`.
        """
        check_prompts(prompts)
        return look_up_embeddings(prompts, self._vectors, str(self.file))

    @cached_property
    def _vectors(self) -> dict[str, np.ndarray]:
        try:
            with open_regular(self.file) as file, zipfile.ZipFile(file) as archive:
                arrays, comment = dict(_entries(archive)), archive.comment
            expected = _digest_comment(arrays)
            if comment.startswith(_COMMENT_PREFIX) and comment != expected:
                raise InputError(f"its digest is {expected.decode()!r}, expected {comment.decode('latin1')!r}")
        except (  # exceptions of zipfile and zlib
            OSError, ValueError, LookupError, EOFError, RuntimeError, OverflowError,
            zipfile.BadZipFile, zlib.error, struct.error,
        ) as error:  # fmt: skip
            raise InputError(
                f"file of text embeddings {self.file} is damaged or cannot be read as an NPZ file ({error}); write it "
                "again with numpy.savez(file, **{text: vector, ...})"
            ) from None
        for name, array in arrays.items():
            if array.ndim != 1 or array.dtype.kind != "f":
                raise InputError(
                    f"{self.file}: the array of {name!r} has type {array.dtype} and shape {array.shape}, expected a "
                    "vector of floating-point numbers"
                )
            if not np.isfinite(array).all() or not array.any():
                raise InputError(f"{self.file}: the vector of {name!r} is zero or not finite; encode the prompt again")
        lengths = sorted({len(array) for array in arrays.values()})
        if len(lengths) > 1:
            found = ", ".join(map(str, lengths))
            raise InputError(
                f"{self.file} has vectors of different lengths ({found}); encode all prompts with one encoder"
            )
        return {name: array.astype(np.float64) for name, array in arrays.items()}


def _entries(archive: zipfile.ZipFile) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the prompts and vectors of an archive without checking them, except for their declared sizes.

    Raises:
        ValueError: If two entries have the same name, the archive or an entry is too large, or an entry is not an
            array.
        Exception: If zipfile cannot read the archive.
    """
    entries = archive.infolist()
    if sum(entry.file_size for entry in entries) > _MAX_FILE_BYTES:
        raise InputError(f"its vectors take more than {_MAX_FILE_BYTES:,} bytes")
    names: set[str] = set()
    for entry in entries:
        name = entry.filename.removesuffix(".npy")
        if name in names:
            raise InputError(f"it has two vectors for {name!r}")
        names.add(name)
        if entry.file_size > _MAX_VECTOR_BYTES:
            raise InputError(f"the vector of {name!r} has {entry.file_size:,} bytes, more than {_MAX_VECTOR_BYTES:,}")
        try:
            yield name, read_npy_bytes(archive.read(entry))
        except InputError as error:
            raise InputError(f"the entry {name!r} is not a valid vector: {error}") from None


def look_up_embeddings(prompts: Sequence[str], vectors: Mapping[str, Any], origin: str) -> Float32[np.ndarray, "q d"]:
    """Return one unit vector per prompt.

    Args:
        vectors: Vector of each known prompt, an array or a tensor on the CPU.
        origin: Origin of the vectors, for messages.
    Raises:
        ValueError: If a prompt has no vector.
    """
    for prompt in prompts:
        if prompt not in vectors:
            near = difflib.get_close_matches(prompt, vectors) or list(vectors)[:5]
            hint = f"; use a prompt that has one, such as {', '.join(near)}"
            hint = hint if len(vectors) > 0 else ", which is empty; add the vectors of your prompts"
            raise InputError(f"prompt {truncate_text(prompt)!r} has no vector in {origin}{hint}")
    return np.stack([unit_rows(vectors[prompt]) for prompt in prompts])


def write_text_embeddings(file: Path, vectors: Mapping[str, Any]) -> None:
    """Write unit vectors in float32 with a digest, atomically and in the format of `TextEmbeddingFile`.

    Raises:
        FileExistsError, OSError: For the same reasons as `atomic_file`.
    """
    units = {text: unit_rows(vector) for text, vector in vectors.items()}
    with atomic_file(file, own=True) as draft, zipfile.ZipFile(draft, "w") as archive:
        for text, unit in units.items():  # numpy.savez does not accept a text named "file"
            with archive.open(f"{text}.npy", "w") as entry:
                np.lib.format.write_array(entry, unit, allow_pickle=False)
        archive.comment = _digest_comment(units)


def _digest_comment(vectors: Mapping[str, np.ndarray]) -> bytes:
    """Return the comment of an archive, which contains the digest of its vectors."""
    return _COMMENT_PREFIX + array_digest(vectors, {}).encode()


CACHE_FORMAT = "normlift_ns.encoders/3"
"""Part of all cache keys. Increase its number if labels or features change for the same settings."""
_ARRAY = "text"
_MANY = 64
"""Largest number of prompts that are cached one by one. A longer list of prompts is cached as a whole."""


def cache_path(folder: Path, identity: Mapping[str, Any], *content: bytes) -> Path:
    """Return the cache path of a result with the given settings and inputs; the file may not exist."""
    parts = (CACHE_FORMAT.encode(), json.dumps(identity, sort_keys=True).encode(), *content)
    key = blake2b(b"".join(xxh3_128(part).digest() for part in parts), digest_size=16).hexdigest()
    return folder / f"{key}.safetensors"


@dataclass(frozen=True)
class CachedTextEncoder(LazyTextEncoder):
    """A text encoder that caches its embeddings. Keys depend on the prompts and on `identity`."""

    make_identity: Callable[[], dict[str, Any]]
    """Function that returns all settings that change `text`, as JSON-serializable values. Weight files are identified
    by their content."""
    make_encoder: Callable[[], TextEncoder]
    """Function that makes the encoder, called only for prompts that are not cached."""
    folder: Path | None
    """Folder with one safetensors file per prompt, or per list of more than `_MANY` prompts, created if it does not
    exist. If it is None or not writable, nothing is cached."""

    def rows(self, prompts: Sequence[str]) -> Float32[np.ndarray, "q d"]:
        """Return one unit vector per prompt.

        Raises:
            ValueError, FileNotFoundError, MemoryError: For the same reasons as `make_encoder` and the encoder's `text`.
        """
        check_prompts(prompts)
        # The thousand files of a vocabulary would take longer than its network.
        keys = [tuple(prompts)] if len(prompts) > _MANY else [(prompt,) for prompt in prompts]
        paths = {key: self._path("\n".join(key)) for key in keys}
        blocks = {key: self._load(path, len(key)) for key, path in paths.items()}
        new = [key for key, block in blocks.items() if block is None]
        if len(new) > 0:
            made = self._encoder.text([prompt for key in new for prompt in key]).numpy()
            for key, block in zip(new, np.split(made, len(new))):
                blocks[key] = block
                self._store(paths[key], block)
        rows = {prompt: row for key, block in blocks.items() if block is not None for prompt, row in zip(key, block)}
        return np.stack([rows[prompt] for prompt in prompts])

    @cached_property
    def _encoder(self) -> TextEncoder:
        return self.make_encoder()

    @property
    def identity(self) -> dict[str, Any]:
        """All settings that change `text`."""
        return self._identity

    @cached_property
    def _identity(self) -> dict[str, Any]:
        return self.make_identity()

    def _path(self, prompt: str) -> Path | None:
        return None if self.folder is None else cache_path(self.folder, self.identity, prompt.encode())

    def _store(self, path: Path | None, block: Float32[np.ndarray, "q d"]) -> None:
        """Write the vectors of prompts to the cache; do nothing if there is no cache or it is not writable."""
        if path is not None:
            with suppress(OSError):
                save_arrays(path, {_ARRAY: block[0] if len(block) == 1 else block}, key=path.stem, overwrite=True)

    def _load(self, path: Path | None, count: int) -> Float32[np.ndarray, "q d"] | None:
        """Return the cached vectors of `count` prompts, or None if they are missing, damaged or not unit vectors."""
        try:
            row = None if path is None or not os.path.isfile(path) else load_arrays(path, key=path.stem).arrays[_ARRAY]
        except (FileNotFoundError, ValueError, KeyError):
            return None
        if (
            row is None
            or row.dtype != np.float32
            or row.size == 0
            or row.shape[:-1] != (() if count == 1 else (count,))
        ):
            return None
        rows = row.reshape(count, -1)
        return rows if bool((np.abs(np.linalg.norm(rows, axis=1) - 1) < UNIT_TOLERANCE).all()) else None


def open_clip_text_identity(model: str, pretrained: str, template: str) -> dict[str, Any]:
    """Return all settings of an OpenCLIP model that change its prompt embeddings."""
    weights = file_digest(Path(pretrained)) if os.path.isfile(pretrained) else pretrained
    return {"model": model, "pretrained": weights, "template": template}
