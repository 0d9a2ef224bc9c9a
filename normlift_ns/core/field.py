"""`SemanticField`: the result of a lift, its queries and its files.

By default, a field uses the smallest storage that meets the requested tolerance.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal, get_args

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int, Int32
from torch import Tensor

from normlift_ns.core.arguments import check_arguments, check_rows
from normlift_ns.core.device import TensorRecord
from normlift_ns.core.evidence import Evidence
from normlift_ns.core.lift import Lifted, Scalars
from normlift_ns.core.lowrank import (
    StoredDirections,
    StoredEvidence,
    sizes_and_bounds,
    smallest_basis,
    store_directions,
)
from normlift_ns.core.partition import Partition, spatial_order
from normlift_ns.core.relevancy import PROMPT_BLOCK, gaussian_relevancy, top_values
from normlift_ns.errors import InputError
from normlift_ns.io.arrays import save_arrays
from normlift_ns.io.field import EVIDENCE_FILE, FIELD_FILE, SCALAR_NAMES, read_field
from normlift_ns.io.guard import refuse_inputs, refuse_other_kinds
from normlift_ns.io.run_dir import LIFT_AGAIN, MANIFEST_FILE, SCHEMA_VERSION, write_manifest
from normlift_ns.options import RelevancyRule, Storage

CHANGED_COSINE = 0.98
"""Limit on the cosine between the directions of a Gaussian before and after the vote. A Gaussian below the limit, which
corresponds to about 11 degrees, counts as changed."""


@check_arguments
@dataclass(frozen=True)
class SemanticField(TensorRecord):
    """Semantics of N Gaussians: scalars, refinement as indices, and directions in one of three storage forms.

    >>> import torch
    >>> from normlift_ns import Evidence, SemanticField, lift
    >>> from normlift_ns.core.evidence import Entries
    >>> entries = Entries(torch.tensor([0, 1]), torch.tensor([1, 2]), torch.ones(2), (2,))
    >>> lifted = lift(Evidence.from_entries([entries], 3), torch.eye(2))
    >>> field = SemanticField.build(lifted, torch.zeros(3, 3), source=torch.tensor([0, 1, 1]))
    >>> texts = torch.tensor([[3.0, 4.0]])
    >>> field.query(texts, refined=False)[:, 0], field.query(texts)[:, 0]
    (tensor([0.6000, 0.8000, 0.0000]), tensor([0.6000, 0.8000, 0.8000]))
    """

    scalars: Scalars
    source: Int32[Tensor, " n"]
    """Index of the Gaussian whose direction each Gaussian takes in the refinement; source[i] = i if Gaussian i keeps
    its own direction."""
    store: StoredEvidence | StoredDirections
    manifest: Mapping[str, Any] = field(default_factory=dict)
    """JSON-ready metadata: storage (key `form`), sizes and bounds of the compared storage forms (key `forms`),
    fingerprint of the means, and provenance."""
    means: Float[Tensor, "n 3"] | None = None
    """Centers of the Gaussians at the time of the lift, float32; None in fields of version 0.1."""
    null_level: Float[Tensor, " n"] | None = None
    """Null level of every Gaussian's own direction (see `with_null_level`), or None without a null vocabulary."""

    def __len__(self) -> int:
        return self.source.numel()

    @property
    def dimension(self) -> int:
        """D, the length of the feature vectors."""
        return int(self.manifest["dimension"])

    @staticmethod
    @check_arguments
    def build(
        lifted: Lifted,
        means: Float[Tensor, "n 3"],
        source: Int[Tensor, " n"] | None = None,
        *,
        tolerance: float = 1e-3,
        storage: Storage | Literal["auto"] = "auto",
        provenance: Mapping[str, Any] | None = None,
    ) -> SemanticField:
        """Build a field, and record the sizes and error bounds of the compared storage forms in its manifest.

        The compared forms are "evidence", "float16" and, if `storage` allows it and a basis meets the tolerance,
        "low_rank".

        Args:
            source: Result of `refine` (default: no refinement).
            tolerance: Largest error of the cosine between the direction of any Gaussian and any unit vector, > 0. It
                does not affect storage "evidence" and "float16".
            storage: "auto" chooses the smallest storage whose bound is within the tolerance.
            provenance: JSON-ready metadata for the manifest, such as source config, step, encoder and hyperparameters.
        Raises:
            ValueError: If `means` or `source` has the wrong length, `source` has an invalid index, an option is
                invalid, or no rank meets the tolerance for storage "low_rank".
        """
        n = len(lifted.scalars.norm)
        for name, rows in (("means", means), ("source", source)):
            if rows is not None and len(rows) != n:
                raise InputError(f"{name} must have one row per lifted Gaussian ({n:,}), got {len(rows):,}")
        facts, basis = choose_form(lifted, storage, tolerance)
        if facts["form"] == "evidence":
            store = StoredEvidence(lifted.evidence, lifted.features.float())
        else:
            store = store_directions(lifted, basis, spatial_order(means))
        source = torch.arange(n, device=means.device) if source is None else source
        check_rows("source", source, n)
        return SemanticField.assemble(lifted.scalars, source, store, means, provenance=provenance or {}, facts=facts)

    @staticmethod
    def assemble(
        scalars: Scalars,
        source: Int[Tensor, " n"],
        store: StoredEvidence | StoredDirections,
        means: Float[Tensor, "n 3"],
        *,
        provenance: Mapping[str, Any],
        facts: Mapping[str, Any],
    ) -> SemanticField:
        """Return a field with float32 scalars and a manifest that identifies the Gaussians.

        Args:
            provenance: As in `build`.
            facts: Metadata of the storage form for the manifest, from `choose_form`.
        """
        dimension = store.features.shape[1] if isinstance(store, StoredEvidence) else store.dimension
        manifest = {
            **provenance,
            "schema_version": SCHEMA_VERSION,
            "num_gaussians": len(means),
            "dimension": dimension,
            "means_fingerprint": fingerprint(means),
            **facts,
        }
        scalars = scalars.map(lambda x: x.float() if x.dtype == torch.float64 else x)
        return SemanticField(scalars, source.int(), store, manifest, means.detach().float())

    @check_arguments
    def valid(self, *, refined: bool = True) -> Bool[Tensor, " n"]:
        """Return a mask of the Gaussians with a direction, before or after the refinement."""
        mask = self.scalars.norm > 0
        return mask[self.source.long()] if refined else mask

    @check_arguments
    def query(
        self, text_vectors: Float[Tensor, "q d"] | Float[np.ndarray, "q d"], *, refined: bool = True
    ) -> Float[Tensor, "n q"]:
        """Return the cosine between every Gaussian's direction and each of Q vectors of any norm > 0.

        The cosine is 0 for Gaussians without a direction.

        Raises:
            ValueError: If a vector has the wrong dimension, is zero or is not finite.
        """
        if text_vectors.shape[1] != self.dimension:
            raise InputError(
                f"text vectors must have shape [Q, {self.dimension}], like the features of the field, got "
                f"{tuple(text_vectors.shape)}; use the encoder of the lift"
            )
        vectors = torch.as_tensor(text_vectors).to(self.scalars.norm.device, torch.float64)
        length = torch.linalg.vector_norm(vectors, dim=1, keepdim=True)
        bad = (~(length.isfinite() & (length > 0))).nonzero()
        if len(bad) > 0:
            first = int(bad[0, 0])
            raise InputError(
                f"text vectors must be finite and not zero, but vector {first} has length {float(length[first]):g}"
            )
        source = self.source.long() if refined else slice(None)
        cosine = self.scalars.norm.new_empty(len(vectors), len(self), dtype=torch.float32)  # prompts first, in blocks
        for block, rows in zip(cosine.split(PROMPT_BLOCK), (vectors / length).split(PROMPT_BLOCK)):
            block.copy_(self.store.products(rows, self.scalars)[source].T)
        return cosine.T

    @check_arguments
    def null_levels(self, *, refined: bool = True) -> Float[Tensor, "n levels"]:
        """Return the null level of every Gaussian as a matrix [N, 1], or a matrix [N, 0] without a null vocabulary."""
        if self.null_level is None:
            return self.scalars.norm.new_zeros(len(self), 0)
        return (self.null_level[self.source.long()] if refined else self.null_level)[:, None]

    @check_arguments
    def relevancy(
        self,
        text_vectors: Float[Tensor, "q d"],
        negatives: Float[Tensor, "b d"] | None = None,
        *,
        rule: RelevancyRule = "cosine",
        refined: bool = True,
    ) -> Float[Tensor, "n q"]:
        """Return the relevancy of every Gaussian to Q text vectors, from the cosines of `query`.

        A Gaussian without a direction gets a relevancy of 0, or -2 for the rule "margin", and is never selected.

        Args:
            negatives: Vectors of the negative prompts, for rules that need them.
        Raises:
            ValueError: If a vector is invalid as in `query`, or the rule needs negatives or null levels that are
                missing.
        """
        count = len(text_vectors)
        cosine = self.query(
            text_vectors if negatives is None else torch.cat([text_vectors, negatives]), refined=refined
        )
        negative = self.null_levels(refined=refined) if rule == "contrast" else cosine[:, count:]
        return gaussian_relevancy(cosine[:, :count], negative, self.valid(refined=refined), rule)

    @check_arguments
    def directions(self, gaussians: Int[Tensor, " m"] | None = None, *, refined: bool = True) -> Float[Tensor, "m d"]:
        """Return the unit directions of all or some Gaussians, or 0 for those without a direction.

        Raises:
            ValueError: If a Gaussian does not exist.
        """
        rows = torch.arange(len(self), device=self.source.device) if gaussians is None else gaussians
        check_rows("gaussians", rows, len(self))
        rows = self.source.long()[rows] if refined else rows
        return torch.cat([self.store.directions(block, self.scalars) for block in rows.split(2**14)])

    @check_arguments
    def save(
        self,
        folder: str | Path,
        *,
        overwrite: bool = False,
        beside: Mapping[str, str] = MappingProxyType({}),
        own: bool = False,
    ) -> None:
        """Write field.safetensors, evidence.safetensors (only for storage "evidence") and finally manifest.json.

        A folder with a manifest is complete. The manifest contains the digests of the files.

        Args:
            beside: Digests of other files that belong to the field, by their paths relative to the folder.
            own: Skip the checks of `io.guard`, for folders in a run of this package.
        Raises:
            ValueError: If this would replace an input, a file of a run or data set, or a file of a different type. Also
                if the manifest cannot be encoded as JSON, or the folder is a file.
            FileExistsError: If the folder contains a field and `overwrite` is False.
            OSError: If a file cannot be written, for instance because the disk is full.
        """
        folder = Path(folder)
        _check_target(folder, {**self.manifest, "digests": dict(beside)})
        if (folder / MANIFEST_FILE).exists() and not overwrite:
            raise FileExistsError(
                f"{folder} already contains a semantic field; choose another folder or pass overwrite=True"
            )
        if not own:
            files = [folder / name for name in (FIELD_FILE, EVIDENCE_FILE, MANIFEST_FILE)]
            refuse_inputs(files, instead="folder")
            for file in files:
                refuse_other_kinds(file, file.suffix)
        # a folder without a manifest is incomplete and may be overwritten
        for name in (MANIFEST_FILE, EVIDENCE_FILE):
            (folder / name).unlink(missing_ok=True)
        stored = {"features": self.store.features} if isinstance(self.store, StoredEvidence) else vars(self.store)
        named = {
            "source": self.source,
            "means": self.means,
            "null_level": self.null_level,
            **vars(self.scalars),
            **stored,
        }
        tensors = {name: tensor for name, tensor in named.items() if tensor is not None}
        digests = {FIELD_FILE: save_arrays(folder / FIELD_FILE, tensors, overwrite=True)}
        if isinstance(self.store, StoredEvidence):
            digests[EVIDENCE_FILE] = self.store.evidence.save(folder / EVIDENCE_FILE, own=True)
        write_manifest(folder, self.manifest, {**digests, **beside})

    @staticmethod
    @check_arguments
    def load(
        folder: str | Path, means: Float[Tensor, "n 3"] | None = None, *, checkpoint: str | Path = "the checkpoint"
    ) -> SemanticField:
        """Read a field written by `save`.

        Args:
            means: Centers of the Gaussians that the field must belong to (default: no check).
            checkpoint: Source of the means, for error messages.
        Raises:
            FileNotFoundError: If the folder does not contain a complete field.
            ValueError: If the schema is not supported, a file is damaged, or the field belongs to other Gaussians. The
                message names the file or folder.
        """
        folder = Path(folder)
        manifest, arrays, evidence, _ = read_field(folder)
        tensors = {name: torch.from_numpy(array) for name, array in arrays.items()}
        if means is not None:
            _check_belongs(manifest, tensors.get("means"), means, folder, checkpoint)
        scalars = Scalars(**{name: tensors[name] for name in SCALAR_NAMES})
        if evidence is not None:
            store = StoredEvidence(Evidence.of_arrays(evidence), tensors["features"])
        else:
            store = StoredDirections(tensors["coordinates"], tensors.get("basis"))
        return SemanticField(
            scalars, tensors["source"], store, manifest, tensors.get("means"), tensors.get("null_level")
        )


def choose_form(
    lifted: Lifted, storage: str, tolerance: float, portion: Partition | None = None
) -> tuple[dict[str, Any], Float64[Tensor, "r d"] | None]:
    """Choose the storage form. "auto" selects the smallest form whose bound is within the tolerance.

    Args:
        portion: Partition of the Gaussians, if several processes lift the scene. The lift then covers the Gaussians of
            this process.
    Returns:
        Metadata for the manifest about the chosen form and all compared forms, and the basis if the form is "low_rank".
        "low_rank" is compared only if `storage` is "auto" or "low_rank" and a basis meets the tolerance.
    Raises:
        ValueError: If the storage is unknown, the tolerance is not positive, or no rank meets it for "low_rank".
    """
    if not tolerance > 0:
        raise InputError(f"tolerance must be positive, got {tolerance}")
    if storage not in (*get_args(Storage), "auto"):
        raise InputError(f"storage must be one of auto, {', '.join(get_args(Storage))}; got {storage!r}")
    communicator = None if portion is None else portion.communicator
    basis = smallest_basis(lifted, tolerance, communicator) if storage in ("auto", "low_rank") else None
    forms = sizes_and_bounds(lifted, basis, portion)
    if storage == "auto":
        allowed = (name for name, form in forms.items() if form["bound"] <= tolerance)
        storage = min(allowed, key=lambda name: forms[name]["bytes"])
    elif storage not in forms:
        raise InputError(
            f"no low-rank basis meets tolerance {tolerance} for every Gaussian; increase the tolerance, or use storage "
            "float16 or evidence"
        )
    rows = basis.rows if storage == "low_rank" and basis is not None else None
    return {"form": storage, "tolerance": tolerance, "forms": forms}, rows


def fingerprint(means: Float[Tensor, "n 3"]) -> str:
    """Return the BLAKE2 hash of the float32 bytes of the means, which identifies a set of Gaussians."""
    return hashlib.blake2b(means.detach().float().contiguous().cpu().numpy().tobytes(), digest_size=16).hexdigest()


def _check_belongs(
    manifest: Mapping[str, Any], stored: Tensor | None, means: Tensor, folder: Path, checkpoint: str | Path
) -> None:
    """Raise InputError unless the field was lifted from exactly these means."""
    if manifest["num_gaussians"] != len(means):
        raise InputError(
            f"the semantic field in {folder} has {manifest['num_gaussians']} Gaussians, but {checkpoint} has "
            f"{len(means)}; {LIFT_AGAIN}"
        )
    if stored is None:
        same = manifest["means_fingerprint"] == fingerprint(means)
    else:
        same = torch.equal(stored.view(torch.int32), means.detach().float().contiguous().cpu().view(torch.int32))
    if not same:
        raise InputError(
            f"the semantic field in {folder} was lifted from other Gaussians than those of {checkpoint} (same "
            f"number, different means); {LIFT_AGAIN}"
        )


def _check_target(folder: Path, facts: Mapping[str, Any]) -> None:
    """Raise InputError if the metadata or the folder is not valid for a field."""
    try:
        json.dumps(facts).encode("utf8")
    except (TypeError, ValueError, RecursionError) as error:
        raise InputError(f"provenance or beside cannot be encoded as JSON: {error}") from None
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder} is not a folder; choose another path")


# Null level of every Gaussian, the cosine that a prompt must exceed to differ from unrelated text.
#
# The level is the k-th largest cosine between a Gaussian and the texts of the null vocabulary. Here, k is 3 % of the
# number of texts, rounded, and at least 2. With many texts, a prompt above the level is therefore more similar than
# about 97 % of them. If the null vocabulary consists of the texts of a scene, at most 83, only the most similar text is
# above the level. docs/honest_answers.md compares it with other thresholds.


NULL_SHARE = 0.03
"""Share of the null vocabulary that may be more similar to a Gaussian than a matching prompt."""
_NULL_BLOCK = 32


def with_null_level(field: SemanticField, vectors: Float[Tensor, "m d"]) -> SemanticField:
    """Return the field with the null level of every Gaussian.

    The null level is the k-th largest cosine between a Gaussian's own direction and the texts of the null vocabulary.
    Here, k is 3 % of the number of texts, rounded, and at least 2. The manifest of the result records the top cosines
    of the texts in ascending order. A top cosine is the 99.9 % quantile over the Gaussians that have a direction.

    Args:
        vectors: Vectors of at least two texts of the null vocabulary, of any norm > 0.
    """
    count = max(2, round(NULL_SHARE * len(vectors)))
    own, source = field.valid(refined=False), field.source.long()
    valid, best = field.valid(), None
    tops: list[float] = []
    for block in vectors.split(_NULL_BLOCK):
        cosine = field.query(block, refined=False).float()
        tops += top_values(cosine[source[valid]]) if bool(valid.any()) else []
        best = cosine if best is None else torch.cat([best, cosine], 1)
        best = best.topk(min(count, best.shape[1]), 1).values
    assert best is not None
    level = torch.where(own, best[:, -1], 0.0)
    facts = {"texts": len(vectors), "tops": sorted(round(top, 4) for top in tops)}
    return replace(field, null_level=level, manifest={**field.manifest, "null_words": facts})
