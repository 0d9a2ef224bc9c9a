"""Transfer of labels from Gaussians to the points of a point cloud or mesh."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64
from plyfile import PlyData, PlyElement, PlyParseError
from scipy.spatial import KDTree

from normlift_ns.core.files import new_file
from normlift_ns.core.neighbors import nearest_neighbors
from normlift_ns.errors import InputError
from normlift_ns.scenes.formats.ply import check_header


class Nearest(NamedTuple):
    """The nearest Gaussian of every point."""

    row: Int64[np.ndarray, " p"]
    near: Bool[np.ndarray, " p"]
    """Whether that Gaussian is within the maximum distance."""


class Labelled(NamedTuple):
    """Summary of a label transfer."""

    points: int
    share: float
    """Fraction of points with a Gaussian within `limit`, in 0..1."""
    limit: float
    """Maximum distance from a point to its Gaussian, in the coordinates of the cloud."""


def nearest_rows(points: Float64[np.ndarray, "p 3"], means: Float64[np.ndarray, "n 3"], most: float) -> Nearest:
    """Find the Gaussian whose center is nearest to each point, with a k-d tree.

    Args:
        means: centers of at least one Gaussian.
        most: maximum distance, inclusive.

    >>> nearest_rows(np.array([[0.0, 0, 1], [0, 0, 9]]), np.array([[0.0, 0, 3], [0, 0, 0]]), most=2.0)
    Nearest(row=array([1, 0]), near=array([ True, False]))
    """
    finite = np.asarray(np.isfinite(points).all(axis=1))
    distance, row = (np.asarray(x) for x in KDTree(means).query(np.nan_to_num(points, posinf=0.0, neginf=0.0)))
    has_row = np.isfinite(distance)  # the tree returns no row if the squared distance overflows
    return Nearest(np.where(has_row, row, 0), finite & (distance <= most))


def read_cloud(path: Path) -> PlyData:
    """Read a PLY file whose vertices have x, y and z.

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: the file is truncated or not a PLY file, or its vertices have no positions.
    """
    expected = "Expected a point cloud or mesh in PLY format whose vertices have x, y and z."
    if not path.is_file():
        raise FileNotFoundError(f"There is no point cloud at {path}, given with --transfer. {expected}")
    check_header(path)
    try:
        cloud = PlyData.read(str(path), mmap="c")
    except (PlyParseError, ValueError, OSError, EOFError, MemoryError, OverflowError) as error:
        raise InputError(f"{path} cannot be read ({' '.join(str(error).split())}). {expected}") from error
    vertex = next((element for element in cloud.elements if element.name == "vertex"), None)
    names = {} if vertex is None else {item.name: item for item in vertex.properties}
    if vertex is None or not set("xyz") <= set(names) or vertex.count == 0:
        raise InputError(f"{path} has {0 if vertex is None else vertex.count:,} vertices with "
                         f"{', '.join(names) or 'no properties'}. {expected}")  # fmt: skip
    lists = [name for name, item in names.items() if hasattr(item, "len_dtype")]
    if len(lists) > 0:
        raise InputError(f"{path} has vertices with list properties ({', '.join(lists)}); remove these. {expected}")
    return cloud


def check_free(cloud: PlyData, names: Iterable[str]) -> None:
    """Raise ValueError if the vertices of a cloud already have properties of these names."""
    existing = sorted(set(cloud["vertex"].data.dtype.names or ()) & set(names))
    if len(existing) > 0:
        raise InputError(f"the vertices of the cloud already have {', '.join(existing)}; remove these properties first")


def places(cloud: PlyData) -> Float64[np.ndarray, "p 3"]:
    """Return x, y, z of the vertices of a cloud."""
    return np.stack([np.asarray(cloud["vertex"][axis], np.float64) for axis in "xyz"], axis=1)


def label_cloud(
    cloud: PlyData,
    path: Path,
    means: Float64[np.ndarray, "m 3"],
    columns: dict[str, np.ndarray],
    most: float,
    *,
    overwrite: bool = False,
) -> Labelled:
    """Write a cloud with the labels of the nearest Gaussians, and with zeros for points that are too far from any.

    Args:
        path: path of the new PLY file.
        means: centers of the Gaussians to take labels from, in the coordinates of the cloud.
        columns: labels of these Gaussians, by property name.
        most: maximum distance from a point to its Gaussian, in units of the median spacing of the Gaussians.
    Raises:
        ValueError: there are no Gaussians, or as in `write_cloud`.
        FileExistsError, OSError: as in `write_cloud`.
    """
    if len(means) == 0:
        raise InputError("the cloud cannot be labeled: all Gaussians are invisible (opacity below 1/255)")
    spacing = nearest_neighbors(torch.from_numpy(means), 1).spacing
    limit = most * float(spacing[spacing.isfinite()].median())
    nearest = nearest_rows(places(cloud), means, limit)
    labels = {name: np.where(nearest.near, x[nearest.row], 0).astype(x.dtype) for name, x in columns.items()}
    write_cloud(path, cloud, labels, overwrite=overwrite)
    return Labelled(len(nearest.near), float(nearest.near.mean()), limit)


def write_cloud(path: Path, cloud: PlyData, columns: dict[str, np.ndarray], *, overwrite: bool = False) -> None:
    """Write a cloud with additional vertex properties, appended to the existing ones; everything else is unchanged.

    Raises:
        ValueError: the vertices already have a property of one of these names.
        FileExistsError: the file exists, and `overwrite` is False.
        OSError: the file cannot be written.
    """
    check_free(cloud, columns)
    vertex = cloud["vertex"].data
    existing = [(name, vertex.dtype[name].newbyteorder("<")) for name in vertex.dtype.names or ()]
    table = np.empty(len(vertex), [*existing, *((name, column.dtype) for name, column in columns.items())])
    for name, _ in existing:
        table[name] = vertex[name]
    for name, column in columns.items():
        table[name] = column
    elements = [PlyElement.describe(table, "vertex") if e.name == "vertex" else e for e in cloud.elements]
    labeled = PlyData(elements, byte_order="<", comments=cloud.comments, obj_info=cloud.obj_info)
    with new_file(path, overwrite=overwrite) as draft, draft.open("wb") as file:
        labeled.write(file)
