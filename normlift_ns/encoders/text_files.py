"""Prompts, their templates, and their embeddings in files and in the cache. Imports no torch."""

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
    """The part of an encoder that queries need."""

    @property
    def identity(self) -> dict[str, Any]:
        """See `FeatureSource.identity`."""
        ...

    def text(self, prompts: Sequence[str]) -> Float32[Tensor, "q d"]:
        """See `FeatureSource.text`."""
        ...


class LazyTextEncoder(TextEncoder, Protocol):
    """A text encoder that imports torch only if it has to run a network."""

    def rows(self, prompts: Sequence[str]) -> Float32[np.ndarray, "q d"]:
        """Return one unit row per prompt; raise ValueError for a prompt that the encoder does not understand."""
        ...

    def text(self, prompts: Sequence[str]) -> Float32[Tensor, "q d"]:
        """Return `rows` as a torch tensor."""
        import torch  # noqa: PLC0415 (queries can do without torch)

        return torch.from_numpy(self.rows(prompts))


UNIT_TOLERANCE = 1e-3
"""Largest deviation from length 1 of a unit vector; half precision leaves 5e-4."""


def check_prompts(prompts: Sequence[str]) -> None:
    """Raise ValueError unless `prompts` is a list of at least one text, none of them empty."""
    if isinstance(prompts, str):
        raise InputError(f"prompts must be a list of texts, got the single text {prompts!r}; write [{prompts!r}]")
    if len(prompts) == 0:
        raise InputError('no text given; name at least one object to search for, such as --text "orange"')
    for prompt in prompts:
        if not isinstance(prompt, str) or re.search("[\0\ud800-\udfff]", prompt):
            raise InputError(f"a text must be a str of valid characters, got {prompt!r:.60}")
    empty = [i for i, prompt in enumerate(prompts) if not prompt.strip()]
    if len(empty) > 0:
        raise InputError(
            f"text {empty[0] + 1} of {len(prompts)} is empty ({prompts[empty[0]]!r}); remove it, or describe what "
            "to search for"
        )


def unit_rows(vectors: Any) -> Float32[np.ndarray, "*n d"]:
    """Return vectors normalized to unit length, without overflow or underflow; they must be finite and not zero.

    >>> unit_rows(np.array([3e-320, 4e-320])), unit_rows(np.array([3e38, 3e38], np.float32))
    (array([0.6, 0.8], dtype=float32), array([0.70710677, 0.70710677], dtype=float32))
    """
    rows = np.asarray(vectors).astype(np.float64)
    rows = rows / np.abs(rows).max(axis=-1, keepdims=True)
    return (rows / np.linalg.norm(rows, axis=-1, keepdims=True)).astype(np.float32)


ENSEMBLE = "ensemble"
"""Name of the set of open_clip's seven templates."""


def check_template(template: str) -> None:
    """Raise InputError if a template has no placeholder for the text."""
    if template != ENSEMBLE and "{}" not in template:
        raise InputError(
            f"text template {template!r} has no placeholder {{}} for the text; write it like "
            f'"a photo of a {{}}", or give {ENSEMBLE} for the mean of several templates'
        )


def prompt_templates(template: str) -> Sequence[Callable[[str], str]]:
    """Return the functions that fill the templates; the embedding of a text is the mean over them.

    >>> [make("mug") for make in prompt_templates("a {}, a big {}")]
    ['a mug, a big mug']
    """
    if template == ENSEMBLE:
        from normlift_ns.encoders.open_clip import import_open_clip_module  # noqa: PLC0415 (rarely needed)

        return import_open_clip_module("zero_shot_metadata").SIMPLE_IMAGENET_TEMPLATES
    return [lambda text: template.replace("{}", text)]


_MAX_VECTOR_BYTES, _MAX_FILE_BYTES = 2**20, 2**30
"""Limits in bytes, because a small archive can decompress to any number of equal bytes."""
_COMMENT_PREFIX = b"normlift_ns "
"""Prefix of the comment of archives that this package writes; the digest follows. NumPy's archives have no comment."""


@dataclass(frozen=True)
class TextEmbeddingFile(LazyTextEncoder):
    """Text embeddings from an NPZ file that holds one vector [D] per text, with the text as the name of the array.

    Raises:
        FileNotFoundError: If the file does not exist.
    """

    file: Path

    def __post_init__(self) -> None:
        if not os.path.isfile(self.file):
            if os.path.lexists(self.file):
                raise InputError(f"{self.file} is not a file of text vectors; give an NPZ file with --text-embeddings")
            raise FileNotFoundError(
                f"file of text vectors {self.file} does not exist; give an NPZ file with one vector per text with "
                "--text-embeddings"
            )

    @property
    def identity(self) -> dict[str, Any]:
        """A digest of the content of the file, independent of its path."""
        content = read_file(self.file, max_bytes=_MAX_FILE_BYTES)
        return {"kind": "text_vectors", "content": blake2b(content, digest_size=16).hexdigest()}

    @property
    def texts(self) -> tuple[str, ...]:
        """The texts that have an embedding.

        Raises:
            ValueError: If the file is damaged, or holds anything but vectors of one length.
        """
        return tuple(self._vectors)

    @property
    def dimension(self) -> int | None:
        """Length D of the embeddings; None for an empty file. Raises as `texts`."""
        return next((len(vector) for vector in self._vectors.values()), None)

    def rows(self, prompts: Sequence[str]) -> Float32[np.ndarray, "q d"]:
        """Return one unit row per prompt.

        Raises:
            ValueError: If `prompts` or a prompt is empty, or one is not in the file. Also for the same reasons as
                `texts`.
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
        ValueError: If two entries have the same name, or an entry is too large or not an array. Also for the same
            reasons as zipfile.
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
            yield name, read_npy_bytes(archive.read(entry))
        except InputError as error:
            raise InputError(f"the entry {name!r} is not a valid vector: {error}") from None


def look_up_embeddings(prompts: Sequence[str], vectors: Mapping[str, Any], origin: str) -> Float32[np.ndarray, "q d"]:
    """Return one unit row per prompt.

    Args:
        vectors: Arrays, or tensors on the CPU.
        origin: Origin of the vectors, for the message.
    Raises:
        ValueError: If a prompt has no vector.
    """
    for prompt in prompts:
        if prompt not in vectors:
            near = difflib.get_close_matches(prompt, vectors) or list(vectors)[:5]
            hint = f"which holds {len(vectors)}; closest: {', '.join(near)}" if len(vectors) > 0 else "which is empty"
            raise InputError(f"text {truncate_text(prompt)!r} has no vector in {origin}, {hint}")
    return np.stack([unit_rows(vectors[prompt]) for prompt in prompts])


def write_text_embeddings(file: Path, vectors: Mapping[str, Any]) -> None:
    """Write unit vectors in float32 and a digest, atomically, in the format that `TextEmbeddingFile` reads.

    Raises:
        FileExistsError, OSError: As `atomic_file`.
    """
    units = {text: unit_rows(vector) for text, vector in vectors.items()}
    with atomic_file(file, own=True) as draft, zipfile.ZipFile(draft, "w") as archive:
        for text, unit in units.items():  # numpy.savez does not accept a text named "file"
            with archive.open(f"{text}.npy", "w") as entry:
                np.lib.format.write_array(entry, unit, allow_pickle=False)
        archive.comment = _digest_comment(units)


def _digest_comment(vectors: Mapping[str, np.ndarray]) -> bytes:
    """Return the archive comment, with the digest of the vectors."""
    return _COMMENT_PREFIX + array_digest(vectors, {}).encode()


CACHE_FORMAT = "normlift_ns.encoders/3"
"""Part of every cache key; to be increased when labels or features change for the same settings."""
_ARRAY = "text"


def cache_path(folder: Path, identity: Mapping[str, Any], *content: bytes) -> Path:
    """Return the cache path of a result with the given settings and content, whether the file exists or not."""
    parts = (CACHE_FORMAT.encode(), json.dumps(identity, sort_keys=True).encode(), *content)
    key = blake2b(b"".join(xxh3_128(part).digest() for part in parts), digest_size=16).hexdigest()
    return folder / f"{key}.safetensors"


@dataclass(frozen=True)
class CachedTextEncoder(LazyTextEncoder):
    """A text encoder that caches its embeddings. The key: the text, and the settings that change its vector."""

    make_identity: Callable[[], dict[str, Any]]
    """Returns every setting that changes `text`, as JSON-serializable values; weight files are identified by their
    content."""
    make_encoder: Callable[[], TextEncoder]
    """Makes the encoder; called only for texts that are not cached."""
    folder: Path | None
    """Folder with one safetensors file per text, created if it does not exist. If it is None or not writable, nothing
    is cached."""

    def rows(self, prompts: Sequence[str]) -> Float32[np.ndarray, "q d"]:
        """Return one unit row per prompt.

        Raises:
            ValueError, FileNotFoundError, MemoryError: As the network and its `text`.
        """
        check_prompts(prompts)
        rows = {prompt: self._load(prompt) for prompt in prompts}
        new = [prompt for prompt, row in rows.items() if row is None]
        for prompt, row in zip(new, self._encoder.text(new).numpy() if len(new) > 0 else []):
            rows[prompt], path = row, self._path(prompt)
            if path is not None:
                with suppress(OSError):
                    save_arrays(path, {_ARRAY: row}, key=path.stem, overwrite=True)
        return np.stack([row for prompt in prompts if (row := rows[prompt]) is not None])

    @cached_property
    def _encoder(self) -> TextEncoder:
        return self.make_encoder()

    @property
    def identity(self) -> dict[str, Any]:
        """Every setting that changes `text`."""
        return self._identity

    @cached_property
    def _identity(self) -> dict[str, Any]:
        return self.make_identity()

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


def open_clip_text_identity(model: str, pretrained: str, template: str) -> dict[str, Any]:
    """Return every setting of an OpenCLIP model that changes its text embeddings."""
    weights = file_digest(Path(pretrained)) if os.path.isfile(pretrained) else pretrained
    return {"model": model, "pretrained": weights, "template": template}
