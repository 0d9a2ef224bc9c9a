"""A catalogue as JSON, as a table and as boxes that mesh viewers draw."""

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
"""Corners of a box around each of its faces, counter-clockwise from outside."""
_GOLDEN = 0.618033988749895


def write_catalogue(
    catalogue: Catalogue, folder: Path, *, question: Mapping[str, Any] | None = None, overwrite: bool = False
) -> tuple[Path, ...]:
    """Writes objects.json, objects.csv, objects.ply (boxes in the coordinates of the capture) and objects_scene.ply
    (boxes in those of the Gaussians), all or none; returns their paths. docs/objects.md explains them.

    Args:
        question: how objects were found, for objects.json.
    Raises:
        FileExistsError: one is there, and `overwrite` is False.
        OSError: it cannot be written.
    """
    files = tuple(folder / name for name in OBJECT_FILES)
    document = {**to_json(catalogue), **(question or {})}
    with new_files(*files, overwrite=overwrite) as drafts:
        drafts[0].write_text(json.dumps(document, indent=2, allow_nan=False) + "\n", "utf8")
        with drafts[1].open("w", newline="", encoding="utf8") as file:
            table = csv.writer(file)
            table.writerow(columns())
            table.writerows(row.values() for row in rows(catalogue))
        write_boxes(drafts[2], catalogue.objects, [found.capture.box for found in catalogue.objects])
        write_boxes(drafts[3], catalogue.objects, [found.scene.box for found in catalogue.objects])
    return files


def to_json(catalogue: Catalogue) -> dict[str, Any]:
    """The catalogue as plain types."""
    return {
        "unit": catalogue.unit,
        "metres_per_unit": catalogue.metres_per_unit,
        "in_smaller_parts": catalogue.in_smaller_parts,
        "objects": [
            {
                "id": found.id,
                "text": found.text,
                "class_id": found.class_id,
                "gaussians": found.gaussians,
                "reliability": found.reliability,
                "views": found.views,
                "best_views": list(found.best_views),
                "capture": _place(found.capture),
                "scene": _place(found.scene),
            }
            for found in catalogue.objects
        ],
    }


def _place(place: Place) -> dict[str, Any]:
    box = place.box
    return {
        "centroid": place.centroid.tolist(),
        "extent": place.extent.tolist(),
        "box": {"center": box.center.tolist(), "size": box.size.tolist(), "axes": box.axes.tolist()},
    }


def columns() -> list[str]:
    """The header of the table.

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
    """The rows of the table, by the names of its columns."""
    for found in catalogue.objects:
        best = [*found.best_views, *[""] * (BEST - len(found.best_views))]
        numbers = (number for place in (found.capture, found.scene) for number in _numbers(place))
        facts = (found.id, found.text, found.class_id, found.gaussians, found.reliability, found.views)
        yield dict(zip(columns(), (*facts, *best, *numbers)))


def _numbers(place: Place) -> list[float]:
    box = place.box
    return np.concatenate([place.centroid, place.extent, box.center, box.size, box.axes.ravel()]).tolist()


def write_boxes(path: Path, objects: Sequence[CatalogueObject], boxes: Iterable[OrientedBox]) -> None:
    """A mesh of eight corners and six faces per box, each corner with the numbers of its object and a colour."""
    from plyfile import PlyData, PlyElement  # noqa: PLC0415 (--help does without)

    kinds = [*((axis, "<f4") for axis in "xyz"), *((name, "u1") for name in ("red", "green", "blue"))]
    kinds += [("class_id", "<u4"), ("instance_id", "<u4")]
    corners = np.zeros(8 * len(objects), kinds)
    for i, (found, box) in enumerate(zip(objects, boxes)):
        rows_ = slice(8 * i, 8 * i + 8)
        for k, axis in enumerate("xyz"):
            corners[axis][rows_] = box.corners[:, k]
        corners["red"][rows_], corners["green"][rows_], corners["blue"][rows_] = _colour(found.id)
        corners["class_id"][rows_], corners["instance_id"][rows_] = found.class_id, found.id
    faces = np.empty(6 * len(objects), [("vertex_indices", "<i4", (4,))])
    faces["vertex_indices"] = (8 * np.arange(len(objects))[:, None, None] + np.array(_FACES)).reshape(-1, 4)
    elements = [PlyElement.describe(corners, "vertex"), PlyElement.describe(faces, "face")]
    with path.open("wb") as file:
        PlyData(elements, byte_order="<", comments=["Boxes of objects, written by normlift_ns"]).write(file)


def _colour(number: int) -> tuple[int, int, int]:
    """Colours that differ from object to object."""
    turn = 2 * np.pi * _GOLDEN * number
    red, green, blue = (round(150 + 100 * float(np.cos(turn - shift))) for shift in (0, 2.094, 4.189))
    return red, green, blue
