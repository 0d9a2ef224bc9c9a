"""What pages of a run share: which Gaussians are drawn, their geometry, stills and paths that are not told."""

import gzip
import io
import re
import struct

import numpy as np
import pytest
import torch
from PIL import Image
from plyfile import PlyData

from normlift_ns.server.permalink import PageView
from normlift_ns.server.protocol import Codes
from normlift_ns.server.runs import ServedRun, without_paths
from normlift_ns.session.state import State
from tests.random_scenes import random_scene
from tests.server.pages import make_served
from tests.session.worlds import BLOCK, world
from tests.viewer.scenes import camera, scene_of, spheres


def test_the_faintest_and_smallest_of_too_many_are_left_out_and_downloads_count_what_is_in_the_file(tmp_path):
    found = random_scene(4 * BLOCK, dtype=torch.float32)
    found.opacities[:3] = 1e-4
    served = make_served(tmp_path, scene_of(found, cameras=(camera(),)), world())
    few = ServedRun("few", served.run, 50)
    area = found.opacities * found.scales.topk(2, dim=1).values.prod(dim=1)
    assert sorted(few.rows.tolist()) == sorted(area.topk(50).indices.tolist())
    visible = int((found.opacities >= 1 / 255).sum())
    assert few.describe(read_only=False)["num_left_out"] == visible - 50
    assert len(served.rows) == visible
    _, content, text = served.export(State(served.space), torch.ones(len(found), dtype=torch.bool), "all", "ply")
    written, left_out = map(int, re.findall(r": (\d+)\.", text))
    assert written == PlyData.read(io.BytesIO(content))["vertex"].count and written + left_out == len(found)


def test_the_geometry_holds_the_rows_in_their_order(tmp_path):
    found = random_scene(4 * BLOCK, dtype=torch.float32)
    for logits in (False, True):
        scene = scene_of(found, cameras=(camera(),))
        scene.has_harmonics = not logits
        served = make_served(tmp_path, scene, world())
        data = gzip.decompress(served.geometry[0])
        magic, version, count, degree, bits = struct.unpack("<IIIBB", data[:14])
        assert (magic, version, count, degree) == (0x5053474E, 3, len(served.rows), 0)
        fixed = np.frombuffer(data[16 : 16 + 9 * count], np.uint8).reshape(-1, 3).astype(np.int32)
        places = (fixed[:, 0] | fixed[:, 1] << 8 | fixed[:, 2] << 16) << 8 >> 8
        expected = found.means.numpy()[served.rows]
        np.testing.assert_allclose(places.reshape(-1, 3) / 2**bits, expected, atol=1.0 / 2**bits)


@pytest.mark.parametrize(
    ("entry", "expected"),
    [((0, 0, 0, 0.0, 0), (229, 25, 25)), ((0, 0, 0, 0.0, 1), (69, 69, 69)), ((0, 255, 0, 1.0, 0), (0, 255, 0)),
     ((0, 0, 255, 0.5, 1), (34, 34, 162))],
)  # fmt: skip
def test_a_still_has_the_colors_of_the_palette(tmp_path, entry, expected):
    means = torch.tensor([[0.0, 0, 4]]).repeat(4 * BLOCK, 1)
    means[1:] = 1e6
    rgb = torch.tensor([[0.9, 0.1, 0.1]]).repeat(4 * BLOCK, 1)
    served = make_served(tmp_path, scene_of(spheres(means, 2.0, 0.999), rgb, (camera(),)), world())
    view = PageView((0, 0, 0), (0, 0, 4), (0, -1, 0), 0.8, 64, 48)
    codes = Codes([entry], np.zeros(len(served.rows), np.uint8))
    with Image.open(io.BytesIO(served.still(codes, view.camera(64)))) as image:
        assert image.size == (64, 48)
        assert image.getpixel((32, 24)) == pytest.approx(expected, abs=6)
    codes.codes[:] = 255
    with Image.open(io.BytesIO(served.still(codes, view.camera(64), (0, 0, 1)))) as image:
        assert image.getpixel((32, 24)) == pytest.approx((0, 0, 255), abs=6)


def test_examples_are_words_that_the_scene_has(tmp_path, monkeypatch):
    served = make_served(tmp_path)
    monkeypatch.setattr("normlift_ns.server.runs.own_words", lambda field: ("green", "red", "blue"))
    assert served.examples == ["red", "blue"]
    monkeypatch.setattr("normlift_ns.server.runs.own_words", lambda field: ())
    assert make_served(tmp_path).examples == []


@pytest.mark.parametrize(
    ("text", "told"),
    [("/data/me/run/config.yml: No such file", "config.yml: No such file"),
     ("the run '/a/b c/fox' is damaged", "the run 'fox' is damaged"), ("see https://example.org/a", None),
     ("1/255 and N/A", None), ("in /tmp", "in tmp"), ("(/x/y, /z/w)", "(y, w)"),
     ("C:\\me\\run.yml: gone", "run.yml: gone")],
)  # fmt: skip
def test_messages_name_no_folder(text, told):
    assert without_paths(text) == (text if told is None else told)
