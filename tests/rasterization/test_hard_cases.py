"""Scenes and inputs that break rasterizers, each with what must come out; tests/test_numerics.py has more of them."""

import pytest
import torch

from normlift_ns import Evidence, GaussianScene, rasterize_evidence, render
from tests.random_scenes import dense, orbit, orbit_camera, random_labels, random_scene, same_evidence


@pytest.fixture(params=["torch", "numba"])
def backend(request: pytest.FixtureRequest) -> str:
    return request.param


def test_views_without_regions_and_regions_without_pixels(backend):
    scene, cameras = random_scene(30, size=0.4), orbit(3)
    blank = torch.full((cameras[0].height, cameras[0].width), -1, dtype=torch.int32)
    labels = [blank, random_labels(cameras[1], 2), blank]
    evidence = rasterize_evidence(scene, cameras, labels, backend=backend, num_regions=[0, 5, 3])
    assert (evidence.num_views, evidence.region_view.tolist()) == (3, [1] * 5 + [2] * 3)
    assert set(evidence.rows.column.tolist()) <= {0, 1}
    assert dense(evidence.unlabeled, 3).sum(0).min() > 0
    none = rasterize_evidence(scene, cameras, [blank] * 3, backend=backend)
    assert (none.nnz, none.num_regions, none.num_views) == (0, 0, 3)
    assert none.view_weights().row_sums().tolist() == [0] * 30
    assert rasterize_evidence(scene, [], [], backend=backend).num_views == 0
    empty = GaussianScene(torch.zeros(0, 3), torch.zeros(0, 4), torch.zeros(0, 3), torch.zeros(0))
    nobody = rasterize_evidence(empty, cameras[:1], labels[1:2], backend=backend)
    assert (nobody.num_gaussians, nobody.num_views, nobody.nnz) == (0, 1, 0)


def test_masked_pixels_are_no_observation(backend):
    scene, camera = random_scene(40, size=0.4), orbit_camera(0.0)
    labels = random_labels(camera, 3)
    labels[:, 20:] = -2
    evidence = rasterize_evidence(scene, [camera], [labels], num_regions=[3], backend=backend)
    _, alpha = render(scene, camera, torch.zeros(40, 1).double(), backend=backend)
    for rows, seen in ((evidence.rows, labels >= 0), (evidence.unlabeled, labels == -1)):
        assert rows.row_sums().sum().item() == pytest.approx((alpha * seen).sum().item(), rel=1e-12)


def test_bitwise_equal_between_runs_and_shards_whatever_the_order_and_progress_is_told(backend):
    scene = random_scene(300, seed=7, dtype=torch.float32, size=0.4)
    cameras = orbit(4)
    labels = [random_labels(camera, 4, seed=v) for v, camera in enumerate(cameras)]
    counts, told = [4] * 4, []
    how = {"backend": backend, "progress": lambda *step: told.append(step)}
    whole = rasterize_evidence(scene, cameras, labels, num_regions=counts, **how)
    again = rasterize_evidence(scene, iter(cameras), (x for x in labels), num_regions=iter(counts), **how)
    assert told == [(1, 4), (2, 4), (3, 4), (4, 4), (1, None), (2, None), (3, None), (4, None)]
    shards = [rasterize_evidence(scene, [c], [x], num_regions=[4], backend=backend) for c, x in zip(cameras, labels)]
    for other in (again, Evidence.merge(*shards)):
        assert same_evidence(whole, other)

    order = torch.randperm(300, generator=torch.Generator().manual_seed(1))
    shuffled = GaussianScene(*(getattr(scene, name)[order] for name in ("means", "quats", "scales", "opacities")))
    other = rasterize_evidence(shuffled, cameras, labels, num_regions=counts, backend=backend)
    assert torch.allclose(dense(other.rows, 16), dense(whole.rows, 16)[order], rtol=1e-4, atol=1e-5)


CAMERA = orbit_camera(0.0)
GOOD = torch.zeros(CAMERA.height, CAMERA.width, dtype=torch.int32)


def test_bad_input_is_named():
    for kwargs, message in (
        ({"labels": [GOOD.float()]}, "labels of view 0 .*integer.*float32"),
        ({"labels": [GOOD[:, 1:]]}, r"labels of view 0 .*\(35, 39\).*\(35, 40\)"),
        ({"labels": [GOOD - 3]}, "labels of view 0 .*-3"),
        ({"labels": [GOOD, GOOD]}, "cameras .* 1 "),
        ({"num_regions": [0]}, r"labels .*\b0\b.*num_regions .*0"),
        ({"num_regions": []}, "num_regions .* 0 "),
        ({"backend": "cuda"}, "backend"),
        ({"rasterize_mode": "smooth"}, "rasterize_mode .*classic.*antialiased"),
        ({"weight_power": 3}, "weight_power .*0, 1 or 2.* 3"),
    ):
        with pytest.raises(ValueError, match=message):
            rasterize_evidence(random_scene(3), [CAMERA], **{"labels": [GOOD], **kwargs})
    with pytest.raises(ValueError, match=r"values .*\[3, C\]"):
        render(random_scene(3), CAMERA, torch.zeros(2, 1))
