import pytest
import torch

from normlift_ns import Camera, GaussianScene

N = 4
GOOD = {
    "means": torch.zeros(N, 3),
    "quats": torch.ones(N, 4),
    "scales": torch.ones(N, 3),
    "opacities": torch.full((N,), 0.5),
}
K = torch.tensor([[30.0, 0, 10], [0, 30, 8], [0, 0, 1]])


@pytest.mark.usefixtures("unchecked")
def test_scenes_and_cameras_name_what_is_wrong():
    for change, message in (
        ({"quats": torch.zeros(N + 1, 4)}, r"quats .*n = 4, got .*\(5, 4\)"),
        ({"scales": torch.ones(N, 3).int()}, "scales .*int32"),
        ({"scales": -torch.ones(N, 3)}, "scales .*negative"),
        ({"opacities": torch.full((N,), 1.5)}, r"opacities .*0\.\.1"),
        ({"opacities": torch.full((N,), -0.5)}, r"opacities .*0\.\.1"),
    ):
        with pytest.raises(ValueError, match=message):
            GaussianScene(**{**GOOD, **change})
    good = {"K": K, "world_to_camera": torch.eye(4), "width": 20, "height": 16}
    Camera(**good)
    for change, message in (
        ({"K": torch.eye(4)}, r"K .*\[3, 3\]"),
        ({"K": torch.full((3, 3), torch.nan)}, "K .*finite"),
        ({"K": K + torch.tensor([[0.0, 1, 0], [0, 0, 0], [0, 0, 0]])}, r"K .*\[\[fx, 0, cx\]"),
        ({"K": -K}, "fx, fy > 0"),
        ({"world_to_camera": 2 * torch.eye(4)}, "world_to_camera"),
        ({"world_to_camera": torch.diag(torch.tensor([-1.0, 1, 1, 1]))}, "world_to_camera"),
        ({"width": 0}, "width 0, height 16"),
        ({"height": 0}, "width 20, height 0"),
    ):
        with pytest.raises(ValueError, match=message):
            Camera(**{**good, **change})


def test_drawable_excludes_rows_that_are_not_finite_and_zero_quaternions():
    scene = GaussianScene(**{name: value.clone() for name, value in GOOD.items()})
    scene.means[0, 1] = torch.nan
    scene.quats[2] = 0
    assert scene.drawable.tolist() == [False, True, False, True]
    assert len(scene) == N
