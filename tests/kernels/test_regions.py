"""Region sums against the reference rasterizer, in Triton's interpreter where there is no GPU."""

import pytest
import torch

from normlift_ns import Evidence, GaussianScene, RasterSettings, rasterize_evidence
from normlift_ns.core.evidence import MASKED, UNLABELED
from normlift_ns.kernels import compositing
from normlift_ns.rasterization import triton
from normlift_ns.rasterization.rasterize import RasterBatch, RasterJob
from tests.random_scenes import dense, generator, orbit, random_labels, random_scene

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
SETTINGS = RasterSettings()
NEEDLES = 8
"""The first Gaussians of the hard scene."""


def job(scene, antialiased=False, weight_power=1, settings=SETTINGS):
    return RasterJob(scene.to(DEVICE), antialiased, settings, torch.float32, weight_power)


def kernel_evidence(scene, cameras, labels, counts, weight_power=1):
    batch = RasterBatch(cameras, [x.to(DEVICE) for x in labels], counts)
    entries = triton.views_evidence(job(scene, weight_power=weight_power), batch)
    return Evidence.from_entries([entries], len(scene), weight_power=weight_power).to("cpu")


def assert_same(found, expected, regions_in_all, tolerance=2e-6):
    for ours, theirs, columns in (
        (found.rows, expected.rows, regions_in_all),
        (found.unlabeled, expected.unlabeled, expected.num_views),
    ):
        difference = (dense(ours, columns) - dense(theirs, columns)).abs()
        assert difference.max() <= tolerance * max(1.0, float(dense(theirs, columns).max()))
    assert torch.equal(found.region_view, expected.region_view)


def compare(scene, cameras, labels, counts, weight_power=1):
    expected = rasterize_evidence(
        scene, cameras, labels, num_regions=counts, backend="torch", weight_power=weight_power
    )
    assert_same(kernel_evidence(scene, cameras, labels, counts, weight_power), expected, sum(counts))
    return expected


@pytest.mark.parametrize(
    ("splats", "width", "height"), [(25, 21, 17), pytest.param(70, 37, 21, marks=pytest.mark.extra)]
)
def test_two_views_in_flight_equal_the_reference(splats, width, height):
    scene, cameras = random_scene(splats, dtype=torch.float32), orbit(2, width=width, height=height)
    labels = [random_labels(camera, 5, seed=v) for v, camera in enumerate(cameras)]
    labels[1][:4] = MASKED
    for weight_power in (0, 1, 2):
        expected = compare(scene, cameras, labels, [5, 7], weight_power)
        assert expected.nnz > 40
        assert expected.unlabeled.weight.numel() > 5


def hard_scene():
    """Needles, pancakes, giants, a stack at one place, Gaussians about the near plane, opacities at both ends."""
    g = generator(3)
    scene = random_scene(60, seed=3, dtype=torch.float32)
    means, scales, opacities = scene.means.clone(), scene.scales.clone(), scene.opacities.clone()
    scales[:NEEDLES] = torch.tensor([1.0, 1e-4, 1e-4])
    scales[NEEDLES:14] = torch.tensor([0.5, 0.5, 1e-5])  # pancakes
    scales[14:16] = 30.0  # larger than the image
    means[16:26] = torch.tensor([0.1, 0.2, 0.3])  # one place, one depth
    opacities[16:20] = 0.999
    opacities[20:23] = 0.0
    means[26:30] = torch.tensor([0.0, 0.0, -3.99]) + 1e-2 * torch.rand(4, 3, generator=g)  # before the lens
    return GaussianScene(means, scene.quats, scales, opacities)


def test_hard_gaussians_equal_the_reference():
    scene, cameras = hard_scene(), orbit(1, width=18, height=10)
    compare(scene, cameras, [random_labels(cameras[0], 3, seed=1)], [3])


def test_any_number_of_regions():
    scene, cameras = random_scene(10, seed=5, dtype=torch.float32), orbit(1, width=17, height=16)
    value = torch.arange(16 * 17, dtype=torch.int32).view(16, 17)
    for labels in (value, torch.full_like(value, UNLABELED), torch.full_like(value, MASKED)):
        expected = compare(scene, cameras, [labels], [16 * 17])
        assert (expected.nnz > 0) == (labels is value)


def test_chunks_of_tiles_change_nothing_and_keys_are_as_wide_as_they_must_be(monkeypatch):
    scene, cameras = random_scene(20, seed=2, dtype=torch.float32), orbit(1, width=21, height=17)
    labels = torch.stack([random_labels(cameras[0], 4, seed=2)]).to(DEVICE)
    grid, seen, lists = triton.project_and_bin(job(scene), cameras)
    how = {"limits": triton._limits(SETTINGS), "weight_power": 1}
    narrow, wide = (compositing.sum_regions(seen.splats, lists, labels, grid, columns=x, **how) for x in (5, 2**30))
    assert (narrow.key.dtype, wide.key.dtype) == (torch.int32, torch.int64)
    assert torch.equal(narrow.weight, wide.weight)
    assert torch.equal(narrow.key // 5, (wide.key // 2**30).int())
    monkeypatch.setattr(compositing, "_MOST_SLOTS", 50)
    parts = compositing.sum_regions(seen.splats, lists, labels, grid, columns=5, **how)
    assert torch.equal(narrow.weight, parts.weight) and torch.equal(narrow.key, parts.key)
