"""Pictures from the server show what the page's camera sees, in the colours of the state, and follow both."""

import io
import threading
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.spatial.transform import Rotation

from normlift_ns.session.state import State
from normlift_ns.viewer.adapter import SCRIPT, picture_script, with_script
from normlift_ns.viewer.person import Eye, Stills, still
from normlift_ns.viewer.shared import Run
from tests.session.worlds import world
from tests.viewer.scenes import camera, run_of, scene_of, spheres, until

AXES = Rotation.from_rotvec([0.3, -1.1, 0.7]).as_matrix()
"""Right, down and forward of a camera, as columns."""
PLACE = np.array([3.0, -2.0, 5.0])
AHEAD, RIGHT, UP = (PLACE + 4 * AXES[:, 2] + offset for offset in (0 * PLACE, AXES[:, 0], -AXES[:, 1]))


class FakePage:
    def __init__(self) -> None:
        self.camera = SimpleNamespace(fov=1.0, aspect=1.5)
        self.pictures: list[np.ndarray] = []
        self.moved: Any = None

    def on_camera(self, moved: Any) -> None:
        self.moved = moved

    def show_picture(self, jpeg: bytes) -> None:
        self.pictures.append(np.asarray(Image.open(io.BytesIO(jpeg)).convert("RGB")))


@pytest.fixture
def run(tmp_path) -> Run:
    """Three Gaussians: a red one ahead, a green one to the right, a blue one above; the others are far behind."""
    n = len(world())
    means = torch.from_numpy(PLACE - 1000 * AXES[:, 2]).float().repeat(n, 1)
    means[:3] = torch.from_numpy(np.stack([AHEAD, RIGHT, UP])).float()
    rgb = torch.full((n, 3), 0.5)
    rgb[:3] += (torch.eye(3) * 4 - 2) * 0.28209479177387814
    return run_of(tmp_path, world(), scene_of(spheres(means, 0.05, 0.99), rgb, (camera(),)))


@pytest.fixture
def page(run) -> FakePage:
    page = FakePage()
    page.camera.position = run.records.units.to_browser(PLACE)
    page.camera.wxyz = Rotation.from_matrix(AXES).as_quat()[[3, 0, 1, 2]]
    return page


def peak(picture: np.ndarray, channel: int) -> tuple[int, int]:
    """x and y of the most coloured pixel."""
    strength = 2 * picture[..., channel].astype(int) - picture.astype(int).sum(axis=2)
    y, x = np.unravel_index(strength.argmax(), strength.shape)
    return int(x), int(y)


def test_a_picture_shows_what_the_camera_of_the_page_sees(run, page):
    camera = Eye(page, run.records).camera(150 * 100)  # type: ignore[arg-type]
    assert (camera.width, camera.height) == (150, 100)
    picture = still(run, State(run.space), camera)
    step = 100 / 2 / np.tan(0.5) / 4  # pixels of one unit at a depth of four
    for channel, (x, y) in enumerate(((75, 50), (75 + step, 50), (75, 50 - step))):
        np.testing.assert_allclose(peak(picture, channel), (x, y), atol=1.5)
    assert picture[0, 0].tolist() == [255, 255, 255]
    hidden = torch.zeros(len(run.space), dtype=torch.bool)
    hidden[1] = True
    without = still(run, State(run.space, hidden=hidden), camera)
    x, y = peak(picture, 1)
    assert without[y, x].tolist() == [255, 255, 255]
    assert np.array_equal(without[:, :90], picture[:, :90])


def test_pictures_follow_camera_and_state_and_get_fine_at_rest(run, page):
    state, told = State(run.space), []
    before = set(threading.enumerate())
    stills = Stills(run, page, Eye(page, run.records), lambda: state, told.append)  # type: ignore[arg-type]

    (drawing,) = [one for one in threading.enumerate() if one not in before and "_draw_on" in one.name]
    stills.change()
    until(lambda: len(page.pictures) == 2)
    coarse, fine = page.pictures
    assert coarse.shape[0] < fine.shape[0]
    assert abs(fine.shape[1] / fine.shape[0] - 1.5) < 0.01
    page.camera.wxyz = Rotation.from_matrix(AXES @ np.diag([-1, 1, -1])).as_quat()[[3, 0, 1, 2]]
    page.moved()
    until(lambda: len(page.pictures) == 4)
    assert page.pictures[3].std() < fine.std()  # nothing is there
    page.camera.fov = float("nan")
    page.moved()
    until(lambda: told != [])
    stills.stop()
    page.moved()
    drawing.join(60)
    assert not drawing.is_alive()
    assert len(page.pictures) == 4


def test_the_script_goes_before_all_others_and_pictures_are_text():
    page = with_script(b"<html><head><script src=other></script></head></html>")
    assert page.index(SCRIPT.encode()) < page.index(b"other")
    assert page.count(b"<head>") == 1
    assert 'base64,/9j/"' in picture_script(b"\xff\xd8\xff")
