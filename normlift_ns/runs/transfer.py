"""Labels of any point cloud, from the nearest Gaussians."""

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
    """Whether it is near enough to count."""


class Labelled(NamedTuple):
    """What became of a cloud."""

    points: int
    share: float
    """Of them near enough to a Gaussian, in 0..1."""
    limit: float
    """How near that is, in the coordinates of the cloud."""


def nearest_rows(points: Float64[np.ndarray, "p 3"], means: Float64[np.ndarray, "n 3"], most: float) -> Nearest:
    """The Gaussian whose centre is nearest to every point, by a k-d tree.

    Args:
        means: of at least one Gaussian.
        most: distance beyond which none counts; it does at exactly that distance.

    >>> nearest_rows(np.array([[0.0, 0, 1], [0, 0, 9]]), np.array([[0.0, 0, 3], [0, 0, 0]]), most=2.0)
    Nearest(row=array([1, 0]), near=array([ True, False]))
    """
    finite = np.asarray(np.isfinite(points).all(axis=1))
    distance, row = (np.asarray(found) for found in KDTree(means).query(np.nan_to_num(points, posinf=0.0, neginf=0.0)))
    reached = np.isfinite(distance)  # from further away than squares of distances can say, there is no row
    return Nearest(np.where(reached, row, 0), finite & (distance <= most))


def read_cloud(path: Path) -> PlyData:
    """A PLY file with x, y, z of its vertices.

    Raises:
        FileNotFoundError: no such file.
        ValueError: no PLY file, a truncated one, vertices without places.
    """
    expected = "Expected a point cloud or a mesh in the PLY format, with x, y, z of its vertices."
    if not path.is_file():
        raise FileNotFoundError(f"There is no point cloud at {path}, given with --transfer. {expected}")
    check_header(path)
    try:
        found = PlyData.read(str(path), mmap="c")
    except (PlyParseError, ValueError, OSError, EOFError, MemoryError, OverflowError) as error:
        raise InputError(f"{path} cannot be read ({' '.join(str(error).split())}). {expected}") from error
    vertex = next((element for element in found.elements if element.name == "vertex"), None)
    names = {} if vertex is None else {item.name: item for item in vertex.properties}
    if vertex is None or not set("xyz") <= set(names) or vertex.count == 0:
        raise InputError(f"{path} has {0 if vertex is None else vertex.count:,} vertices with "
                         f"{', '.join(names) or 'no properties'}. {expected}")  # fmt: skip
    lists = [name for name, item in names.items() if hasattr(item, "len_dtype")]
    if len(lists) > 0:
        raise InputError(f"{path} has lists at its vertices ({', '.join(lists)}); remove them. {expected}")
    return found


def check_free(cloud: PlyData, names: Iterable[str]) -> None:
    """Raises ValueError where vertices of a cloud have properties of these names."""
    taken = sorted(set(cloud["vertex"].data.dtype.names or ()) & set(names))
    if len(taken) > 0:
        raise InputError(f"the vertices of the cloud have {', '.join(taken)} already; remove that from it first")


def places(cloud: PlyData) -> Float64[np.ndarray, "p 3"]:
    """x, y, z of its vertices."""
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
    """Writes a cloud with the labels of the nearest Gaussians, zeros where none is near.

    Args:
        means: centres of the Gaussians that count, in the coordinates of the cloud.
        columns: what each of them is labelled with, by name.
        most: how far a point may be from its Gaussian, in units of their median spacing.
    Raises:
        ValueError: there is no Gaussian; as `write_cloud`.
        OSError: as `write_cloud`.
    """
    if len(means) == 0:
        raise InputError("none of the Gaussians is ever drawn, so that nothing can label the cloud")
    spacing = nearest_neighbors(torch.from_numpy(means), 1).spacing
    limit = most * float(spacing[spacing.isfinite()].median())
    found = nearest_rows(places(cloud), means, limit)
    values = {name: np.where(found.near, x[found.row], 0).astype(x.dtype) for name, x in columns.items()}
    write_cloud(path, cloud, values, overwrite=overwrite)
    return Labelled(len(found.near), float(found.near.mean()), limit)


def write_cloud(path: Path, cloud: PlyData, columns: dict[str, np.ndarray], *, overwrite: bool = False) -> None:
    """Writes a cloud with further properties of its vertices after those that it has; all else stays as it is.

    Raises:
        ValueError: it has a property of one of these names.
        FileExistsError: the file is there, and `overwrite` is False.
        OSError: it cannot be written.
    """
    check_free(cloud, columns)
    vertex = cloud["vertex"].data
    kinds = [(name, vertex.dtype[name].newbyteorder("<")) for name in vertex.dtype.names or ()]
    table = np.empty(len(vertex), [*kinds, *((name, column.dtype) for name, column in columns.items())])
    for name, _ in kinds:
        table[name] = vertex[name]
    for name, column in columns.items():
        table[name] = column
    elements = [PlyElement.describe(table, "vertex") if e.name == "vertex" else e for e in cloud.elements]
    written = PlyData(elements, byte_order="<", comments=cloud.comments, obj_info=cloud.obj_info)
    with new_file(path, overwrite=overwrite) as draft, draft.open("wb") as file:
        written.write(file)
