"""Exports of a lifted run: splats as PLY, GLB and SPZ files, masks, label arrays and labeled point clouds."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64
from plyfile import PlyData, PlyElement, PlyParseError
from torch import Tensor

from normlift_ns.analysis.objects import Instances, SimilarityTransform, find_instances
from normlift_ns.core.field import SemanticField
from normlift_ns.core.gaussians import SH_C0
from normlift_ns.core.neighbors import nearest_neighbors
from normlift_ns.core.scene import Scene
from normlift_ns.data.compressed_ply import encode_compressed_ply
from normlift_ns.data.frames import WorldTransform
from normlift_ns.data.gltf import encode_glb
from normlift_ns.data.splat import SplatParameters, check_ply_header, transform_splat
from normlift_ns.data.spz import decode_spz, encode_spz
from normlift_ns.errors import InputError
from normlift_ns.io.atomic import atomic_file, atomic_files
from normlift_ns.options import LABEL_ARRAY_FILES, OBJECT_MAX_GAP, OBJECT_MIN_GAUSSIANS, RasterizeMode
from normlift_ns.query.engine import Answer
from normlift_ns.rasterization.settings import RasterSettings
from normlift_ns.registry import Registry
from normlift_ns.rendering.figures import write_masks

# Gaussians as PLY files in the layout of other splat tools, with semantics as additional vertex properties, and as
# files in other formats.


SplatFormat = Literal["ply", "compressed_ply", "glb", "spz", "spz4"]
"""File format of an exported splat. spz is version 3 of SPZ, and spz4 is version 4, which fewer programs support."""
_FORMATS: dict[str, SplatFormat] = {".compressed.ply": "compressed_ply", ".glb": "glb", ".spz": "spz"}
"""Formats by the ending of a file name. All other endings mean PLY, except those in `_UNWRITTEN`."""
_UNWRITTEN = (".splat", ".sog", ".ksplat", ".gltf")
MIN_OPACITY_LOGIT = -5.5373
"""Logit of the opacity 1/255 as rounded in ns-export, which leaves out Gaussians with a lower opacity."""
INSTANCE_PROPERTIES = ("class_id", "instance_id")
_MAX_COMMENT_LENGTH = 60


def semantic_columns(field: SemanticField, answer: Answer | None, instances: Instances | None) -> dict[str, np.ndarray]:
    """Return columns by name: reliability, n_eff, relevancy_0, … in float32, and class_id and instance_id in uint32.

    Relevancies need an answer, and ids need instances. Ids are unsigned, with 0 for none, because splat converters
    turn -1 into 4294967295.

    Raises:
        ValueError: The answer and the field have different numbers of Gaussians.
    """
    if answer is not None and len(answer.relevancy) != len(field):
        raise InputError(
            f"answer is for {len(answer.relevancy):,} Gaussians, but the run has {len(field):,}; pass an answer from "
            "this run"
        )
    scores = {"reliability": field.scalars.reliability, "n_eff": field.scalars.n_eff}
    if answer is not None:
        scores |= {f"relevancy_{q}": answer.relevancy[:, q] for q in range(len(answer.texts))}
    columns = {name: value.float().cpu().numpy() for name, value in scores.items()}
    if instances is not None:
        columns |= {name: getattr(instances, name).cpu().numpy().astype(np.uint32) for name in INSTANCE_PROPERTIES}
    return columns


def answer_instances(
    answer: Answer, max_gap: float = OBJECT_MAX_GAP, min_gaussians: int = OBJECT_MIN_GAUSSIANS
) -> Instances:
    """Return the class and the object of every Gaussian; see `find_instances`."""
    return find_instances(answer.texts, answer.means, answer.relevancy, answer.selected, max_gap, min_gaussians)


def exportable_rows(columns: Mapping[str, np.ndarray], keep: Bool[Tensor, " n"]) -> Int64[np.ndarray, " m"]:
    """Return the indices of kept Gaussians with finite parameters and an opacity of at least 1/255, as in ns-export."""
    finite = np.all([np.isfinite(column) for column in columns.values()], axis=0)
    return np.flatnonzero(finite & (columns["opacity"] >= MIN_OPACITY_LOGIT) & keep.cpu().numpy())


class TrainedSplat(NamedTuple):
    """Trained Gaussians with their rendering settings."""

    parameters: Mapping[str, Tensor]
    """Parameters as in `Scene.parameters`."""
    spherical_harmonics: bool
    """False if colors do not depend on the view (sh_degree 0) and are stored as logits."""
    rasterize_mode: RasterizeMode
    """Rasterization mode that the scene was trained with."""

    @staticmethod
    def of(scene: Scene) -> TrainedSplat:
        """Return the Gaussians of a scene."""
        return TrainedSplat(scene.parameters, scene.has_harmonics, scene.rasterize_mode)

    def transformed(self, by: SimilarityTransform) -> TrainedSplat:
        """Return the Gaussians after a similarity transform; plain colors become spherical harmonics of degree 0."""
        world = WorldTransform(np.column_stack([by.rotation, by.shift / by.scale]), by.scale)
        return TrainedSplat(transform_splat(self.with_harmonics(), world).parameters, True, self.rasterize_mode)

    def with_harmonics(self) -> SplatParameters:
        """Return the Gaussians on the CPU in float32; plain colors become spherical harmonics of degree 0."""
        values = {name: value.detach().float().cpu() for name, value in self.parameters.items()}
        if not self.spherical_harmonics:
            values["features_dc"] = (torch.sigmoid(values["features_dc"]) - 0.5) / SH_C0
            values["features_rest"] = values["features_rest"][:, :0]
        return SplatParameters(**values)

    def columns(self) -> dict[str, np.ndarray]:
        """Return the vertex properties of `ns-export gaussian-splat`, in its order.

        Opacities are logits and scales are logarithms, as splatfacto stores them. Colors without harmonics become f_dc.
        """
        splat = self.with_harmonics()
        values, rest = splat.parameters, splat.features_rest
        means, colors = splat.means, splat.features_dc
        columns = {name: means[:, i] for i, name in enumerate("xyz")}
        columns |= {name: torch.zeros_like(means[:, 0]) for name in ("nx", "ny", "nz")}
        columns |= {f"f_dc_{i}": colors[:, i] for i in range(3)}
        if self.spherical_harmonics:
            by_channel = rest.transpose(1, 2).reshape(len(rest), -1)  # all red coefficients, then green, then blue
            columns |= {f"f_rest_{i}": by_channel[:, i] for i in range(by_channel.shape[1])}
        columns["opacity"] = values["opacities"][:, 0]
        columns |= {f"scale_{i}": values["scales"][:, i] for i in range(3)}
        columns |= {f"rot_{i}": values["quats"][:, i] for i in range(4)}
        return {name: value.numpy() for name, value in columns.items()}


class SplatLabels(NamedTuple):
    """Semantics of all Gaussians. A file contains the properties that its format supports."""

    field: SemanticField
    answer: Answer | None = None
    instances: Instances | None = None
    """Classes and objects of the answer (default: those of `answer_instances`)."""
    objects: Mapping[str, Any] | None = None
    """Content of <stem>_objects.json. If None, no such file is written, and `overwrite` removes an earlier one."""


class WrittenSplat(NamedTuple):
    """Summary of an exported splat."""

    rows: Int64[np.ndarray, " m"]
    """Scene indices of the written Gaussians, in the order of the file."""
    remarks: tuple[str, ...]
    """Messages about rounding errors."""


def write_splat(
    path: Path,
    splat: TrainedSplat,
    labels: SplatLabels,
    *,
    keep: Bool[Tensor, " n"],
    file_format: SplatFormat | None = None,
    overwrite: bool = False,
) -> WrittenSplat:
    """Write a splat, and next to it <stem>_rows.npy with the scene indices of its Gaussians, in the order of the file.

    With an answer or instances, also write the names of classes and objects to <stem>_names.json. With
    `labels.objects`, also write this table to <stem>_objects.json. If a JSON file is not written, `overwrite` deletes
    that of an earlier export. Uncompressed PLY files and GLB files contain reliabilities, relevancies and labels; the
    other formats have no columns for them.

    Args:
        path: Path of the file.
        splat: The Gaussians. GLB files record the rasterization mode. Other files record it only if it is
            "antialiased", because other tools assume "classic" by default.
        keep: Mask of the Gaussians to write. Those that `exportable_rows` leaves out are skipped.
        file_format: Format of the file. If None, the ending of the file name selects it; see `_FORMATS`.
        overwrite: Replace existing files.
    Raises:
        FileExistsError: A file exists, and `overwrite` is False.
        ValueError: No Gaussian is left to write, or the file name has the ending of an unsupported format. Also if
            `labels.objects` cannot be encoded as JSON, or a Gaussian is too far from the origin for SPZ.
        OSError: A file cannot be written, for instance because the disk is full.
    """
    columns = splat.columns()
    rows = exportable_rows(columns, keep)
    if len(rows) == 0:
        raise InputError(f"{path} is not written because {_reason_for_no_rows(int(keep.sum()))}")
    if labels.answer is not None and labels.instances is None:
        labels = labels._replace(instances=answer_instances(labels.answer))
    kind = file_format or _named_format(path)
    if kind == "ply":
        content, remarks = _to_ply(columns, rows, splat.rasterize_mode, labels), ()
    else:
        content, order, remarks = _encode(path.name, kind, splat, labels, rows)
        rows = rows[order]
    file, indices, names_file, objects_file = export_paths(path)
    contents = {
        names_file: None if labels.instances is None else labels.instances.to_json(),
        objects_file: labels.objects,
    }
    documents = {file: _to_json(content) for file, content in contents.items() if content is not None}
    stale = [file for file in contents if file not in documents] if overwrite else []
    with atomic_files(file, indices, *documents, overwrite=overwrite, delete=stale) as drafts:
        if isinstance(content, PlyData):
            with drafts[0].open("wb") as draft:
                content.write(draft)
        else:
            drafts[0].write_bytes(content)
        np.save(drafts[1], rows)
        for draft, text in zip(drafts[2:], documents.values()):
            draft.write_text(text, "utf8")
    return WrittenSplat(rows, remarks)


def _reason_for_no_rows(selected: int) -> str:
    """Return the reason why no Gaussian of a selection, which may be the whole scene, can be written, with advice."""
    if selected == 0:
        return "it would contain no Gaussian; change the selection"
    subject = "the only Gaussian to write is" if selected == 1 else f"all {selected:,} Gaussians to write are"
    return f"{subject} invisible (opacity below 1/255, or parameters that are not finite); select visible Gaussians"


def _named_format(path: Path) -> SplatFormat:
    if path.suffix.lower() in _UNWRITTEN:
        raise InputError(f"{path} is not written: give a name with one of the endings .ply, {', '.join(_FORMATS)}")
    for end, kind in _FORMATS.items():
        if path.name.lower().endswith(end):
            return kind
    return "ply"


def _to_ply(
    columns: Mapping[str, np.ndarray], rows: Int64[np.ndarray, " m"], mode: RasterizeMode, labels: SplatLabels
) -> PlyData:
    columns = {**columns, **semantic_columns(labels.field, labels.answer, labels.instances)}
    types = [(name, column.dtype.newbyteorder("<")) for name, column in columns.items()]
    vertices = np.rec.fromarrays([column[rows] for column in columns.values()], dtype=types)
    comments = _comments(mode, () if labels.answer is None else labels.answer.texts)
    return PlyData([PlyElement.describe(vertices, "vertex")], byte_order="<", comments=comments)


def _encode(
    name: str, kind: SplatFormat, splat: TrainedSplat, labels: SplatLabels, rows: Int64[np.ndarray, " m"]
) -> tuple[bytes, Int64[np.ndarray, " m"] | slice, tuple[str, ...]]:
    """Return the bytes of a file, the order in which it contains `rows`, and messages about rounding errors."""
    values = {key: value[torch.from_numpy(rows)] for key, value in splat.with_harmonics().parameters.items()}
    visible = SplatParameters(**values)
    if kind == "compressed_ply":
        comments = tuple(_comments(splat.rasterize_mode, ()))
        data, order, rounding = encode_compressed_ply(values, name, comments)
        return data, order, (rounding,)
    if kind == "glb":
        columns = semantic_columns(labels.field, labels.answer, labels.instances)
        extras = {} if labels.instances is None else labels.instances.to_json()
        extras |= {"rasterize_mode": splat.rasterize_mode}
        attributes = {f"_{key.upper()}": column[rows] for key, column in columns.items()}
        return encode_glb(visible, attributes, extras), slice(None), ()
    data = encode_spz(visible, antialiased=splat.rasterize_mode == "antialiased", version=4 if kind == "spz4" else 3)
    return data, slice(None), decode_spz(data, Path(name)).remarks


def _comments(rasterize_mode: RasterizeMode, texts: Sequence[str]) -> list[str]:
    mode = ["SplatRenderMode: mip"] if rasterize_mode == "antialiased" else []
    prompts = [f"relevancy_{q}: {_comment(text)}" for q, text in enumerate(texts)]
    return ["Written by normlift_ns", "Vertical Axis: z", *mode, *prompts]


def _to_json(content: Any) -> str:
    try:
        return json.dumps(content, indent=2, allow_nan=False) + "\n"
    except (TypeError, ValueError, RecursionError) as error:
        raise InputError(f"objects cannot be encoded as JSON ({error}); pass JSON types only") from None


def export_paths(path: Path) -> tuple[Path, Path, Path, Path]:
    """Return the paths of an export: the splat, its scene indices, names of classes and objects, and object table.

    >>> [file.name for file in export_paths(Path("fox.ply"))]
    ['fox.ply', 'fox_rows.npy', 'fox_names.json', 'fox_objects.json']
    """
    rows, names, objects = (path.with_name(f"{path.stem}_{end}") for end in ("rows.npy", "names.json", "objects.json"))
    return path, rows, names, objects


def _comment(text: str) -> str:
    """Return the text as one line of at most 60 ASCII characters; a line of a PLY header must be ASCII."""
    return " ".join(text.encode("ascii", "replace").decode().split())[:_MAX_COMMENT_LENGTH]


# Export of labels as NPY arrays, in the layout of Pointcept and of SceneSplat's benchmark.


def _export_arrays(job: ExportJob, folder: Path) -> list[str]:
    """Write coord.npy [M, 3] float32, segment.npy and instance.npy [M] int32, and names.json.

    The files number classes and objects from 0, as class_id - 1 and instance_id - 1. Evaluations ignore -1. If an error
    occurs, no file is written.

    Raises:
        FileExistsError: A file exists, and `overwrite` of the job is False.
        OSError: A file cannot be written.
    """
    instances, files = job.instances, tuple(folder / name for name in LABEL_ARRAY_FILES)
    assert instances is not None
    names = {
        "ignored": -1,
        "segment": {str(i): text for i, text in enumerate(instances.texts)},
        "instance": {str(i): {"segment": class_id - 1} for i, class_id in enumerate(instances.classes)},
    }
    with atomic_files(*files, overwrite=job.overwrite) as drafts:
        means = job.splat.parameters["means"].detach().cpu().numpy()
        np.save(drafts[0], means[job.rows].astype(np.float32))
        for draft, ids in zip(drafts[1:3], (instances.class_id, instances.instance_id)):
            np.save(draft, ids.cpu().numpy()[job.rows].astype(np.int32) - 1)
        drafts[3].write_text(json.dumps(names, indent=2) + "\n", "utf8")
    return [f"Labels in {folder} (number of Gaussians: {len(job.rows):,})"]


class CloudTransfer(NamedTuple):
    """Point cloud to label, with a limit on distances and a transform into the coordinates of the cloud."""

    cloud: PlyData
    max_distance: float
    """Maximum distance from a point to the nearest Gaussian center, in units of the median spacing of the centers."""
    to_cloud: SimilarityTransform | None
    """Transform from the coordinates of the Gaussians to those of the cloud; None if they are the same."""


class LabelTransfer(NamedTuple):
    """Summary of a label transfer."""

    points: int
    share: float
    """Fraction of points that are at most `limit` away from the nearest Gaussian center, in 0..1."""
    limit: float
    """Maximum distance from a point to the nearest Gaussian center, in the coordinates of the cloud."""


def nearest_gaussians(
    points: Float64[np.ndarray, "p 3"], means: Float64[np.ndarray, "n 3"], max_distance: float
) -> tuple[Int64[np.ndarray, " p"], Bool[np.ndarray, " p"]]:
    """Find the Gaussian center that is nearest to each point, with a k-d tree.

    Args:
        means: Centers of at least one Gaussian.
        max_distance: Maximum distance, inclusive.
    Returns:
        The row of the nearest center for each point, and a mask of the points within `max_distance` of that center.

    >>> nearest_gaussians(np.array([[0.0, 0, 1], [0, 0, 9]]), np.array([[0.0, 0, 3], [0, 0, 0]]), max_distance=2.0)
    (array([1, 0]), array([ True, False]))
    """
    from scipy.spatial import KDTree  # noqa: PLC0415 (nothing else here needs it)

    finite = np.asarray(np.isfinite(points).all(axis=1))
    distance, row = (np.asarray(x) for x in KDTree(means).query(np.nan_to_num(points, posinf=0.0, neginf=0.0)))
    has_row = np.isfinite(distance)  # the tree returns no row if the squared distance overflows
    return np.where(has_row, row, 0), finite & (distance <= max_distance)


def read_cloud(path: Path) -> PlyData:
    """Read a PLY file whose vertices have x, y and z.

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: The file is truncated or not a PLY file, has no vertices, or has vertices with list properties or
            without positions.
    """
    expected = "Expected a point cloud or mesh in PLY format whose vertices have x, y and z."
    if not path.is_file():
        problem = "is not a regular file" if path.exists() else "does not exist"
        raise FileNotFoundError(f"{path}, the point cloud to label, {problem}. {expected}")
    check_ply_header(path)
    try:
        cloud = PlyData.read(str(path), mmap="c")
    except (PlyParseError, ValueError, OSError, EOFError, MemoryError, OverflowError) as error:
        raise InputError(f"{path} cannot be read ({' '.join(str(error).split())}). {expected}") from error
    vertex = next((element for element in cloud.elements if element.name == "vertex"), None)
    names = {} if vertex is None else {item.name: item for item in vertex.properties}
    if vertex is None or not set("xyz") <= set(names) or vertex.count == 0:
        count = 0 if vertex is None else vertex.count
        properties = ", ".join(names) or "none"
        raise InputError(
            f"{path} has no points with positions (number of vertices: {count:,}, properties: {properties}). {expected}"
        )
    lists = [name for name, item in names.items() if hasattr(item, "len_dtype")]
    if len(lists) > 0:
        raise InputError(f"{path} has vertices with list properties ({', '.join(lists)}); remove these. {expected}")
    return cloud


def check_no_properties(cloud: PlyData, names: Iterable[str]) -> None:
    """Raise ValueError if the vertices of a cloud already have a property with one of these names."""
    existing = sorted(set(cloud["vertex"].data.dtype.names or ()) & set(names))
    if len(existing) > 0:
        raise InputError(
            f"the vertices of the cloud already have properties with names of labels ({', '.join(existing)}); give a "
            "cloud without such properties"
        )


def vertex_positions(cloud: PlyData) -> Float64[np.ndarray, "p 3"]:
    """Return the positions of the vertices of a cloud."""
    return np.stack([np.asarray(cloud["vertex"][axis], np.float64) for axis in "xyz"], axis=1)


def label_cloud(
    transfer: CloudTransfer, path: Path, means: np.ndarray, columns: dict[str, np.ndarray], *, overwrite: bool = False
) -> LabelTransfer:
    """Write a cloud with the labels of the nearest Gaussians; points that are too far from all Gaussians get zeros.

    Args:
        path: Path of the new PLY file.
        means: Centers [M, 3] of the Gaussians to take labels from, in the coordinates of the scene, float64.
        columns: Labels of these Gaussians, by property name.
    Raises:
        ValueError: `means` is empty or all Gaussians are at one position; also as in `write_cloud`.
        FileExistsError, OSError: As in `write_cloud`.
    """
    if len(means) == 0:
        raise InputError(
            "The cloud cannot be labeled because all Gaussians of the run are invisible (opacity below 1/255, or "
            "parameters that are not finite). Give another run."
        )
    means = means if transfer.to_cloud is None else transfer.to_cloud.transform_points(means)
    spacing = nearest_neighbors(torch.from_numpy(means), 1).spacing
    spacing = spacing[spacing.isfinite()]
    if len(spacing) == 0:
        raise InputError(
            "The cloud cannot be labeled because all visible Gaussians are at one position. Give another run."
        )
    limit = transfer.max_distance * float(spacing.median())
    row, within = nearest_gaussians(vertex_positions(transfer.cloud), means, limit)
    labels = {name: np.where(within, x[row], 0).astype(x.dtype) for name, x in columns.items()}
    write_cloud(path, transfer.cloud, labels, overwrite=overwrite)
    return LabelTransfer(len(within), float(within.mean()), limit)


def write_cloud(path: Path, cloud: PlyData, columns: dict[str, np.ndarray], *, overwrite: bool = False) -> None:
    """Write a cloud as a binary PLY file with additional vertex properties after the existing ones.

    All other values, elements and comments stay unchanged.

    Raises:
        ValueError: The vertices already have a property with one of these names.
        FileExistsError: The file exists, and `overwrite` is False.
        OSError: The file cannot be written.
    """
    check_no_properties(cloud, columns)
    vertex = cloud["vertex"].data
    names = vertex.dtype.names or ()
    types = [(name, vertex.dtype[name].newbyteorder("<")) for name in names]
    types += [(name, column.dtype) for name, column in columns.items()]
    table = np.rec.fromarrays([*(vertex[name] for name in names), *columns.values()], dtype=types)
    elements = [PlyElement.describe(table, "vertex") if e.name == "vertex" else e for e in cloud.elements]
    labeled = PlyData(elements, byte_order="<", comments=cloud.comments, obj_info=cloud.obj_info)
    with atomic_file(path, overwrite=overwrite) as draft, draft.open("wb") as file:
        labeled.write(file)


# Exporters of ns-normlift-export, by kind of output. Other packages register their exporters as entry points.


@dataclass(frozen=True, eq=False)
class ExportJob:
    """Export job: Gaussians of a lifted run, and all data that an exporter may write about them."""

    scene: Scene
    field: SemanticField
    keep: Bool[Tensor, " n"]
    """Mask of the Gaussians to export. Exporters leave out invisible ones; see `rows`."""
    answer: Answer | None = None
    instances: Instances | None = None
    """Classes and objects of the answer; None without an answer."""
    objects: Mapping[str, Any] | None = None
    """Table of the objects of the answer, with JSON types only."""
    rest: bool = False
    """True if `keep` is the rest of the scene, without the selection of the answer."""
    transfer: CloudTransfer | None = None
    overwrite: bool = False
    """Replace existing files."""
    to_capture: SimilarityTransform | None = None
    """Transform from the coordinates of the scene to those of the files; None if they are the same."""

    @property
    def splat(self) -> TrainedSplat:
        """Gaussians of the scene, in the coordinates of the files."""
        splat = TrainedSplat.of(self.scene)
        return splat if self.to_capture is None else splat.transformed(self.to_capture)

    @cached_property
    def rows(self) -> Int64[np.ndarray, " m"]:
        """Indices of the visible Gaussians to export."""
        return exportable_rows(TrainedSplat.of(self.scene).columns(), self.keep)


@dataclass(frozen=True)
class Exporter:
    """Writer of one kind of output, registered as an entry point of the group `normlift_ns.exporters`."""

    write: Callable[[ExportJob, Path], Sequence[str]]
    """Function that writes all files of the output or none, and returns the lines to print about them. It raises
    FileExistsError if a file exists and `overwrite` of the job is False."""
    suffix: str = ""
    """Suffix of the output file, such as ".csv"; empty if the output is a folder."""
    needs_answer: bool = True
    """True if the job must have an answer."""


def transfer_labels(
    scene: Scene, field: SemanticField, answer: Answer, instances: Instances, transfer: CloudTransfer, path: Path,
    *, overwrite: bool = False,
) -> LabelTransfer:  # fmt: skip
    """Write a cloud with the relevancies, class and object of the visible Gaussian nearest to each point."""
    columns = TrainedSplat.of(scene).columns()
    rows = exportable_rows(columns, torch.ones(len(field), dtype=torch.bool))
    means = scene.gaussians.means[torch.from_numpy(rows)].double().cpu().numpy()
    labels = semantic_columns(field, answer, instances)
    labels = {name: x[rows] for name, x in labels.items() if name not in ("reliability", "n_eff")}
    return label_cloud(transfer, path, means, labels, overwrite=overwrite)


def _export_splat(job: ExportJob, path: Path, file_format: SplatFormat | None = None) -> list[str]:
    labels = SplatLabels(job.field, job.answer, job.instances, job.objects)
    how = {"keep": job.keep, "overwrite": job.overwrite}
    written = write_splat(path, job.splat, labels, file_format=file_format, **how)
    return [f"{len(written.rows):,} of {len(job.field):,} Gaussians in {path}", *written.remarks]


def _export_masks(job: ExportJob, folder: Path) -> list[str]:
    assert job.answer is not None
    settings = RasterSettings.recorded(job.field.manifest)
    kwargs = {"invert": job.rest, "settings": settings, "overwrite": job.overwrite}
    count = len(write_masks(job.scene, job.answer.mask, folder, **kwargs))
    lines = [f"{count} mask{'s' * (count != 1)} in {folder}"]
    with suppress(FileNotFoundError, InputError):  # the first image may be missing
        if job.scene.train[0].original is not None:
            lines.append(
                "The masks fit the undistorted images that the scene was trained with, not the original images of the "
                "capture."
            )
    return lines


def _export_cloud(job: ExportJob, path: Path) -> list[str]:
    if job.transfer is None:
        raise InputError("the export has no point cloud to label; give one with --transfer")
    assert job.answer is not None and job.instances is not None
    cloud = (job.transfer, path)
    labeled = transfer_labels(job.scene, job.field, job.answer, job.instances, *cloud, overwrite=job.overwrite)
    points = f"{labeled.points:,} point{'s' * (labeled.points != 1)}"
    return [f"{points} in {path}, {labeled.share:.1%} within {labeled.limit:.3g} of a Gaussian"]


PLY = Exporter(_export_splat, ".ply", needs_answer=False)
COMPRESSED_PLY = Exporter(partial(_export_splat, file_format="compressed_ply"), ".ply", needs_answer=False)
GLB = Exporter(partial(_export_splat, file_format="glb"), ".glb", needs_answer=False)
SPZ = Exporter(partial(_export_splat, file_format="spz"), ".spz", needs_answer=False)
SPZ4 = Exporter(partial(_export_splat, file_format="spz4"), ".spz", needs_answer=False)
MASKS = Exporter(_export_masks)
ARRAYS = Exporter(_export_arrays)
CLOUD = Exporter(_export_cloud, ".ply")
EXPORTERS = Registry(
    "normlift_ns.exporters",
    {name: f"normlift_ns.exports:{name.upper()}" for name in (*get_args(SplatFormat), "masks", "arrays", "cloud")},
    Exporter,
    "exporter",
    "--exporters",
    "ply",
)
"""Exporters by kind of output."""
