"""2D Gaussian splatting: the reference against loops over floats, the other backends against the reference."""

from dataclasses import replace

import pytest
import torch

from normlift_ns import GaussianScene, RasterSettings, rasterize_evidence, render
from normlift_ns.rasterization.rasterize import RasterJob
from tests.kernels.test_regions import assert_same, hard_scene, kernel_evidence
from tests.random_scenes import dense, orbit, orbit_camera, random_labels, random_scene
from tests.rasterization.oracle import compositing_matrix_2d


def flat(scene: GaussianScene) -> GaussianScene:
    return replace(scene, primitive="2dgs")


@pytest.mark.parametrize("size", [0.5, 0.02])
def test_weights_are_those_of_rays_that_meet_planes(size):
    """Of every pixel, so that each is a region."""
    scene, camera = flat(random_scene(30, size=size)), orbit_camera(0.4)
    labels = torch.arange(camera.width * camera.height).view(camera.height, camera.width).int()
    expected = torch.from_numpy(compositing_matrix_2d(scene, camera)).flatten(0, 1).T
    found = rasterize_evidence(scene, [camera], [labels], backend="torch")
    assert torch.allclose(dense(found.rows, labels.numel()), expected, rtol=0, atol=1e-12)
    assert (expected > 0).sum() > 300
    thick = replace(scene, scales=scene.scales * torch.tensor([1.0, 1, 50]))  # the third scale changes nothing
    again = rasterize_evidence(thick, [camera], [labels], backend="torch")
    assert torch.equal(again.rows.weight, found.rows.weight)


def test_projection_is_that_of_gsplat():
    from gsplat.cuda._torch_impl_2dgs import _fully_fused_projection_2dgs  # noqa: PLC0415 (slow import)

    scene, camera = flat(random_scene(200, size=0.3)), orbit_camera(1.0)
    found = RasterJob(scene, False, RasterSettings(), torch.float64).project(camera)._asdict()
    shape = (camera.world_to_camera[None], camera.K[None], camera.width, camera.height)
    radii, means2d, _, transforms, _ = _fully_fused_projection_2dgs(scene.means, scene.quats, scene.scales, *shape)
    rows = found["gaussian"]
    assert torch.equal(rows.sort().values, (radii[0] > 0).nonzero().squeeze(1))
    assert torch.equal(found["radii"][:, 0].int(), radii[0, rows])
    assert torch.allclose(found["means2d"], means2d[0, rows], rtol=1e-12)
    assert torch.allclose(found["transforms"], transforms[0, rows].mT, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("kind", ["random", "hard"])
def test_triton_equals_the_reference(kind):
    scene = flat(hard_scene() if kind == "hard" else random_scene(25, dtype=torch.float32))
    cameras = orbit(2, width=21, height=17)
    labels = [random_labels(camera, 3, seed=v) for v, camera in enumerate(cameras)]
    expected = rasterize_evidence(scene, cameras, labels, num_regions=[3, 3], backend="torch")
    found = kernel_evidence(scene, cameras, labels, [3, 3])
    assert_same(found, expected, 6, 2e-5)  # planes seen edge-on lose digits
    assert expected.nnz > 20


def test_what_2d_gaussians_do_not_have_is_refused():
    scene, camera = flat(random_scene(5, dtype=torch.float32)), orbit_camera(0.0)
    with pytest.raises(ValueError, match=r'2D Gaussians .*"classic"'):
        render(scene, camera, torch.ones(5, 1), rasterize_mode="antialiased")
    with pytest.raises(ValueError, match=r"2D Gaussians .*gsplat 1\.4"):
        render(scene, camera, torch.ones(5, 1), settings=RasterSettings.of_gsplat("1.5"))
