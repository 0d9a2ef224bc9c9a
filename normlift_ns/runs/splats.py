"""Gaussians as PLY files in the layout that splat tools read, with their semantics as further properties."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Int64
from torch import Tensor

from normlift_ns.asking import Answer
from normlift_ns.core.field import SemanticField
from normlift_ns.core.files import new_files
from normlift_ns.core.query import strongest
from normlift_ns.errors import InputError
from normlift_ns.options import RasterizeMode

LEAST_OPACITY = -5.5373
"""logit(1 / 255): what is fainter is never drawn, and ns-export leaves it out."""
_COMMENT_LENGTH = 60
_CONSTANT_HARMONIC = 0.28209479177387814
"""sqrt(1 / (4 pi)), the spherical harmonic of degree 0."""


def splat_columns(parameters: Mapping[str, Tensor], *, spherical_harmonics: bool) -> dict[str, np.ndarray]:
    """The properties that `ns-export gaussian-splat` writes, in its order: raw parameters, logits and logarithms.

    Args:
        parameters: gauss_params of splatfacto by name.
        spherical_harmonics: False where colours do not depend on the view (sh_degree 0): they are logits then.
    """
    values = {name: value.detach().float().cpu() for name, value in parameters.items()}
    means, rest = values["means"], values["features_rest"]
    constant = (
        values["features_dc"]
        if spherical_harmonics
        else (torch.sigmoid(values["features_dc"]) - 0.5) / _CONSTANT_HARMONIC
    )
    columns = {name: means[:, i] for i, name in enumerate("xyz")}
    columns |= {name: torch.zeros_like(means[:, 0]) for name in ("nx", "ny", "nz")}
    columns |= {f"f_dc_{i}": constant[:, i] for i in range(3)}
    if spherical_harmonics:
        by_channel = rest.transpose(1, 2).reshape(len(rest), -1)  # all of red, then green, then blue
        columns |= {f"f_rest_{i}": by_channel[:, i] for i in range(by_channel.shape[1])}
    columns["opacity"] = values["opacities"][:, 0]
    columns |= {f"scale_{i}": values["scales"][:, i] for i in range(3)}
    columns |= {f"rot_{i}": values["quats"][:, i] for i in range(4)}
    return {name: value.numpy() for name, value in columns.items()}


def semantic_columns(field: SemanticField, answer: Answer | None) -> dict[str, np.ndarray]:
    """reliability, n_eff, relevancy_0, … and label, the selected prompt of largest relevancy or -1."""
    columns = {"reliability": field.scalars.reliability, "n_eff": field.scalars.n_eff}
    if answer is not None:
        columns |= {f"relevancy_{q}": answer.relevancy[:, q].float() for q in range(len(answer.texts))}
        columns["label"] = strongest(answer.relevancy, answer.selected)
    return {name: value.cpu().numpy() for name, value in columns.items()}


def exported_rows(columns: Mapping[str, np.ndarray], keep: Bool[Tensor, " n"]) -> Int64[np.ndarray, " m"]:
    """Indices of the kept Gaussians that ns-export would write: all parameters finite, opacity at least 1/255."""
    finite = np.all([np.isfinite(column) for column in columns.values()], axis=0)
    return np.flatnonzero(finite & (columns["opacity"] >= LEAST_OPACITY) & keep.cpu().numpy())


def write_splats(
    path: Path,
    parameters: Mapping[str, Tensor],
    field: SemanticField,
    answer: Answer | None,
    *,
    keep: Bool[Tensor, " n"],
    spherical_harmonics: bool,
    rasterize_mode: RasterizeMode,
    objects: Mapping[str, Any] | None = None,
    overwrite: bool = False,
) -> Int64[np.ndarray, " m"]:
    """Writes path (PLY) and, beside it, the row of every vertex in the scene as <stem>_rows.npy; returns those rows.

    Args:
        parameters, spherical_harmonics: as in `splat_columns`.
        rasterize_mode: how the scene was rasterized in its training; other tools take it for classic unless the file
            says otherwise.
        keep: the Gaussians wanted; of them those of `exported_rows` are written.
        objects: a table for <stem>_objects.json; None: no table, and `overwrite` removes that of an earlier export.
        overwrite: replace files of these names.
    Raises:
        FileExistsError: there are such, and `overwrite` is False.
        ValueError: none of the Gaussians can be written; objects that JSON cannot hold.
        OSError: the disk is full, or the like.
    """
    from plyfile import PlyData, PlyElement  # noqa: PLC0415 (import-light: every ns-* command loads this module)

    columns = splat_columns(parameters, spherical_harmonics=spherical_harmonics)
    rows = exported_rows(columns, keep)
    if len(rows) == 0:
        if not bool(keep.any()):
            raise InputError(f"{path} is not written: no Gaussian is selected")
        raise InputError(f"{path} is not written: none of the {int(keep.sum()):,} Gaussians wanted is ever drawn")
    columns |= semantic_columns(field, answer)
    table = np.empty(len(rows), [(name, "<i4" if name == "label" else "<f4") for name in columns])
    for name, column in columns.items():
        table[name] = column[rows]
    texts = () if answer is None else answer.texts
    comments = ["Written by normlift_ns", "Vertical Axis: z"]
    if rasterize_mode == "antialiased":
        comments.append("SplatRenderMode: mip")
    comments += [f"relevancy_{q}: {_comment(text)}" for q, text in enumerate(texts)]
    try:
        table_of_objects = json.dumps(objects, indent=2, allow_nan=False) + "\n"
    except (TypeError, ValueError, RecursionError) as error:
        raise InputError(f"objects must hold what JSON can say: {error}") from None
    files = export_files(path)
    written, gone = (files, ()) if objects is not None else (files[:2], files[2:])
    with new_files(*written, overwrite=overwrite, remove=gone if overwrite else ()) as drafts:
        with drafts[0].open("wb") as file:
            PlyData([PlyElement.describe(table, "vertex")], byte_order="<", comments=comments).write(file)
        np.save(drafts[1], rows)
        if objects is not None:
            drafts[2].write_text(table_of_objects, "utf8")
    return rows


def export_files(path: Path) -> tuple[Path, Path, Path]:
    """The PLY file of an export, and what belongs to it: rows, and the table of objects.

    >>> [file.name for file in export_files(Path("fox.ply"))]
    ['fox.ply', 'fox_rows.npy', 'fox_objects.json']
    """
    return path, path.with_name(f"{path.stem}_rows.npy"), path.with_name(f"{path.stem}_objects.json")


def _comment(text: str) -> str:
    """One line of ASCII, as the header of a PLY file wants it."""
    return " ".join(text.encode("ascii", "replace").decode().split())[:_COMMENT_LENGTH]
