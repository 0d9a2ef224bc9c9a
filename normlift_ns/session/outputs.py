"""Files of a selection, and storage of prompts in a run."""

from __future__ import annotations

import io
import tempfile
import zipfile
from pathlib import Path

from jaxtyping import Bool
from torch import Tensor

from normlift_ns.core.field import SemanticField
from normlift_ns.core.scene import Scene
from normlift_ns.errors import InputError
from normlift_ns.exports import EXPORTERS, ExportJob, SplatLabels, TrainedSplat, write_splat
from normlift_ns.io.atomic import safe_file_name
from normlift_ns.query.question import Query, load_query, save_query
from normlift_ns.rasterization.settings import RasterSettings
from normlift_ns.rendering.figures import write_masks
from normlift_ns.session.prompts import merge_queries
from normlift_ns.session.state import State


def store_query(folder: Path | None, query: Query | None, *, replaces: bool = False) -> str:
    """Store prompts in a run, and return the number of stored prompts as text, such as "2 prompts".

    Args:
        folder: Folder of the field; None if the run is not stored yet.
        replaces: True to delete the prompts that the run already stores, False to keep them.
    Raises:
        ValueError: The query or the folder is None, or `merge_queries` cannot merge the queries.
    """
    if query is None:
        raise InputError("This session has no query, so it has no prompts to save. Type a prompt and press Ask.")
    if folder is None:
        raise InputError("The run is not stored yet, so it cannot store prompts. Save the prompts after training.")
    merged = merge_queries(None if replaces else load_query(folder), query)
    save_query(folder, merged)
    return "one prompt" if len(merged.texts) == 1 else f"{len(merged.texts)} prompts"


def splat_bytes(splat: TrainedSplat, state: State, mask: Bool[Tensor, " n"], name: str) -> tuple[str, bytes, int]:
    """Return the name and content of a PLY file of the Gaussians in `mask`, and the number of Gaussians in the file.

    Raises:
        ValueError: The mask has no Gaussian that a renderer draws.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"{safe_file_name(name)}.ply"
        rows = write_splat(path, splat, SplatLabels(state.space.field, state.answer), keep=mask).rows
        return path.name, path.read_bytes(), len(rows)


def selection_bytes(
    scene: Scene, field: SemanticField, state: State, mask: Bool[Tensor, " n"], name: str, kind: str = "ply"
) -> tuple[str, bytes]:
    """Return the name and content of a file of the Gaussians in `mask`, or of their image masks.

    Args:
        name: Name of the selection.
        kind: Name of an exporter that writes one file, or "masks" for a ZIP file with a mask for each training image.
    Raises:
        ValueError: The mask has no Gaussian that a renderer draws, or no exporter of this name writes a single file of
            Gaussians.
    """
    if not bool(mask.any()):
        raise InputError("Nothing is selected, so there is nothing to export.")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / safe_file_name(name)
        if kind == "masks":
            settings, buffer = RasterSettings.recorded(field.manifest), io.BytesIO()
            with zipfile.ZipFile(buffer, "w") as archive:
                for file in write_masks(scene, mask, path, settings=settings):
                    archive.write(file, file.relative_to(path))
            return f"{path.name}_masks.zip", buffer.getvalue()
        exporter = EXPORTERS.load(kind)
        if exporter.suffix == "" or kind == "cloud":  # a folder, or a copy of another point cloud
            raise InputError(f"The format {kind} cannot be downloaded. Choose ply or masks.")
        path = path.with_name(path.name + exporter.suffix)
        exporter.write(ExportJob(scene, field, mask, state.answer), path)
        return path.name, path.read_bytes()
