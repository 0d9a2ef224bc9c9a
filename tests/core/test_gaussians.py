import pytest
import torch
from jaxtyping import TypeCheckError

from normlift_ns import Camera, GaussianScene, nearest_neighbors

N = 4
GOOD = {
    "means": torch.zeros(N, 3),
    "quats": torch.ones(N, 4),
    "scales": torch.ones(N, 3),
    "opacities": torch.full((N,), 0.5),
}
K = torch.tensor([[30.0, 0, 10], [0, 30, 8], [0, 0, 1]])


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"means": torch.zeros(N, 2)}, r"means has shape \(4, 2\), expected \(4, 3\)"),
        ({"quats": torch.zeros(N + 1, 4)}, r"quats has shape \(5, 4\), expected \(4, 4\)"),
        ({"opacities": torch.zeros(N, 1)}, r"opacities has shape \(4, 1\), expected \(4,\)"),
        ({"scales": torch.ones(N, 3).int()}, "scales is torch.int32"),
        ({"scales": -torch.ones(N, 3)}, "scales has negative values; pass linear scales"),
        ({"opacities": torch.full((N,), 1.5)}, "opacities leaves 0..1; pass activated opacities"),
    ],
)
def test_scene_names_what_is_wrong(change, message):
    with pytest.raises(ValueError, match=message):
        GaussianScene(**{**GOOD, **change})


def test_drawable_excludes_rows_that_are_not_finite_and_zero_quaternions():
    scene = GaussianScene(**{name: value.clone() for name, value in GOOD.items()})
    scene.means[0, 1] = torch.nan
    scene.quats[2] = 0
    assert scene.drawable.tolist() == [False, True, False, True]
    assert len(scene) == N


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"K": torch.eye(4)}, r"K must be a finite floating-point tensor of shape \(3, 3\)"),
        ({"K": torch.full((3, 3), torch.nan)}, "K must be a finite"),
        ({"K": K + torch.tensor([[0.0, 1, 0], [0, 0, 0], [0, 0, 0]])}, r"K must be \[\[fx, 0, cx\]"),
        ({"K": -K}, "fx, fy > 0"),
        ({"world_to_camera": 2 * torch.eye(4)}, "no scale, no mirror"),
        ({"world_to_camera": torch.diag(torch.tensor([-1.0, 1, 1, 1]))}, "no scale, no mirror"),
        ({"width": 0}, "at least 1x1 pixel, got width 0, height 16"),
    ],
)
def test_camera_names_what_is_wrong(change, message):
    with pytest.raises(ValueError, match=message):
        Camera(**{"K": K, "world_to_camera": torch.eye(4), "width": 20, "height": 16, **change})


def test_shapes_of_the_core_are_checked_while_testing():
    """The shape annotations are live here, so that every other test checks them too."""
    with pytest.raises(TypeCheckError):
        nearest_neighbors(torch.zeros(5, 2), 1)
