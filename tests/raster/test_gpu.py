"""The GPU backends: what they refuse, and, where there is a GPU, that they agree."""

from dataclasses import replace

import pytest
import torch

from normlift_ns import Camera, RasterSettings, lift, nearest_neighbors, rasterize_evidence, refine, render
from normlift_ns.core import gpu
from normlift_ns.raster import gsplat
from normlift_ns.raster.backend import Batch, Job
from tests.kernels.test_regions import hard_scene
from tests.scenes import dense, generator, orbit, random_labels, random_scene, unit_rows

needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device: gsplat's kernels cannot run")


@pytest.mark.parametrize("backend", ["triton", "gsplat"])
def test_gpu_backends_refuse_other_scenes(backend):
    scene, cameras = random_scene(5, dtype=torch.float32), orbit(1)
    labels = [random_labels(cameras[0], 2)]
    with pytest.raises(ValueError, match=r"this scene is torch.float32 on cpu.* Move it .* backend=\"torch\""):
        rasterize_evidence(scene, cameras, labels, backend=backend)
    with pytest.raises(ValueError, match=r"computes in float32 on a GPU; .* wanted is torch.float64"):
        rasterize_evidence(scene, cameras, labels, backend=backend, dtype=torch.float64)


def test_triton_draws_no_pictures():
    scene = random_scene(5, dtype=torch.float32)
    with pytest.raises(ValueError, match='backend "triton" sums evidence and draws no pictures'):
        render(scene, orbit(1)[0], torch.ones(5, 1), backend="triton")


def test_gradients_are_of_weights_only():
    with pytest.raises(ValueError, match=r'weight_power 2 is not a gradient; use backend="triton"'):
        gsplat.views_evidence(replace(job(random_scene(5)), weight_power=2), Batch([], [], []))


def job(scene, **constants):
    return Job(scene, False, RasterSettings(**constants), torch.float32)


class OnGpu:
    """What `check` looks at, of a scene on a GPU."""

    means = torch.zeros(1, 3, device="meta")


def test_other_versions_and_constants_of_gsplat_are_refused(monkeypatch, unchecked):
    scene = OnGpu()
    monkeypatch.setattr(type(scene.means), "device", torch.device("cuda"), raising=False)
    gsplat.check(job(scene, eps2d=0.1))
    with pytest.raises(ValueError, match=r"gsplat has compiled its max_alpha"):
        gsplat.check(job(scene, max_alpha=0.99))
    monkeypatch.setattr(gsplat, "_gsplat_version", lambda: "1.5.2")
    with pytest.raises(ValueError, match=r'gsplat 1\.5\.2 is installed.*pip install "gsplat==1\.4\.0"'):
        gsplat.check(job(scene))


def test_a_full_gpu_is_answered_by_smaller_parts():
    asked = []

    def run(items):
        asked.append(len(items))
        if len(items) > 2:
            raise torch.OutOfMemoryError("no room")
        return sum(items)

    assert gpu.in_parts(run, [1, 2, 3, 4, 5], "buy memory") == [3, 3, 9]
    assert asked == [5, 2, 3, 1, 2]

    def never(items):
        raise torch.OutOfMemoryError("no room")

    with pytest.raises(MemoryError, match=r"memory is full \(no room\); buy memory"):
        gpu.in_parts(never, [1, 2], "buy memory")


@needs_gpu
@pytest.mark.parametrize("regions", [1, 40, 5000])
@pytest.mark.parametrize("mode", ["classic", "antialiased"])
@pytest.mark.parametrize("kind", ["random", "hard"])
def test_all_backends_agree(regions, mode, kind):
    scene = hard_scene() if kind == "hard" else random_scene(3000, seed=1, dtype=torch.float32, size=0.05)
    scene = scene.to("cuda")
    cameras = orbit(3, width=333, height=201, focal=300.0)
    cameras.append(Camera(cameras[0].K, cameras[0].world_to_camera, 100, 64))  # of another size
    labels = [random_labels(camera, regions, seed=v, cell=2) for v, camera in enumerate(cameras)]
    labels[1][:] = -1
    counts = [regions] * 4
    found = {
        backend: rasterize_evidence(scene, cameras, labels, num_regions=counts, backend=backend, rasterize_mode=mode)
        for backend in ("triton", "gsplat", "torch")
    }
    # float32 loses most digits of a needle's determinant, on which antialiasing scales its opacity
    tolerance = 5e-5 if (kind, mode) == ("hard", "antialiased") else 1e-5

    def assert_close(a, b, tolerance):
        for *pair, columns in ((a.rows, b.rows, 4 * regions), (a.unlabeled, b.unlabeled, 4)):
            ours, theirs = (dense(x.to("cpu"), columns) for x in pair)
            assert (ours - theirs).norm() <= tolerance * theirs.norm()
            assert abs(ours.sum() / theirs.sum() - 1) < 0.2 * tolerance

    assert_close(found["triton"], found["torch"], tolerance)
    assert_close(found["triton"], found["gsplat"], 1e-5)
    again = rasterize_evidence(scene, cameras, labels, num_regions=counts, rasterize_mode=mode)
    assert torch.equal(again.rows.weight, found["triton"].rows.weight)
    assert torch.equal(again.rows.column, found["triton"].rows.column)


@needs_gpu
@pytest.mark.parametrize("channels", [0, 1, 40])
def test_gsplat_draws_the_pictures_of_the_reference(channels):
    scene = hard_scene()
    scene.scales[0], scene.scales[1], scene.quats[2], scene.means[3, 0] = 4.8e8, 1e12, 0.0, torch.nan
    scene, camera = scene.to("cuda"), orbit(1, width=333, height=201, focal=300.0)[0]
    values = torch.rand(len(scene), channels, generator=generator(0)).cuda()
    found, expected = (render(scene, camera, values, backend=backend) for backend in ("gsplat", "torch"))
    assert expected[1].max() > 0.1
    for ours, theirs in zip(found, expected):
        assert ours.shape == theirs.shape
        if channels > 0:
            assert (ours - theirs).norm() <= 1e-4 * theirs.norm()


@needs_gpu
def test_the_whole_lift_equals_that_of_the_cpu():
    scene, cameras = (
        random_scene(4000, seed=2, dtype=torch.float32, size=0.05),
        orbit(4, width=160, height=120, focal=150),
    )
    labels = [random_labels(camera, 9, seed=v) for v, camera in enumerate(cameras)]
    table = unit_rows(36, 512, 1, torch.float32)
    results = []
    for device in ("cpu", "cuda"):
        there = scene.to(device)
        lifted = lift(rasterize_evidence(there, cameras, labels, num_regions=[9] * 4), table.to(device))
        neighbors = nearest_neighbors(there.means, 36)
        source = refine(there.means, lifted.directions, lifted.scalars.reliability, neighbors=neighbors)
        results.append(
            [x.cpu() for x in (lifted.scalars.reliability, neighbors.index, lifted.directions(source.long()))]
        )
    (reliability, index, refined), (reliability_gpu, index_gpu, refined_gpu) = results
    assert (reliability - reliability_gpu).abs().max() < 1e-4
    assert torch.equal(index, index_gpu)
    assert ((refined - refined_gpu).norm(dim=1) > 1e-3).float().mean() < 0.01


@needs_gpu
def test_neighbours_that_the_kernel_is_not_sure_of_come_from_the_cpu():
    points = torch.cartesian_prod(*[torch.arange(9.0)] * 3)
    points[5] = torch.nan
    found, expected = nearest_neighbors(points.cuda(), 12), nearest_neighbors(points, 12)
    assert torch.equal(found.index.cpu(), expected.index)
    uneven = torch.randn(50_000, 3, generator=generator(0)) ** 5
    uneven[17] = torch.inf
    found, expected = nearest_neighbors(uneven.cuda(), 36), nearest_neighbors(uneven, 36)
    assert torch.equal(found.index.cpu(), expected.index)
    assert torch.allclose(found.spacing.cpu(), expected.spacing, rtol=1e-15, atol=0)
