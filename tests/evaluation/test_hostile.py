"""Labels and names that are damaged, absurd or no files: only our own errors leave the loaders."""

from __future__ import annotations

import io
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from plyfile import PlyData, PlyElement

from normlift_ns import InputError
from normlift_ns.encoders.regions import LabelFiles
from normlift_ns.evaluation.instance_masks import read_classes, read_names
from normlift_ns.evaluation.lerf_labels import read_frame
from normlift_ns.evaluation.scannet import read_labels
from tests.hostile import EXAMPLES, VALUES, damaged, fuzz, hostile_json, no_files, survives

SQUARE = [[2.0, 3], [7, 3], [7, 8], [2, 8]]
FRAME: dict[str, Any] = {
    "info": {"name": "f.jpg", "width": 40, "height": 30, "depth": 3, "note": ""},
    "objects": [
        {"category": "egg", "group": 1, "segmentation": SQUARE, "area": 25.0, "bbox": [2, 3, 7, 8], "note": ""},
        {"category": "bowl", "segmentation": SQUARE, "bbox": None},
    ],
}
NAMES: dict[str, Any] = {"labels": {"1": "table", "2": "mug", "7": "table"}, "background": 0}


def ply(labels: np.ndarray, text: bool = False, faces: bool = True) -> bytes:
    vertices = np.zeros(len(labels), [("x", "f4"), ("red", "u1"), ("label", labels.dtype)])
    vertices["label"] = labels
    elements = [PlyElement.describe(vertices, "vertex")]
    if faces:
        corners = np.array([([0, 1, 2],)], [("vertex_indices", "i4", (3,))])
        elements.append(PlyElement.describe(corners, "face"))
    buffer = io.BytesIO()
    PlyData(elements, text=text, byte_order="<").write(buffer)
    return buffer.getvalue()


LABELS = np.array([1, 36, 0, 40], np.uint16)
LOADERS: dict[str, tuple[str, bytes, Callable[[Path], object]]] = {
    "LERF": ("f.json", json.dumps(FRAME).encode(), lambda path: read_frame(path, 20, 15)),
    "names": ("labels.json", json.dumps(NAMES).encode(), read_names),
    "ScanNet": ("a.ply", ply(LABELS), read_labels),
    "ScanNet, text": ("a.ply", ply(LABELS, text=True), read_labels),
}


@pytest.mark.parametrize("examples", EXAMPLES)
@pytest.mark.parametrize("kind", LOADERS)
def test_damaged_files_raise_our_errors_only(kind: str, examples: int, tmp_path: Path) -> None:
    name, whole, load = LOADERS[kind]
    (tmp_path / name).write_bytes(whole)
    load(tmp_path / name)
    fuzz(examples, damaged(whole), tmp_path / name, lambda: load(tmp_path / name))


@pytest.mark.parametrize("examples", EXAMPLES)
@pytest.mark.parametrize("kind", ["LERF", "names"])
def test_hostile_values_raise_our_errors_only(kind: str, examples: int, tmp_path: Path) -> None:
    name, whole, load = LOADERS[kind]
    fuzz(examples, hostile_json(json.loads(whole)), tmp_path / name, lambda: load(tmp_path / name))


@pytest.mark.parametrize("kind", LOADERS)
def test_what_is_no_file_raises_our_errors_only(kind: str, tmp_path: Path) -> None:
    name, _, load = LOADERS[kind]
    for what in no_files(tmp_path / name):
        with pytest.raises((InputError, FileNotFoundError)) as caught:
            load(tmp_path / name)
        assert name in str(caught.value), what
        survives(lambda: load(tmp_path / name))


def changed(document: dict[str, Any], path: tuple[Any, ...], value: Any) -> str:
    found = json.loads(json.dumps(document))
    parent = found
    for key in path[:-1]:
        parent = parent[key]
    parent[path[-1]] = value
    return json.dumps(found)


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        (("info", "width"), 0, "Expected `int` >= 1 - at `\\$.info.width`"),
        (("info", "width"), 10**9, "Expected `int` <= 32768"),
        (("info", "height"), True, "Expected `int`, got `bool`"),
        (("info", "height"), "30", "Expected `int`, got `str`"),
        (("objects",), {}, "Expected `array`, got `object`"),
        (("objects", 0, "category"), "", "matching regex"),
        (("objects", 0, "category"), 3, "Expected `str`, got `int`"),
        (("objects", 0, "segmentation"), [[1, 2]], "length >= 3"),
        (("objects", 0, "segmentation", 1), [1e9, 3], "an image of 40 x 30 pixels has 1e\\+09 in it"),
        (("objects", 0, "segmentation", 1), [1, 2, 3], "length 2"),
        (("objects", 0, "segmentation", 1, 0), float("nan"), "NaN is no number"),
        (("objects", 0, "bbox"), [1, 2, 3], "length 4"),
        (("objects", 0, "bbox"), [0, 0, -1e12, 5], "1e\\+12 in it"),
    ],
)
def test_labels_of_lerf_say_what_is_wrong(path: tuple[Any, ...], value: Any, message: str, tmp_path: Path) -> None:
    (tmp_path / "f.json").write_text(changed(FRAME, path, value))
    with pytest.raises(InputError, match=rf"f\.json is no label file of LERF-OVS \(.*{message}"):
        read_frame(tmp_path / "f.json", 40, 30)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"labels": {"1": "a", "1": "b"}}', "the key '1' stands twice"),
        ('{"labels": {"01": "a"}}', "'01' is no value of a mask"),
        ('{"labels": {"1": null}}', "Expected `str`, got `null`"),
        ('{"labels": {"1": 2}}', "Expected `str`, got `int`"),
        ('{"labels": {"1": " "}}', "matching regex"),
        ('{"labels": {"0": "a"}, "background": 0}', "value 0 is the background, but has a name"),
        ('{"labels": {"1": "a"}, "background": true}', "Expected `int | null`, got `bool`"),
        ('{"labels": {"' + "9" * 5000 + '": "a"}}', "is no value of a mask"),
        ("[" * 100000, "RecursionError"),
        ('{"labels": {"1": "\\ud800"}}', "matching regex"),
    ],
)
def test_names_say_what_is_wrong(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "labels.json").write_text(text)
    with pytest.raises(InputError, match=rf"labels\.json names no masks \((?s:.*){message}"):
        read_names(tmp_path / "labels.json")


@pytest.mark.parametrize("value", VALUES, ids=lambda value: repr(value)[:20])
@pytest.mark.parametrize("document", [FRAME, NAMES], ids=["LERF", "names"])
def test_any_document_may_be_any_value(document: dict[str, Any], value: Any, tmp_path: Path) -> None:
    load = read_names if document is NAMES else lambda path: read_frame(path, 40, 30)
    for text in (json.dumps(value), *(changed(document, (key,), value) for key in document)):
        (tmp_path / "a.json").write_text(text)
        survives(lambda: load(tmp_path / "a.json"))


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("count", [5, 10**12, 10**30, 0])
def test_headers_of_absurd_size_allocate_nothing(count: int, text: bool, tmp_path: Path) -> None:
    whole = ply(LABELS, text=text, faces=False)
    (tmp_path / "a.ply").write_bytes(whole.replace(b"element vertex 4", f"element vertex {count}".encode()))
    started = time.process_time()
    with pytest.raises(InputError, match=r"a\.ply is damaged or no PLY file"):
        read_labels(tmp_path / "a.ply")
    assert time.process_time() - started < 1


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("faces", [False, True])
def test_labels_are_read_from_text_and_binary(text: bool, faces: bool, tmp_path: Path) -> None:
    (tmp_path / "a.ply").write_bytes(ply(LABELS, text, faces))
    assert read_labels(tmp_path / "a.ply").tolist() == [1, 36, 0, 40]


def test_ids_of_another_list_are_refused_or_warned_of(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    for labels, message in (
        (np.array([1163, 1165], np.int32), "no label is one of the NYU40 ids"),
        (np.array([1.5, 2]), "no whole numbers"),
        (np.array([np.nan, 2]), "no whole numbers"),
        (np.array([1e300, 2]), "no whole numbers"),
    ):
        path.write_bytes(ply(labels))
        with pytest.raises(InputError, match=rf"a\.ply.*{message}"):
            read_labels(path)
    path.write_bytes(ply(np.array([1, 50, 2**31 - 1, -1], np.int32)))
    with pytest.warns(UserWarning, match=r"a\.ply: 2 of 4 labels are no NYU40 ids \(50 among them\)"):
        assert read_labels(path).tolist() == [1, 0, 0, -1]


def test_masks_are_read_as_carefully_as_label_maps(tmp_path: Path) -> None:
    (tmp_path / "labels.json").write_text(json.dumps(NAMES))
    names = read_names(tmp_path / "labels.json")
    masks = LabelFiles(tmp_path, what="instance mask", flag="--labels")
    for array, message in (
        (np.zeros((2, 3), np.float32), "instance mask .*a.npy holds float32"),
        (np.zeros((2, 2, 3), int), r"a\.npy has shape \(2, 2, 3\), its image x/a\.png is 2 x 3"),
        (np.zeros((3, 2), int), r"a\.npy has shape \(3, 2\), its image x/a\.png is 2 x 3"),
    ):
        np.save(tmp_path / "a.npy", array)
        with pytest.raises(InputError, match=message):
            read_classes(masks, "x/a.png", names, 2, 3)
    np.save(tmp_path / "a.npy", np.array([[-(2**62), 7, 2**62]]))
    assert read_classes(masks, "x/a.png", names, 1, 3).tolist() == [[-1, 0, -1]]
    with pytest.raises(FileNotFoundError, match=r"folder of instance masks .*nowhere does not exist \(--labels\)"):
        LabelFiles(tmp_path / "nowhere", what="instance mask", flag="--labels")
