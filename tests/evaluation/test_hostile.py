"""Labels and names that are damaged, absurd or no files: only our own errors leave the loaders."""

import io
import json
from collections.abc import Callable
from copy import deepcopy
from functools import reduce
from operator import getitem
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from plyfile import PlyData, PlyElement

from normlift_ns import InputError
from normlift_ns.evaluation.lerf import read_frame
from normlift_ns.evaluation.protocols import read_classes, read_names
from normlift_ns.evaluation.scannet import read_labels
from normlift_ns.segmentation.regions import LabelFiles
from tests.hostile import VALUES, damaged, fuzz, hostile_json, no_files, survives

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


def test_damaged_and_hostile_files_raise_our_errors_only(tmp_path: Path) -> None:
    for name, whole, load in LOADERS.values():
        path = tmp_path / name
        for what in no_files(path):
            with pytest.raises((InputError, FileNotFoundError)) as caught:
                load(path)
            assert name in str(caught.value), what
            survives(lambda load=load, path=path: load(path))
        for value in VALUES if path.suffix == ".json" else ():
            path.write_text(json.dumps(value))
            survives(lambda load=load, path=path: load(path))
        path.write_bytes(whole)
        load(path)
        contents = damaged(whole) | hostile_json(json.loads(whole)) if path.suffix == ".json" else damaged(whole)
        fuzz(10, contents, path, lambda load=load, path=path: load(path))
        path.unlink()


def test_labels_of_lerf_say_what_is_wrong(tmp_path: Path) -> None:
    for path, value, message in (
        (("info", "width"), 0, r"`int` >= 1 - at `\$\.info\.width`"),
        (("info", "width"), 10**9, "`int` <= 32768"),
        (("objects", 0, "category"), "", "regex"),
        (("objects", 0, "segmentation"), [[1, 2]], "length >= 3"),
        (("objects", 0, "segmentation", 1), [1e9, 3], r"40 x 30 .* 1e\+09"),
        (("objects", 0, "segmentation", 1), [1, 2, 3], "length 2"),
        (("objects", 0, "bbox"), [1, 2, 3], "length 4"),
        (("objects", 0, "bbox"), [0, 0, -1e12, 5], r"1e\+12"),
    ):
        *keys, last = path
        reduce(getitem, keys, document := deepcopy(FRAME))[last] = value
        (tmp_path / "f.json").write_text(json.dumps(document))
        with pytest.raises(InputError, match=rf"f\.json .*{message}"):
            read_frame(tmp_path / "f.json", 40, 30)


def test_names_say_what_is_wrong(tmp_path: Path) -> None:
    for text, message in (
        ('{"labels": {"1": "a", "1": "b"}}', "'1' .*more than once"),
        ('{"labels": {"01": "a"}}', "'01'"),
        ('{"labels": {"0": "a"}, "background": 0}', "0 is the background"),
        ('{"labels": {"' + "9" * 5000 + '": "a"}}', "not a mask value"),
        *((text, "") for text in ('{"labels": {}}', '{"labels": {"a": "b"}}', "{")),
        ('{"labels": {"1": "\\ud800"}}', "regex"),
    ):
        (tmp_path / "labels.json").write_text(text)
        with pytest.raises(InputError, match=rf"labels\.json (?s:.*){message}"):
            read_names(tmp_path / "labels.json")
    (tmp_path / "labels.json").write_text('{"3": "cup"}')
    assert read_names(tmp_path / "labels.json").class_of == {3: 0}


def test_labels_are_read_from_text_and_binary_and_absurd_headers_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    for text in (False, True):
        for faces in (False, True):
            path.write_bytes(ply(LABELS, text, faces))
            assert read_labels(path).tolist() == [1, 36, 0, 40]
        whole = ply(LABELS, text=text, faces=False)
        for count in (5, 10**12, 10**30, 0):  # which nothing may be allocated for
            path.write_bytes(whole.replace(b"element vertex 4", f"element vertex {count}".encode()))
            with pytest.raises(InputError, match=r"a\.ply is damaged"):
                read_labels(path)


def test_ids_of_another_list_are_refused_or_warned_of(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    path.write_bytes(ply(LABELS).replace(b" label", b" class"))
    with pytest.raises(InputError, match=r" label.*x, red, class"):
        read_labels(path)
    for labels, message in (
        (np.array([1163, 1165], np.int32), "NYU40"),
        (np.array([1.5, 2]), "32-bit integers"),
        (np.array([np.nan, 2]), "32-bit integers"),
    ):
        path.write_bytes(ply(labels))
        with pytest.raises(InputError, match=rf"a\.ply.*{message}"):
            read_labels(path)
    path.write_bytes(ply(np.array([1, 50, 2**31 - 1, -1], np.int32)))
    with pytest.warns(UserWarning, match=r"a\.ply .*50\. .*\(2 of 4\)"):
        assert read_labels(path).tolist() == [1, 0, 0, -1]


def test_masks_are_read_as_carefully_as_label_maps(tmp_path: Path) -> None:
    (tmp_path / "labels.json").write_text(json.dumps(NAMES))
    names = read_names(tmp_path / "labels.json")
    assert (names.classes, names.class_of) == (("table", "mug"), {1: 0, 2: 1, 7: 0})  # equal names are one class
    masks = LabelFiles(tmp_path, description="instance mask", flag="--labels")
    for array in (np.zeros((2, 2, 3), int), np.zeros((3, 2), int)):
        np.save(tmp_path / "a.npy", array)
        with pytest.raises(InputError, match=r"a\.npy has .* its image x/a\.png is 2 x 3") as caught:
            read_classes(masks, "x/a.png", names, 2, 3)
        assert str(array.shape) in str(caught.value)
    np.save(tmp_path / "a.npy", np.array([[0, 1, 2], [-(2**62), 7, 2**62]]))
    assert read_classes(masks, "x/a.png", names, 2, 3).tolist() == [[-1, 0, 1], [-1, 0, -1]]
    with pytest.raises(FileNotFoundError, match="b"):
        read_classes(masks, "x/b.png", names, 2, 3)
    with pytest.raises(FileNotFoundError, match=r"--labels .*nowhere"):
        LabelFiles(tmp_path / "nowhere", description="instance mask", flag="--labels")
