"""Export of Gaussians as PLY files in the layout of splat tools, with semantics as additional vertex properties."""

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
"""logit(1 / 255): Gaussians with a lower opacity are never rendered, and ns-export leaves them out."""
INSTANCES = ("class_id", "instance_id")
_MAX_COMMENT_LENGTH = 60
_SH_C0 = 0.28209479177387814
"""sqrt(1 / (4 pi)), the spherical harmonic of degree 0."""


def splat_columns(parameters: Mapping[str, Tensor], *, spherical_harmonics: bool) -> dict[str, np.ndarray]:
    """Return the vertex properties of `ns-export gaussian-splat`, in its order.

    Opacities are logits and scales are logarithms, as splatfacto stores them.

    Args:
        parameters: gauss_params of splatfacto by name.
        spherical_harmonics: False if colors do not depend on the view (sh_degree 0) and are stored as logits.
    """
    values = {name: value.detach().float().cpu() for name, value in parameters.items()}
    means, rest = values["means"], values["features_rest"]
    constant = values["features_dc"] if spherical_harmonics else (torch.sigmoid(values["features_dc"]) - 0.5) / _SH_C0
    columns = {name: means[:, i] for i, name in enumerate("xyz")}
    columns |= {name: torch.zeros_like(means[:, 0]) for name in ("nx", "ny", "nz")}
    columns |= {f"f_dc_{i}": constant[:, i] for i in range(3)}
    if spherical_harmonics:
        by_channel = rest.transpose(1, 2).reshape(len(rest), -1)  # all red coefficients, then green, then blue
        columns |= {f"f_rest_{i}": by_channel[:, i] for i in range(by_channel.shape[1])}
    columns["opacity"] = values["opacities"][:, 0]
    columns |= {f"scale_{i}": values["scales"][:, i] for i in range(3)}
    columns |= {f"rot_{i}": values["quats"][:, i] for i in range(4)}
    return {name: value.numpy() for name, value in columns.items()}


def semantic_columns(field: SemanticField, answer: Answer | None, instances: Instances | None) -> dict[str, np.ndarray]:
    """Return reliability, n_eff, relevancy_0, … as float32, and class_id and instance_id as uint32.

    Ids are unsigned because splat converters turn -1 into 4294967295.
    """
    scores = {"reliability": field.scalars.reliability, "n_eff": field.scalars.n_eff}
    if answer is not None:
        scores |= {f"relevancy_{q}": answer.relevancy[:, q] for q in range(len(answer.texts))}
    columns = {name: value.float().cpu().numpy() for name, value in scores.items()}
    if instances is not None:
        columns |= {name: getattr(instances, name).cpu().numpy().astype(np.uint32) for name in INSTANCES}
    return columns


def instances_of(answer: Answer, *, reach: float = REACH, min_size: int = MIN_SIZE) -> Instances:
    """Return class and object of every Gaussian; see `find_instances`."""
    return find_instances(answer.texts, answer.means, answer.relevancy, answer.selected, reach=reach, min_size=min_size)


def exported_rows(columns: Mapping[str, np.ndarray], keep: Bool[Tensor, " n"]) -> Int64[np.ndarray, " m"]:
    """Return indices of the kept Gaussians that ns-export would write: parameters finite, opacity at least 1/255."""
    finite = np.all([np.isfinite(column) for column in columns.values()], axis=0)
    return np.flatnonzero(finite & (columns["opacity"] >= LEAST_OPACITY) & keep.cpu().numpy())


def drawn_rows(parameters: Mapping[str, Tensor], *, spherical_harmonics: bool) -> Int64[np.ndarray, " m"]:
    """Return indices of the Gaussians that ns-export would write."""
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
    """Write a PLY file and, next to it, the scene index of every vertex as <stem>_rows.npy.

    With an answer, also write the names of its classes and objects as <stem>_names.json.

    Args:
        path: path of the PLY file.
        parameters, spherical_harmonics: as in `splat_columns`.
        rasterize_mode: mode that the scene was trained with. The file records "antialiased", because other tools
            assume "classic" by default.
        keep: Gaussians to write; those that ns-export would leave out are skipped, see `exported_rows`.
        instances: classes and objects of the answer (default: those of `instances_of`).
        objects: content of <stem>_objects.json. None: no such file, and `overwrite` removes that of an earlier export.
        overwrite: replace existing files.
    Returns:
        The scene indices.
    Raises:
        FileExistsError: a file exists, and `overwrite` is False.
        ValueError: there is no Gaussian to write, or `objects` cannot be encoded as JSON.
        OSError: a file cannot be written, for instance because the disk is full.
    """
    from plyfile import PlyData, PlyElement  # noqa: PLC0415 (every ns-* command imports this module)

    columns = splat_columns(parameters, spherical_harmonics=spherical_harmonics)
    rows = exported_rows(columns, keep)
    if len(rows) == 0:
        if not bool(keep.any()):
            raise InputError(f"{path} is not written: no Gaussian is selected")
        raise InputError(
            f"{path} is not written: all {int(keep.sum()):,} selected Gaussians are invisible (opacity below 1/255, or "
            "parameters that are not finite)"
        )
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
    ply, indices, *json_files = export_files(path)
    contents = (None if instances is None else instances.to_json(), objects)
    try:
        documents = {
            file: json.dumps(content, indent=2, allow_nan=False) + "\n"
            for file, content in zip(json_files, contents)
            if content is not None
        }
    except (TypeError, ValueError, RecursionError) as error:
        raise InputError(f"objects cannot be encoded as JSON: {error}") from None
    stale = [file for file in json_files if file not in documents] if overwrite else []
    with new_files(ply, indices, *documents, overwrite=overwrite, remove=stale) as drafts:
        with drafts[0].open("wb") as file:
            PlyData([PlyElement.describe(table, "vertex")], byte_order="<", comments=comments).write(file)
        np.save(drafts[1], rows)
        for draft, text in zip(drafts[2:], documents.values()):
            draft.write_text(text, "utf8")
    return rows


def export_files(path: Path) -> tuple[Path, Path, Path, Path]:
    """Return the paths of an export: PLY file, scene indices, names of classes and objects, and table of objects.

    >>> [file.name for file in export_files(Path("fox.ply"))]
    ['fox.ply', 'fox_rows.npy', 'fox_names.json', 'fox_objects.json']
    """
    rows, names, objects = (path.with_name(f"{path.stem}_{end}") for end in ("rows.npy", "names.json", "objects.json"))
    return path, rows, names, objects


def _comment(text: str) -> str:
    """Return the text as a single line of ASCII, as the header of a PLY file requires."""
    return " ".join(text.encode("ascii", "replace").decode().split())[:_MAX_COMMENT_LENGTH]
