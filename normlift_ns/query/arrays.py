"""Query-only access to a lifted run, without torch or nerfstudio. Opening a run takes about a second.

Cosines equal those of `SemanticField.query` up to rounding of float32 sums (1e-6).
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
from jaxtyping import Bool, Float, Float32

from normlift_ns.core.relevancy import PROMPT_BLOCK
from normlift_ns.encoders.text_files import LazyTextEncoder
from normlift_ns.errors import InputError
from normlift_ns.io.field import SCALAR_NAMES, FieldArrays, read_field
from normlift_ns.io.run_dir import check_run, field_folder, resolve_manifest_paths, text_cache_folder
from normlift_ns.query.engine import Answer, run_query
from normlift_ns.query.question import make_query
from normlift_ns.query.text_encoder import text_encoder_for, with_text_source

_DIRECTION_BLOCK = 8 * PROMPT_BLOCK
"""Number of prompts per conversion of the directions to float32. The conversion takes most of the time of a query."""
_BLOCK_ELEMENTS = 2**21
"""Number of elements to convert to float32 at a time, so that they fit into the cache of a CPU."""


class ArrayField(FieldArrays):
    """Semantic field as NumPy arrays, for queries without torch; see `SemanticField`."""

    @property
    def scalars(self) -> SimpleNamespace:
        """Scalars per Gaussian, as in `core.lift.Scalars`."""
        return SimpleNamespace(**{name: self.arrays[name] for name in SCALAR_NAMES})

    def valid(self, *, refined: bool = True) -> Bool[np.ndarray, " n"]:
        """Return a mask of the Gaussians with a direction, as `SemanticField.valid` does."""
        mask = self.arrays["norm"] > 0
        return mask[self.arrays["source"]] if refined else mask

    def null_levels(self, *, refined: bool = True) -> Float[np.ndarray, "n levels"]:
        """Return the null levels, as `SemanticField.null_levels` does."""
        level = self.arrays.get("null_level")
        if level is None:
            return np.zeros((len(self.arrays["norm"]), 0), np.float32)
        return (level[self.arrays["source"]] if refined else level)[:, None]

    def query(self, text_vectors: Float[np.ndarray, "q d"], *, refined: bool = True) -> Float32[np.ndarray, "n q"]:
        """Return the cosine between every Gaussian's direction and each of Q vectors, as `SemanticField.query` does.

        Raises:
            ValueError: The vectors have a different dimension than the field.
        """
        arrays, dimension = self.arrays, int(self.manifest["dimension"])
        if text_vectors.shape[1] != dimension:
            raise InputError(
                f"text embeddings must have shape [Q, {dimension}] like the features of the field, got "
                f"{text_vectors.shape}. Use the encoder of these features."
            )
        vectors = text_vectors.astype(np.float64)
        vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
        source = arrays["source"] if refined else np.arange(len(arrays["norm"]))
        row = np.cumsum(arrays["norm"] > 0) - 1  # of every Gaussian among those with a direction
        taken, missing = row[source].clip(min=0), np.flatnonzero(arrays["norm"][source] <= 0)
        cosine = np.zeros((len(vectors), len(source)), np.float32)
        if row[-1:].sum() < 0:
            return cosine.T
        products = self._evidence_products(vectors) if self.evidence is not None else self._direction_products(vectors)
        size = PROMPT_BLOCK if self.evidence is not None else _DIRECTION_BLOCK

        def fill(first: int) -> None:
            block = slice(first, first + size)
            product = products(block)
            np.take(product.clip(-1, 1, out=product), taken, axis=1, out=cosine[block], mode="clip")
            cosine[block, missing] = 0

        with ThreadPoolExecutor(os.cpu_count()) as pool:
            list(pool.map(fill, range(0, len(vectors), size)))
        return cosine.T

    def _evidence_products(self, vectors: Float[np.ndarray, "q d"]) -> Callable[[slice], Float32[np.ndarray, "b m"]]:
        """Return a function that computes the cosines between all directions and a slice of the vectors."""
        from scipy.sparse import csr_array  # noqa: PLC0415 (takes 0.3 s; most fields store directions)

        arrays, rows = self.arrays, cast(Any, self.evidence).rows
        valid = arrays["norm"] > 0
        table = arrays["features"].astype(np.float64) @ vectors.T
        matrix = csr_array((rows.weight, rows.column, rows.offsets), shape=(len(valid), len(table)))
        length = (arrays["weight"].astype(np.float64) * arrays["norm"])[valid, None]
        return lambda block: ((matrix @ table[:, block])[valid] / length).T.astype(np.float32)

    def _direction_products(self, vectors: Float[np.ndarray, "q d"]) -> Callable[[slice], Float32[np.ndarray, "b m"]]:
        """Return a function like that of `_evidence_products`, for a field that stores directions."""
        coordinates, basis = self.arrays["coordinates"], self.arrays.get("basis")
        projected = vectors.astype(np.float32) if basis is None else vectors.astype(np.float32) @ basis.T
        step = max(1, _BLOCK_ELEMENTS // projected.shape[1])

        def products(block: slice) -> Float32[np.ndarray, "b m"]:
            rows = projected[block]
            product = np.empty((len(rows), len(coordinates)), np.float32)
            for first in range(0, len(coordinates), step):
                part = coordinates[first : first + step].astype(np.float32)
                product[:, first : first + step] = rows @ part.T
            return product

        return products


@dataclass(frozen=True, eq=False)
class QuickRun:
    """Semantic field of a run as NumPy arrays, with the text encoder of the run."""

    run_dir: Path
    """Run directory."""
    field: ArrayField
    """Semantic field, whose arrays include `means`, the centers of the Gaussians."""
    manifest: Mapping[str, Any]
    """Manifest of the field, after applying the arguments `text_embeddings` and `prompt_template` of `open_quick`."""
    device: str = "cpu"
    """Device for the network of the text encoder."""

    @cached_property
    def text_encoder(self) -> LazyTextEncoder:
        """Text encoder of the run; access raises the errors of `text_encoder_for`."""
        return text_encoder_for(self, self.device, text_cache_folder(self.run_dir))

    def in_capture(self) -> QuickRun:
        """Return the run with the centers of the Gaussians in the coordinates of the capture.

        Raises:
            FileNotFoundError, ValueError: dataparser_transforms.json is missing or damaged.
        """
        from normlift_ns.data.transforms import capture_transforms  # noqa: PLC0415 (loads torch)

        means = self.field.arrays["means"].astype(np.float64)
        for world in reversed(capture_transforms(self.run_dir, self.field.manifest)):
            means = (means / world.scale - world.transform[:, 3]) @ world.transform[:, :3]
        arrays = {**self.field.arrays, "means": means.astype(np.float32)}
        return replace(self, field=self.field._replace(arrays=arrays))

    def ask(self, texts: Sequence[str], **rules: Any) -> Answer:
        """Run a query. The arrays of the answer are NumPy arrays.

        Args:
            texts: Prompts.
            rules: Keyword arguments of `make_query`.
        Raises:
            ValueError: See `make_query`.
        """
        question = make_query(self, self.text_encoder.rows, texts, **rules)
        return run_query(self.field, self.field.arrays["means"], question)


def open_quick(
    load_config: Path,
    *,
    means: Float32[np.ndarray, "n 3"] | None = None,
    device: str = "cpu",
    text_embeddings: Path | None = None,
    prompt_template: str | None = None,
) -> QuickRun | None:
    """Open the field of a lifted run; return None if the run's files do not determine the centers of the Gaussians.

    Runs of version 0.1 do not store the centers, and other runs may have checkpoints that are newer than the lift. In
    both cases, `means` is needed.

    Args:
        load_config: Path of the run's config.yml.
        means: Centers of the Gaussians, from a scene that `open_run` has matched with the field.
        device: Device for the network of the text encoder.
        text_embeddings, prompt_template: As in `open_run`.
    Raises:
        FileNotFoundError, ValueError: The run has no semantic field, or its files are damaged.
    """
    run_dir = Path(os.path.abspath(load_config)).parent
    check_run(run_dir)
    folder = field_folder(run_dir)
    field = ArrayField(*read_field(folder))
    checkpoints = {
        f"../{path.relative_to(run_dir).as_posix()}" for path in run_dir.glob("nerfstudio_models/step-*.ckpt")
    }
    if means is not None:
        field = field._replace(arrays={**field.arrays, "means": means})
    elif "means" not in field.arrays or not checkpoints <= field.digested_files:
        return None
    run = QuickRun(run_dir, field, resolve_manifest_paths(field.manifest, folder), device)
    return with_text_source(run, text_embeddings=text_embeddings, template=prompt_template)
