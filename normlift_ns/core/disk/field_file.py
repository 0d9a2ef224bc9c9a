"""The files of a semantic field, read and checked: nothing in them leads anywhere else, and all numbers are numbers.
Needs no torch.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int32, Int64

from normlift_ns.core.disk.arrays import LARGEST, check_array, load_arrays
from normlift_ns.core.disk.manifest import REMEDY, check_digests, read_manifest
from normlift_ns.errors import InputError

FIELD_FILE, EVIDENCE_FILE = "field.safetensors", "evidence.safetensors"
EVIDENCE_FORMAT = "normlift_ns.evidence/1"
EVIDENCE_COUNTS = ("num_views", "weight_power", "num_excluded")
SCALARS = ("norm", "c_intra", "c_inter", "n_eff", "reliability", "weight", "view_count")
"""Numbers of every Gaussian, as `core.lift.Scalars` has them."""
_MOST_VIEWS = 2**24


class RowArrays(NamedTuple):
    """A sparse matrix by rows, as `core.sparse.SparseRows` has it."""

    offsets: Int64[np.ndarray, " rows_plus_1"]
    column: Int32[np.ndarray, " nnz"]
    weight: Float[np.ndarray, " nnz"]

    def check(self, name: str, num_columns: int) -> None:
        """Makes sure that the arrays describe weights in a matrix of so many columns.

        Args:
            name: of the matrix, for the message.
        Raises:
            ValueError: another type or shape, entries outside the matrix, weights that are negative or not finite.
        """
        weights = "float64" if self.weight.dtype == "float64" else "float32"
        arrays = (("offsets", self.offsets, "int64"), ("columns", self.column, "int32"))
        for what, array, dtype in (*arrays, ("weights", self.weight, weights)):
            if array.ndim != 1 or array.dtype != dtype:
                raise InputError(f"{name}: {what} are {array.dtype} {array.shape}, expected one row of {dtype}")
        ends = [int(self.offsets[0]), int(self.offsets[-1])] if self.offsets.size > 0 else []
        size = self.column.size
        if ends != [0, size] or self.weight.size != size or bool((self.offsets[1:] < self.offsets[:-1]).any()):
            raise InputError(
                f"{name}: offsets must rise from 0 to the number of entries, found {ends} for {size} columns and "
                f"{self.weight.size} weights"
            )
        low, high = (int(self.column.min()), int(self.column.max())) if size > 0 else (0, -1)
        if low < 0 or high >= num_columns:
            raise InputError(f"{name}: columns are in {low}..{high}, expected 0..{num_columns - 1}")
        least, most = (float(self.weight.min()), float(self.weight.max())) if size > 0 else (0.0, 0.0)
        if not 0 <= least <= most < math.inf:
            raise InputError(f"{name}: weights are in {least}..{most}, expected finite ones that are not negative")


class EvidenceArrays(NamedTuple):
    """What `Evidence.save` wrote."""

    rows: RowArrays
    region_view: Int32[np.ndarray, " s"]
    unlabeled: RowArrays
    counts: tuple[int, int, int]
    """Views, power of the weights, Gaussians left out."""
    digest: str | None
    """None: a file of version 0.1."""


class FieldArrays(NamedTuple):
    """What `SemanticField.save` wrote."""

    manifest: dict[str, Any]
    arrays: dict[str, np.ndarray]
    """source, the scalars, means unless version 0.1 wrote it; features, or coordinates and perhaps their basis."""
    evidence: EvidenceArrays | None
    digested: frozenset[str]
    """Files whose digests the manifest has, by their paths from its folder."""


def read_evidence(path: Path, *, key: str = "", remedy: str = "rasterize again") -> EvidenceArrays:
    """Reads what `Evidence.save` wrote.

    Args:
        key: as it was given then; a file with a key that has no digest, as version 0.1 wrote it, is refused.
        remedy: what to do about a damaged file, for the message.
    Raises:
        FileNotFoundError: no such file.
        ValueError: not an evidence file, or a damaged one.
    """
    old = None if key else ("format", *EVIDENCE_COUNTS)
    arrays, facts, digest = load_arrays(path, key=key, undigested=old, remedy=remedy)
    if facts.get("format") != EVIDENCE_FORMAT:
        raise InputError(
            f"{path} is not an evidence file of this version: format {facts.get('format')!r}, expected "
            f"{EVIDENCE_FORMAT!r}"
        )
    try:
        rows = RowArrays(*(arrays[name] for name in ("offsets", "region", "weight")))
        unlabeled = RowArrays(*(arrays[f"unlabeled_{name}"] for name in ("offsets", "column", "weight")))
        region_view = arrays["region_view"]
        views, power, excluded = (int(facts[name]) for name in EVIDENCE_COUNTS)
        if region_view.ndim != 1 or region_view.dtype != "int32":
            raise InputError(f"region_view is {region_view.dtype} {region_view.shape}, expected int32, [S]")
        rows.check("weights of regions", len(region_view))
        if not (0 <= views <= _MOST_VIEWS and power in (0, 1, 2) and 0 <= excluded <= len(rows.offsets) - 1):
            found = ", ".join(map(str, (views, power, excluded)))
            raise InputError(f"{', '.join(EVIDENCE_COUNTS)} are {found[:50]}, out of range")
        unlabeled.check("weights of unlabelled pixels", views)
        if len(unlabeled.offsets) != len(rows.offsets):
            raise InputError(
                f"{len(rows.offsets) - 1} Gaussians have weights of regions, {len(unlabeled.offsets) - 1} of "
                "unlabelled pixels"
            )
        _check_views(region_view, views)
        return EvidenceArrays(rows, region_view, unlabeled, (views, power, excluded), digest)
    except (KeyError, ValueError) as error:
        raise InputError(f"{path} is damaged ({error}); {remedy}") from error


def _check_views(region_view: Int32[np.ndarray, " s"], views: int) -> None:
    low, high = (int(region_view.min()), int(region_view.max())) if region_view.size > 0 else (0, -1)
    if low < 0 or high >= views or bool((region_view[1:] < region_view[:-1]).any()):
        raise InputError(f"views of regions are in {low}..{high}, expected 0..{views - 1}, rising")


def read_field(folder: Path) -> FieldArrays:
    """Reads what `SemanticField.save` wrote, with the digests of all files checked.

    Raises:
        FileNotFoundError: no complete field in the folder.
        ValueError: another schema, or a damaged file; the message names it.
    """
    manifest, digests = read_manifest(folder)
    try:
        arrays, _, digest = load_arrays(folder / FIELD_FILE, undigested=(), remedy=REMEDY)
        found, evidence = {FIELD_FILE: digest}, None
        if manifest["form"] == "evidence":
            evidence = read_evidence(folder / EVIDENCE_FILE, remedy=REMEDY)
            found[EVIDENCE_FILE] = evidence.digest
        check_digests(folder, found, digests)
        _check_field(folder / FIELD_FILE, arrays, manifest, evidence)
    except KeyError as error:
        raise InputError(f"the semantic field in {folder} is damaged: {error} is missing; {REMEDY}") from error
    return FieldArrays(manifest, arrays, evidence, frozenset(digests or ()))


def _check_field(
    path: Path, arrays: Mapping[str, np.ndarray], manifest: Mapping[str, Any], evidence: EvidenceArrays | None
) -> None:
    n, dimension = int(manifest["num_gaussians"]), int(manifest["dimension"])
    try:
        check_array("source", arrays["source"], "int32", (n,), 0, n - 1)
        if "means" in arrays:  # a Gaussian that was never drawn may have any mean
            check_array("means", np.nan_to_num(arrays["means"]), "float32", (n, 3), -LARGEST)
        for name in SCALARS:
            check_array(name, arrays[name], "int32" if name == "view_count" else "float32", (n,), 0)
        if evidence is not None:
            check_array("features", arrays["features"], "float32", (len(evidence.region_view), dimension), -LARGEST)
            if len(evidence.rows.offsets) - 1 != n:
                raise InputError(f"{EVIDENCE_FILE} has {len(evidence.rows.offsets) - 1} Gaussians, expected {n}")
            return
        rank = dimension
        if manifest["form"] == "low_rank":
            rank = len(arrays["basis"])
            check_array("basis", arrays["basis"], "float32", (rank, dimension), -LARGEST)
        rows = int((arrays["norm"] > 0).sum())
        check_array("coordinates", arrays["coordinates"], "float16", (rows, rank), -LARGEST)
    except ValueError as error:
        raise InputError(f"{path} is damaged: {error}; {REMEDY}") from error
