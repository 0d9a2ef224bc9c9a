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
from normlift_ns.errors import InputError
from normlift_ns.objects.instances import Instances, find_instances
from normlift_ns.options import MIN_SIZE, REACH, RasterizeMode

LEAST_OPACITY = -5.5373
"""logit(1 / 255): what is fainter is never drawn, and ns-export leaves it out."""
INSTANCES = ("class_id", "instance_id")
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


def semantic_columns(field: SemanticField, answer: Answer | None, instances: Instances | None) -> dict[str, np.ndarray]:
    """reliability, n_eff, relevancy_0, … as float32, class_id and instance_id as uint32.

    Numbers of classes have no sign: the converters of splats turn -1 into 4294967295.
    """
    columns = {"reliability": field.scalars.reliability, "n_eff": field.scalars.n_eff}
    if answer is not None:
        columns |= {f"relevancy_{q}": answer.relevancy[:, q] for q in range(len(answer.texts))}
    found = {name: value.float().cpu().numpy() for name, value in columns.items()}
    if instances is not None:
        found |= {name: getattr(instances, name).cpu().numpy().astype(np.uint32) for name in INSTANCES}
    return found


def instances_of(answer: Answer, *, reach: float = REACH, min_size: int = MIN_SIZE) -> Instances:
    """Class and object of every Gaussian, see `find_instances`."""
    how = {"reach": reach, "min_size": min_size}
    return find_instances(answer.texts, answer.means, answer.relevancy, answer.selected, **how)


def exported_rows(columns: Mapping[str, np.ndarray], keep: Bool[Tensor, " n"]) -> Int64[np.ndarray, " m"]:
    """Indices of the kept Gaussians that ns-export would write: all parameters finite, opacity at least 1/255."""
    finite = np.all([np.isfinite(column) for column in columns.values()], axis=0)
    return np.flatnonzero(finite & (columns["opacity"] >= LEAST_OPACITY) & keep.cpu().numpy())


def drawn_rows(parameters: Mapping[str, Tensor], *, spherical_harmonics: bool) -> Int64[np.ndarray, " m"]:
    """Indices of the Gaussians that ns-export would write."""
    columns = splat_columns(parameters, spherical_harmonics=spherical_harmonics)
    return exported_rows(columns, torch.ones(len(columns["x"]), dtype=torch.bool))


def write_splats(
    path: Path,
    parameters: Mapping[str, Tensor],
    field: SemanticField,
    answer: Answer | None,
    *,
    keep: Bool[Tensor, " n"],
    spherical_harmonics: bool,
    rasterize_mode: RasterizeMode,
    instances: Instances | None = None,
    objects: Mapping[str, Any] | None = None,
    overwrite: bool = False,
) -> Int64[np.ndarray, " m"]:
    """Writes path (PLY) and, beside it, the row of every vertex in the scene as <stem>_rows.npy; returns those rows.

    With an answer, what the numbers of its classes and objects mean goes to <stem>_names.json.

    Args:
        parameters, spherical_harmonics: as in `splat_columns`.
        rasterize_mode: how the scene was rasterized in its training; other tools take it for classic unless the file
            says otherwise.
        keep: the Gaussians wanted; of them those of `exported_rows` are written.
        instances: classes and objects of the answer; None: as `instances_of` finds them.
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
    if answer is not None and instances is None:
        instances = instances_of(answer)
    columns |= semantic_columns(field, answer, instances)
    table = np.empty(len(rows), [(name, "<u4" if name in INSTANCES else "<f4") for name in columns])
    for name, column in columns.items():
        table[name] = column[rows]
    texts = () if answer is None else answer.texts
    comments = ["Written by normlift_ns", "Vertical Axis: z"]
    if rasterize_mode == "antialiased":
        comments.append("SplatRenderMode: mip")
    comments += [f"relevancy_{q}: {_comment(text)}" for q, text in enumerate(texts)]
    beside = {"names": None if instances is None else instances.to_json(), "objects": objects}
    try:
        documents = [None if x is None else json.dumps(x, indent=2, allow_nan=False) + "\n" for x in beside.values()]
    except (TypeError, ValueError, RecursionError) as error:
        raise InputError(f"objects must hold what JSON can say: {error}") from None
    ply, numbers, *others = export_files(path)
    written = [file for file, text in zip(others, documents) if text is not None]
    gone = [file for file in others if file not in written]
    with new_files(ply, numbers, *written, overwrite=overwrite, remove=gone if overwrite else ()) as drafts:
        with drafts[0].open("wb") as file:
            PlyData([PlyElement.describe(table, "vertex")], byte_order="<", comments=comments).write(file)
        np.save(drafts[1], rows)
        for draft, text in zip(drafts[2:], (text for text in documents if text is not None)):
            draft.write_text(text, "utf8")
    return rows


def export_files(path: Path) -> tuple[Path, Path, Path, Path]:
    """The PLY file of an export, and what belongs to it: rows, names of classes and objects, and the table of objects.

    >>> [file.name for file in export_files(Path("fox.ply"))]
    ['fox.ply', 'fox_rows.npy', 'fox_names.json', 'fox_objects.json']
    """
    rows, names, objects = (path.with_name(f"{path.stem}_{end}") for end in ("rows.npy", "names.json", "objects.json"))
    return path, rows, names, objects


def _comment(text: str) -> str:
    """One line of ASCII, as the header of a PLY file wants it."""
    return " ".join(text.encode("ascii", "replace").decode().split())[:_COMMENT_LENGTH]
