"""Both CPU backends against the Python loops, in float64, on tiny scenes."""

import numpy as np
import pytest
import torch

from normlift_ns import rasterize_evidence, render
from tests.random_scenes import dense, orbit, random_labels, random_scene
from tests.rasterization.oracle import compositing_matrix

BACKENDS = ["torch", "numba"]


def _region_sums(weights: np.ndarray, labels: torch.Tensor, regions: int) -> torch.Tensor:
    """[N, regions + 1], unlabelled last."""
    flat = torch.from_numpy(weights.reshape(-1, weights.shape[-1]))
    onehot = torch.nn.functional.one_hot(labels.long().flatten() % (regions + 1), regions + 1).double()
    return flat.T @ onehot


@pytest.mark.parametrize("mode", ["classic", "antialiased"])
def test_evidence_and_pictures_equal_the_python_loops(mode):
    scene = random_scene(60, seed=1, size=0.4)
    cameras = orbit(2, width=37, height=21)  # no multiple of the tile size
    labels = [random_labels(camera, 4, seed=v) for v, camera in enumerate(cameras)]
    exact = [compositing_matrix(scene, camera, mode == "antialiased") for camera in cameras]
    values = torch.rand(60, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    for backend in BACKENDS:
        how = {"backend": backend, "rasterize_mode": mode}
        found = {
            power: rasterize_evidence(scene, cameras, labels, weight_power=power, num_regions=[4, 4], **how)
            for power in (0, 1, 2)
        }
        default = rasterize_evidence(scene, cameras, labels, num_regions=[4, 4], **how)
        assert torch.equal(default.rows.weight, found[1].rows.weight) and default.weight_power == 1
        for view, weights in enumerate(exact):
            for power, evidence in found.items():
                powers = np.where(weights > 0, weights**power, 0)  # of power 0: which pixels it contributes to
                expected, one = _region_sums(powers, labels[view], 4), evidence.select_views([view])
                assert (dense(one.rows, 4) - expected[:, :4]).abs().max() < 1e-12 * expected.max()
                assert (dense(one.unlabeled, 1) - expected[:, 4:]).abs().max() < 1e-12 * expected.max()
                assert expected.max() > 1  # the scene does show something
            matrix = torch.from_numpy(weights)
            image, alpha = render(scene, cameras[view], values, **how)
            assert (image - matrix @ values).abs().max() < 1e-12
            assert (alpha - matrix.sum(-1)).abs().max() < 1e-12
