"""Reader for the files of a semantic field. It checks digests, shapes and ranges of values.

This module does not need torch.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int32, Int64

from normlift_ns.errors import InputError
from normlift_ns.io.arrays import FLOAT32_MAX, check_array, load_arrays
from normlift_ns.io.run_dir import LIFT_AGAIN, check_digests, read_manifest

FIELD_FILE, EVIDENCE_FILE = "field.safetensors", "evidence.safetensors"
EVIDENCE_FORMAT = "normlift_ns.evidence/1"
EVIDENCE_COUNTS = ("num_views", "weight_power", "num_excluded")
SCALAR_NAMES = ("norm", "c_intra", "c_inter", "n_eff", "reliability", "weight", "view_count")
"""Names of the scalars per Gaussian, as in `core.lift.Scalars`."""
_MAX_VIEWS = 2**24


class RowArrays(NamedTuple):
    """A sparse matrix in CSR layout, as in `core.sparse.SparseRows`."""

    offsets: Int64[np.ndarray, " rows_plus_1"]
    column: Int32[np.ndarray, " nnz"]
    weight: Float[np.ndarray, " nnz"]

    def check(self, name: str, num_columns: int) -> None:
        """Raise if the arrays are not a valid weight matrix with `num_columns` columns.

        Args:
            name: Name of the matrix, for the error message.
            num_columns: Number of columns of the matrix.
        Raises:
            ValueError: An array has the wrong type or shape, or the offsets are not valid. Also if a column is out of
                range, or a weight is negative or not finite.
        """
        weight_dtype = "float64" if self.weight.dtype == "float64" else "float32"
        arrays = (("offsets", self.offsets, "int64"), ("columns", self.column, "int32"))
        for part, array, dtype in (*arrays, ("weights", self.weight, weight_dtype)):
            if array.ndim != 1 or array.dtype != dtype:
                raise InputError(f"{name}: {part} are {array.dtype} {array.shape}, expected {dtype} in one dimension")
        ends = [int(self.offsets[0]), int(self.offsets[-1])] if self.offsets.size > 0 else []
        size = self.column.size
        if ends != [0, size] or self.weight.size != size or bool((self.offsets[1:] < self.offsets[:-1]).any()):
            raise InputError(
                f"{name}: offsets must begin with 0, never decrease, and end with the number of entries. The first and "
                f"last are {ends}, for {size} columns and {self.weight.size} weights."
            )
        low, high = (int(self.column.min()), int(self.column.max())) if size > 0 else (0, -1)
        if low < 0 or high >= num_columns:
            raise InputError(f"{name}: columns are in {low}..{high}, expected 0..{num_columns - 1}")
        least, most = (float(self.weight.min()), float(self.weight.max())) if size > 0 else (0.0, 0.0)
        if not 0 <= least <= most < math.inf:
            raise InputError(f"{name}: weights are in {least}..{most}, expected finite values of at least 0")


class EvidenceArrays(NamedTuple):
    """Content of a file that `Evidence.save` wrote."""

    rows: RowArrays
    region_view: Int32[np.ndarray, " s"]
    unlabeled: RowArrays
    counts: tuple[int, int, int]
    """Number of views, exponent of the weights A_ij in the evidence, and number of Gaussians that were not rendered."""
    digest: str | None
    """Digest of the content; None for files of version 0.1."""


class FieldArrays(NamedTuple):
    """Content of the files that `SemanticField.save` wrote."""

    manifest: dict[str, Any]
    arrays: dict[str, np.ndarray]
    """Arrays by name: `source`, the scalars, `means` (since version 0.2), and `null_level` if the lift computed it.

    Fields that store evidence have `features`. All others have `coordinates`, and low-rank fields have `basis` as well.
    """
    evidence: EvidenceArrays | None
    """Evidence for storage "evidence"; None for the other storage forms."""
    digested_files: frozenset[str]
    """Files that have a digest in the manifest, as paths relative to the folder of the manifest."""


def read_evidence(path: Path, *, key: str = "", remedy: str = "rasterize again") -> EvidenceArrays:
    """Read and check a file that `Evidence.save` wrote.

    Args:
        key: Key that the file was saved with. If a key is given, files without a digest (version 0.1) are invalid.
        remedy: Advice in the error message if the file is missing or damaged.
    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: The file is damaged or not an evidence file.
    """
    legacy_keys = None if key else ("format", *EVIDENCE_COUNTS)
    arrays, metadata, digest = load_arrays(path, key=key, legacy_keys=legacy_keys, remedy=remedy)
    if metadata.get("format") != EVIDENCE_FORMAT:
        raise InputError(
            f"{path} has format {metadata.get('format')!r}, expected an evidence file of format {EVIDENCE_FORMAT!r}; "
            "create it again with this version"
        )
    try:
        rows = RowArrays(*(arrays[name] for name in ("offsets", "region", "weight")))
        unlabeled = RowArrays(*(arrays[f"unlabeled_{name}"] for name in ("offsets", "column", "weight")))
        region_view = arrays["region_view"]
        views, power, excluded = (int(metadata[name]) for name in EVIDENCE_COUNTS)
        rows.check("region weights", region_view.size)
        if not (0 <= views <= _MAX_VIEWS and power in (0, 1, 2) and 0 <= excluded <= len(rows.offsets) - 1):
            counts = ", ".join(map(str, (views, power, excluded)))
            raise InputError(f"at least one of {', '.join(EVIDENCE_COUNTS)} is out of range: {counts[:50]}")
        unlabeled.check("weights of unlabeled pixels", views)
        if len(unlabeled.offsets) != len(rows.offsets):
            raise InputError(
                f"region weights are for {len(rows.offsets) - 1} Gaussians, but weights of unlabeled pixels are for "
                f"{len(unlabeled.offsets) - 1}"
            )
        last = views - 1 if region_view.size > 0 else 0
        check_array("region_view", region_view, "int32", (region_view.size,), 0, last)
        if bool((region_view[1:] < region_view[:-1]).any()):
            raise InputError(f"values of region_view decrease, expected non-decreasing values in 0..{views - 1}")
        return EvidenceArrays(rows, region_view, unlabeled, (views, power, excluded), digest)
    except (KeyError, ValueError) as error:
        raise InputError(f"{path} is damaged ({error}); {remedy}") from error


def read_field(folder: Path) -> FieldArrays:
    """Read the files that `SemanticField.save` wrote, and check their digests.

    Raises:
        FileNotFoundError: The folder has no complete field.
        ValueError: The schema version is unknown, or a file is damaged. The message gives its path.
    """
    manifest, digests = read_manifest(folder)
    try:
        arrays, _, digest = load_arrays(folder / FIELD_FILE, legacy_keys=(), remedy=LIFT_AGAIN)
        actual, evidence = {FIELD_FILE: digest}, None
        if manifest["form"] == "evidence":
            evidence = read_evidence(folder / EVIDENCE_FILE, remedy=LIFT_AGAIN)
            actual[EVIDENCE_FILE] = evidence.digest
        check_digests(folder, actual, digests)
        _check_field(folder / FIELD_FILE, arrays, manifest, evidence)
    except KeyError as error:
        raise InputError(f"the semantic field in {folder} is damaged: {error} is missing; {LIFT_AGAIN}") from error
    return FieldArrays(manifest, arrays, evidence, frozenset(digests or ()))


def _check_field(
    path: Path, arrays: Mapping[str, np.ndarray], manifest: Mapping[str, Any], evidence: EvidenceArrays | None
) -> None:
    n, dimension = int(manifest["num_gaussians"]), int(manifest["dimension"])
    try:
        check_array("source", arrays["source"], "int32", (n,), 0, n - 1)
        if "means" in arrays:  # Gaussians that are never rendered may have means that are not finite
            check_array("means", np.nan_to_num(arrays["means"]), "float32", (n, 3), -FLOAT32_MAX)
        for name in SCALAR_NAMES:
            check_array(name, arrays[name], "int32" if name == "view_count" else "float32", (n,), 0)
        if "null_level" in arrays:
            check_array("null_level", arrays["null_level"], "float32", (n,), -1.001, 1.001)
        if evidence is not None:
            check_array("features", arrays["features"], "float32", (len(evidence.region_view), dimension), -FLOAT32_MAX)
            if ((arrays["norm"] > 0) & (arrays["weight"] == 0)).any():
                raise InputError("some Gaussians have weight 0 and a norm above 0, expected norm 0 for weight 0")
            if len(evidence.rows.offsets) - 1 != n:
                raise InputError(f"{EVIDENCE_FILE} has {len(evidence.rows.offsets) - 1} Gaussians, expected {n}")
            return
        rank = dimension
        if manifest["form"] == "low_rank":
            rank = len(arrays["basis"])
            check_array("basis", arrays["basis"], "float32", (rank, dimension), -FLOAT32_MAX)
        rows = int((arrays["norm"] > 0).sum())
        check_array("coordinates", arrays["coordinates"], "float16", (rows, rank), -FLOAT32_MAX)
    except ValueError as error:
        raise InputError(f"{path} is damaged: {error}; {LIFT_AGAIN}") from error
