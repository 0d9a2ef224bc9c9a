"""Both CPU backends against the Python loops, in float64, on tiny scenes."""

import numpy as np
import pytest
import torch

from normlift_ns import GaussianScene, rasterize_evidence, render
from tests.raster.oracle import compositing_matrix
from tests.scenes import dense, orbit, orbit_camera, random_labels, random_scene

BACKENDS = ["torch", "numba"]


def _region_sums(weights: np.ndarray, labels: torch.Tensor, regions: int) -> torch.Tensor:
    """[N, regions + 1], unlabelled last."""
    flat = torch.from_numpy(weights.reshape(-1, weights.shape[-1]))
    onehot = torch.nn.functional.one_hot(labels.long().flatten() % (regions + 1), regions + 1).double()
    return flat.T @ onehot


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("mode", ["classic", "antialiased"])
@pytest.mark.parametrize("power", [1, 2])
def test_evidence_equals_the_python_loops(backend, mode, power):
    scene = random_scene(60, seed=1, size=0.4)
    cameras = orbit(2, width=37, height=21)  # no multiple of the tile size
    labels = [random_labels(camera, 4, seed=v) for v, camera in enumerate(cameras)]
    evidence = rasterize_evidence(
        scene, cameras, labels, backend=backend, rasterize_mode=mode, weight_power=power, num_regions=[4, 4]
    )
    for view, (camera, label_map) in enumerate(zip(cameras, labels)):
        weights = compositing_matrix(scene, camera, mode == "antialiased") ** power
        expected = _region_sums(weights, label_map, 4)
        one = evidence.select_views([view])
        assert (dense(one.rows, 4) - expected[:, :4]).abs().max() < 1e-12 * expected.max()
        assert (dense(one.unlabeled, 1) - expected[:, 4:]).abs().max() < 1e-12 * expected.max()
        assert expected.max() > 1  # the scene does show something


@pytest.mark.parametrize("backend", BACKENDS)
def test_pixels_as_regions_give_the_matrix_itself(backend):
    scene, camera = random_scene(30, seed=3, size=0.5), orbit_camera(0.3, width=18, height=17)
    labels = torch.arange(18 * 17, dtype=torch.int32).view(17, 18)
    evidence = rasterize_evidence(scene, [camera], [labels], backend=backend)
    expected = torch.from_numpy(compositing_matrix(scene, camera)).view(-1, 30).T
    assert (dense(evidence.rows, 306) - expected).abs().max() < 1e-13


@pytest.mark.parametrize("backend", BACKENDS)
def test_power_zero_counts_contributing_pixels(backend):
    scene, camera = random_scene(40, seed=4, size=0.5), orbit_camera(1.0)
    labels = torch.zeros(camera.height, camera.width, dtype=torch.int32)
    evidence = rasterize_evidence(scene, [camera], [labels], backend=backend, weight_power=0)
    expected = torch.from_numpy((compositing_matrix(scene, camera) > 0).sum((0, 1)))
    assert torch.equal(dense(evidence.rows, 1)[:, 0].long(), expected)


@pytest.mark.parametrize("backend", BACKENDS)
def test_render_composites_values(backend):
    scene, camera = random_scene(50, seed=5, size=0.4), orbit_camera(2.0, width=33, height=30)
    values = torch.rand(50, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    image, alpha = render(scene, camera, values, backend=backend)
    weights = torch.from_numpy(compositing_matrix(scene, camera))
    assert (image - weights @ values).abs().max() < 1e-12
    assert (alpha - weights.sum(-1)).abs().max() < 1e-12


def test_equal_depths_are_drawn_by_index():
    """Two Gaussians at the same place: the first one hides the second."""
    scene = GaussianScene(
        torch.zeros(2, 3),
        torch.tensor([[1.0, 0, 0, 0]]).repeat(2, 1),
        torch.full((2, 3), 0.5),
        torch.tensor([0.9, 0.9]),
    )
    camera = orbit_camera(0.0)
    labels = torch.zeros(camera.height, camera.width, dtype=torch.int32)
    for backend in BACKENDS:
        first, second = rasterize_evidence(scene, [camera], [labels], backend=backend).rows.row_sums().tolist()
        assert first > 1.5 * second
