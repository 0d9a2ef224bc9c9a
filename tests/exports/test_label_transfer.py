"""Labels of point clouds: the rule against loops, and the file against what it was."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from plyfile import PlyData, PlyElement

from normlift_ns import InputError
from normlift_ns.exports import CloudTransfer, label_cloud, nearest_gaussians, read_cloud, vertex_positions, write_cloud
from tests.examples import examples


@given(st.integers(0, 2**16), st.floats(0.01, 2))
@examples(8)
def test_nearest_rows_are_those_of_loops(seed, most):
    g = np.random.default_rng(seed)
    points, means = g.normal(size=(20, 3)), g.normal(size=(15, 3))
    points[3] = [np.nan, 0, np.inf]
    points[4:8] = [[far, -far, 0] for far in (1e150, 1e200, 1e300, np.finfo(np.float64).max)]
    row, within = nearest_gaussians(points, means, most)
    for i, point in enumerate(points):
        if i in range(3, 8):
            assert not within[i] and row[i] in range(15)
            continue
        distances = [float(np.sqrt(((point - mean) ** 2).sum())) for mean in means]
        assert row[i] == int(np.argmin(distances))
        assert within[i] == (min(distances) <= most)


def cloud(path: Path, *, text: bool = False, order: str = "<") -> np.ndarray:
    table = np.zeros(5, [("x", "f8"), ("quality", "i2"), ("y", "f4"), ("z", "f4"), ("red", "u1")])
    table["x"], table["y"], table["z"], table["quality"], table["red"] = range(5), 2, 3, -7, 250
    faces = np.array([([0, 1, 2],), ([2, 3, 4],)], dtype=[("vertex_indices", "i4", (3,))])
    elements = [PlyElement.describe(table, "vertex"), PlyElement.describe(faces, "face")]
    PlyData(elements, text=text, byte_order="=" if text else order, comments=["made by hand"]).write(str(path))
    return table


@pytest.mark.parametrize("how", [{"text": True}, {"order": "<"}, {"order": ">"}])
def test_all_else_of_a_cloud_stays(how, tmp_path):
    table = cloud(tmp_path / "a.ply", **how)
    read = read_cloud(tmp_path / "a.ply")
    assert vertex_positions(read)[2].tolist() == [2, 2, 3]
    columns = {"relevancy_0": np.arange(5, dtype=np.float32), "class_id": np.arange(5).astype(np.uint32)}
    write_cloud(tmp_path / "b.ply", read, columns)
    again = PlyData.read(tmp_path / "b.ply")
    assert [p.name for p in again["vertex"].properties] == [*(table.dtype.names or ()), *columns]
    for name in table.dtype.names or ():
        assert np.array_equal(again["vertex"][name], table[name])
        assert again["vertex"][name].dtype.str[1:] == table[name].dtype.str[1:]
    assert again["vertex"]["class_id"].dtype == np.uint32
    assert np.array_equal(np.stack(again["face"]["vertex_indices"]), [[0, 1, 2], [2, 3, 4]])
    assert again.comments == ["made by hand"]
    with pytest.raises(InputError, match="class_id, relevancy_0"):
        write_cloud(tmp_path / "c.ply", read_cloud(tmp_path / "b.ply"), columns)
    with pytest.raises(FileExistsError):
        write_cloud(tmp_path / "b.ply", read, columns)


def test_what_is_no_cloud_is_refused(tmp_path):
    start, end = "ply\nformat ascii 1.0\n", "end_header\n"
    x = "property float x\n"
    lists = f"{x}property float y\nproperty float z\nproperty list uchar int n\n"
    for content, message in (
        ("", "cannot be read"),
        (f"{start}element vertex 1\n{x}{end}1\n", "vertices: 1, properties: x\\)"),
        (f"{start}element vertex 99999999999\n{x}{end}1\n", "truncated"),
        (f"{start}element face 0\n{x}{end}", "vertices: 0, properties: none"),
        (f"{start}element vertex 1\n{lists}{end}1 2 3 1 4\n", "list properties"),
        (f"{start}element vertex 2\n{x}{end}1\n", "cannot be read"),
    ):
        (tmp_path / "a.ply").write_text(content)
        with pytest.raises(InputError, match=message):
            read_cloud(tmp_path / "a.ply")
    with pytest.raises(FileNotFoundError, match=r"none\.ply"):
        read_cloud(tmp_path / "none.ply")


@pytest.mark.parametrize("count", [1, 3])
def test_gaussians_at_one_position_label_no_cloud(count, tmp_path):
    cloud(tmp_path / "a.ply")
    transfer = CloudTransfer(read_cloud(tmp_path / "a.ply"), 2.0, None)
    means, columns = np.ones((count, 3)), {"class_id": np.ones(count, np.uint32)}
    with pytest.raises(InputError, match="one position"):
        label_cloud(transfer, tmp_path / "b.ply", means, columns)
    assert not (tmp_path / "b.ply").exists()
    means = np.concatenate([means, [[1, 1, 2.0]]])
    columns = {"class_id": np.ones(count + 1, np.uint32)}
    assert label_cloud(transfer, tmp_path / "b.ply", means, columns).limit == 2.0
