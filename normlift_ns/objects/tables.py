"""Export of a catalogue as JSON, as a CSV table, and as box meshes for mesh viewers."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from normlift_ns.core.files import new_files
from normlift_ns.objects.boxes import OrientedBox
from normlift_ns.objects.catalogue import BEST, Catalogue, CatalogueObject, Place
from normlift_ns.options import OBJECT_FILES

_FACES = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
"""Corner indices of each face of a box, counterclockwise as seen from outside."""
_GOLDEN_RATIO = 0.618033988749895


def write_catalogue(
    catalogue: Catalogue, folder: Path, *, question: Mapping[str, Any] | None = None, overwrite: bool = False
) -> tuple[Path, ...]:
    """Write the files of a catalogue, all or none, and return their paths.

    The files are objects.json, objects.csv, objects.ply (boxes in the coordinates of the capture) and
    objects_scene.ply (boxes in the coordinates of the Gaussians). docs/objects.md explains them.

    Args:
        question: the query that found the objects, for objects.json.
    Raises:
        FileExistsError: a file exists, and `overwrite` is False.
        OSError: a file cannot be written.
    """
    files = tuple(folder / name for name in OBJECT_FILES)
    document = {**to_json(catalogue), **(question or {})}
    with new_files(*files, overwrite=overwrite) as drafts:
        drafts[0].write_text(json.dumps(document, indent=2, allow_nan=False) + "\n", "utf8")
        with drafts[1].open("w", newline="", encoding="utf8") as file:
            table = csv.writer(file)
            table.writerow(columns())
            table.writerows(row.values() for row in rows(catalogue))
        write_boxes(drafts[2], catalogue.objects, [item.capture.box for item in catalogue.objects])
        write_boxes(drafts[3], catalogue.objects, [item.scene.box for item in catalogue.objects])
    return files


def to_json(catalogue: Catalogue) -> dict[str, Any]:
    """Return a catalogue as plain Python types."""
    return {
        "unit": catalogue.unit,
        "metres_per_unit": catalogue.metres_per_unit,
        "in_smaller_parts": catalogue.in_smaller_parts,
        "objects": [
            {
                "id": item.id,
                "text": item.text,
                "class_id": item.class_id,
                "gaussians": item.gaussians,
                "reliability": item.reliability,
                "views": item.views,
                "best_views": list(item.best_views),
                "capture": _place_json(item.capture),
                "scene": _place_json(item.scene),
            }
            for item in catalogue.objects
        ],
    }


def _place_json(place: Place) -> dict[str, Any]:
    box = place.box
    return {
        "centroid": place.centroid.tolist(),
        "extent": place.extent.tolist(),
        "box": {"center": box.center.tolist(), "size": box.size.tolist(), "axes": box.axes.tolist()},
    }


def columns() -> list[str]:
    """Return the column names of the CSV table.

    >>> columns()[:10]
    ['id', 'text', 'class_id', 'gaussians', 'reliability', 'views', 'best_view_1', 'best_view_2', 'best_view_3', 'x']
    """
    places = [f"{prefix}{name}" for prefix in ("", "scene_") for name in _PLACE_COLUMNS]
    best = (f"best_view_{i}" for i in range(1, BEST + 1))
    return ["id", "text", "class_id", "gaussians", "reliability", "views", *best, *places]


_PLACE_COLUMNS = (
    *"xyz",
    *(f"extent_{axis}" for axis in "xyz"),
    *(f"box_{axis}" for axis in "xyz"),
    *(f"box_size_{i}" for i in (1, 2, 3)),
    *(f"box_axis_{i}_{axis}" for i in (1, 2, 3) for axis in "xyz"),
)


def rows(catalogue: Catalogue) -> Iterator[dict[str, Any]]:
    """Yield the rows of the CSV table as dicts by column name."""
    for item in catalogue.objects:
        best = [*item.best_views, *[""] * (BEST - len(item.best_views))]
        numbers = (number for place in (item.capture, item.scene) for number in _numbers(place))
        summary = (item.id, item.text, item.class_id, item.gaussians, item.reliability, item.views)
        yield dict(zip(columns(), (*summary, *best, *numbers)))


def _numbers(place: Place) -> list[float]:
    box = place.box
    return np.concatenate([place.centroid, place.extent, box.center, box.size, box.axes.ravel()]).tolist()


def write_boxes(path: Path, objects: Sequence[CatalogueObject], boxes: Iterable[OrientedBox]) -> None:
    """Write a PLY mesh with eight corners and six faces per box; each corner has the ids and color of its object."""
    from plyfile import PlyData, PlyElement  # noqa: PLC0415 (--help does not need it)

    dtype = [*((axis, "<f4") for axis in "xyz"), *((name, "u1") for name in ("red", "green", "blue"))]
    dtype += [("class_id", "<u4"), ("instance_id", "<u4")]
    corners = np.zeros(8 * len(objects), dtype)
    for i, (item, box) in enumerate(zip(objects, boxes)):
        block = slice(8 * i, 8 * i + 8)
        for k, axis in enumerate("xyz"):
            corners[axis][block] = box.corners[:, k]
        corners["red"][block], corners["green"][block], corners["blue"][block] = _color(item.id)
        corners["class_id"][block], corners["instance_id"][block] = item.class_id, item.id
    faces = np.empty(6 * len(objects), [("vertex_indices", "<i4", (4,))])
    faces["vertex_indices"] = (8 * np.arange(len(objects))[:, None, None] + np.array(_FACES)).reshape(-1, 4)
    elements = [PlyElement.describe(corners, "vertex"), PlyElement.describe(faces, "face")]
    with path.open("wb") as file:
        PlyData(elements, byte_order="<", comments=["Boxes of objects, written by normlift_ns"]).write(file)


def _color(number: int) -> tuple[int, int, int]:
    """Return an RGB color in 0..255 that differs from object to object."""
    angle = 2 * np.pi * _GOLDEN_RATIO * number
    red, green, blue = (round(150 + 100 * float(np.cos(angle - shift))) for shift in (0, 2.094, 4.189))
    return red, green, blue
