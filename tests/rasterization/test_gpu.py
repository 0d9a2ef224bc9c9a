"""The GPU backends: what they refuse, and, where there is a GPU, that they agree."""

import threading
from dataclasses import replace
from functools import cache
from importlib.metadata import PackageNotFoundError
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from normlift_ns import Camera, InputError, RasterSettings, nearest_neighbors, rasterize_evidence, render
from normlift_ns.core import device
from normlift_ns.rasterization import gsplat, rasterize, triton
from normlift_ns.rasterization.rasterize import RasterJob
from tests.captures import SHARED, needs_shared, trained_scene, training_cameras, weight_fixtures
from tests.kernels.test_regions import hard_scene
from tests.random_scenes import dense, generator, orbit, random_labels, random_scene
from tests.rasterization.test_gsplat_fixtures import weight_errors

needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device: the kernels cannot run")


@cache
def compiled_gsplat() -> bool:
    """Whether gsplat's compiled part is there, or can be made now."""
    try:
        from gsplat.cuda._backend import _C  # noqa: PLC0415
    except ImportError:
        return False
    return _C is not None


@pytest.mark.parametrize("backend", ["triton", "gsplat"])
def test_gpu_backends_refuse_other_scenes(backend, monkeypatch):
    scene, cameras = random_scene(5, dtype=torch.float32), orbit(1)
    labels = [random_labels(cameras[0], 2)]
    for dtype in (torch.float32, torch.float64):
        told = rf'"{backend}".* float32 on a GPU.* {str(dtype).removeprefix("torch.")} on cpu'
        with pytest.raises(ValueError, match=told):
            rasterize_evidence(scene, cameras, labels, backend=backend, dtype=dtype)
        with pytest.raises(ValueError, match=told):
            render(scene, cameras[0], torch.ones(5, 1), backend=backend, dtype=dtype)
    if backend == "gsplat":
        monkeypatch.setattr(gsplat, "check_gpu", lambda *_: None)
        with pytest.raises(ValueError, match=r"weight_power.* 2;.*backend='auto'"):
            gsplat.check(replace(job(scene), weight_power=2))


def job(scene, **constants):
    return RasterJob(scene, False, RasterSettings(**constants), torch.float32)


def test_gpu_backends_draw_what_their_kernels_can(monkeypatch):
    for backend in (gsplat, triton):
        monkeypatch.setattr(backend, "check_gpu", lambda *_: None)
    scene = random_scene(5, dtype=torch.float32)
    gsplat.check(job(scene, eps2d=0.1))
    with pytest.raises(ValueError, match=r"3D Gaussians only; use backend='auto'"):
        gsplat.check(job(replace(scene, primitive="2dgs")))
    triton.check(job(scene, max_alpha=0.99, tile_size=32))
    with pytest.raises(ValueError, match=r"tile_size .*power of two.* 20;"):
        triton.check(job(scene, tile_size=20))
    for installed, rules, changed in (
        ("1.4.0", "1.4", None),
        ("1.4.0", "1.5", "per_axis, radius_sigmas"),
        ("1.5.3", "1.4", None),
        ("1.5.3", "1.6", "min_compensation, max_alpha"),
        ("1.6.0", "1.4", "min_compensation, max_alpha"),
        ("1.6.0", "1.6", None),
    ):
        monkeypatch.setattr(gsplat, "installed_gsplat_version", lambda installed=installed: installed)
        wanted = RasterJob(scene, False, RasterSettings.of_gsplat(rules), torch.float32)
        if changed is None:
            gsplat.check(wanted)
        else:
            with pytest.raises(ValueError, match=rf"gsplat {installed} .* {changed} .*'triton'"):
                gsplat.check(wanted)


def test_before_triton_3_a_gpu_rasterizes_with_stock_gsplat(monkeypatch):
    """A Triton without version is taken."""
    means = SimpleNamespace(device=torch.device("cuda"), is_cuda=True, dtype=torch.float32)
    scene = SimpleNamespace(means=means)
    on_gpu: Any = SimpleNamespace(scene=scene, dtype=torch.float32, is_2d=False, weight_power=1)
    monkeypatch.setattr(rasterize, "has_triton", device.has_triton.__wrapped__)
    for installed, taken in (("3.0.0", True), ("3.6.0", True), ("", True), ("2.3.1", False), (None, False)):

        def version(name, installed=installed):
            if not installed:
                raise PackageNotFoundError(name)
            return installed

        monkeypatch.setattr(device, "version", version)
        monkeypatch.setattr(device, "find_spec", lambda name, found=installed is not None: found or None)
        assert rasterize._fastest(on_gpu) == ("triton" if taken else "gsplat"), installed
        if not taken:
            with pytest.raises(InputError, match=r"Triton 3, .*PyTorch 2\.4"):
                rasterize.choose_backend("triton", on_gpu)
        for change in ({"is_2d": True}, {"weight_power": 2}):
            job_of_torch: Any = SimpleNamespace(**{**vars(on_gpu), **change})
            assert rasterize._fastest(job_of_torch) == ("triton" if taken else "torch"), (installed, change)


def test_a_gpu_that_cannot_start_is_told_of_where_it_is_wanted(monkeypatch):
    told = []
    monkeypatch.setattr(threading, "excepthook", told.append)
    before = set(threading.enumerate())
    device.init_cuda("cuda:99")
    for thread in set(threading.enumerate()) - before:
        thread.join()
    assert told == []


def test_views_in_flight_are_as_many_as_short_numbers_and_memory_hold():
    sizes = ((10, 64, 64, 16), (10, 988, 731, 11), (10**7, 988, 731, 5), (3 * 10**7, 64, 64, 2), (10, 9000, 9000, 1))
    for gaussians, width, height, views in sizes:
        camera = Camera(torch.eye(3), torch.eye(4), width, height)
        assert triton.in_flight(job(range(gaussians)), camera) == views, (gaussians, width)


def test_a_missing_or_unknown_gsplat_is_said(monkeypatch):
    def missing(name):
        raise PackageNotFoundError(name)

    for version, told in ((missing, "not installed"), (lambda name: "7.1.0", r"7\.1\.0.* 1\.4, 1\.5, 1\.6")):
        gsplat.installed_gsplat_version.cache_clear()
        monkeypatch.setattr(gsplat, "version", version)
        with pytest.raises(ValueError, match=told):
            gsplat.installed_settings()
    gsplat.installed_gsplat_version.cache_clear()


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
        for backend in ("triton", "torch", *(["gsplat"] if compiled_gsplat() else []))
    }
    # float32 loses most digits of a needle's determinant, on which antialiasing scales its opacity; the reference does
    # not lose the same ones.
    of_reference = 5e-5 if (kind, mode) == ("hard", "antialiased") else 1e-5

    ours = found.pop("triton")
    for name, theirs in found.items():
        tolerance = of_reference if name == "torch" else 1e-5
        for *pair, columns in ((ours.rows, theirs.rows, 4 * regions), (ours.unlabeled, theirs.unlabeled, 4)):
            a, b = (dense(x.to("cpu"), columns) for x in pair)
            assert (a - b).norm() <= tolerance * b.norm(), name
            assert abs(a.sum() / b.sum() - 1) < 0.2 * tolerance, name
    again = rasterize_evidence(scene, cameras, labels, num_regions=counts, rasterize_mode=mode)
    assert torch.equal(again.rows.weight, ours.rows.weight)
    assert torch.equal(again.rows.column, ours.rows.column)


@needs_gpu
@pytest.mark.parametrize("mode", ["classic", "antialiased"])
@pytest.mark.parametrize("kind", ["random", "hard", "fox"])
def test_projection_is_that_of_gsplat_bit_for_bit(kind, mode):
    if not compiled_gsplat():
        pytest.skip("no compiled gsplat")
    camera = orbit(1, width=333, height=201, focal=300.0)[0]
    if kind == "fox":
        if not SHARED.is_dir():
            pytest.skip(f"needs {SHARED}")
        scene, camera = trained_scene("fox"), training_cameras("fox")[3]
    else:
        scene = hard_scene() if kind == "hard" else random_scene(20_000, seed=1, dtype=torch.float32, size=0.05)
    rules = gsplat.installed_settings()
    ready = RasterJob(scene.to("cuda"), mode == "antialiased", rules, torch.float32)
    _, seen, _ = triton.project_and_bin(ready, [camera])
    theirs = gsplat.project_views(ready, [camera])
    drawn = (theirs.radii[0].view(len(scene), -1) > 0).all(1) & (theirs.opacities[0] >= rules.min_alpha)
    found = torch.zeros_like(drawn)
    found[seen.keys] = True
    both = found & drawn
    row, splat = (found.cumsum(0) - 1)[both], seen.splats
    ours = {
        "means2d": (splat[:, 0:2], theirs.means2d),
        "conics": (torch.stack([2 * splat[:, 2], splat[:, 4], 2 * splat[:, 3]], 1), theirs.conics),
        "opacities": (splat[:, 5], theirs.opacities),
        "depths": (seen.depth, theirs.depths),
        "radii": (splat[:, 6:8], theirs.radii.view(1, len(scene), -1).expand(-1, -1, 2).float()),
    }
    assert torch.equal(found, drawn)
    for name, (mine, other) in ours.items():
        assert torch.equal(mine[row], other[0][both]), name


@needs_gpu
@needs_shared
def test_weights_on_the_gpu_are_those_of_gsplat_1_4():
    for path in weight_fixtures():
        scene = trained_scene(path.stem.split("_")[0]).to("cuda")
        frobenius, _, total, _ = weight_errors(path, scene, "triton")
        assert frobenius <= 1e-5 and total < 1e-6, f"{path.stem}: Frobenius {frobenius:.1e}, total {total:.1e}"


@needs_gpu
@pytest.mark.parametrize("channels", [0, 1, 3, 40])
@pytest.mark.parametrize("backend", ["triton", "gsplat"])
def test_pictures_are_those_of_the_reference(channels, backend):
    if backend == "gsplat" and not compiled_gsplat():
        pytest.skip("no compiled gsplat")
    scene = hard_scene()
    scene.scales[0], scene.scales[1], scene.quats[2], scene.means[3, 0] = 4.8e8, 1e12, 0.0, torch.nan
    scene, camera = scene.to("cuda"), orbit(1, width=333, height=201, focal=300.0)[0]
    values = torch.rand(len(scene), channels, generator=generator(0)).cuda()
    found, expected = (render(scene, camera, values, backend=name) for name in (backend, "torch"))
    assert expected[1].max() > 0.1
    for ours, theirs in zip(found, expected):
        assert ours.shape == theirs.shape
        if channels > 0:
            assert (ours - theirs).norm() <= 1e-4 * theirs.norm()


@needs_gpu
def test_neighbours_that_the_kernel_is_not_sure_of_come_from_the_cpu():
    lattice = torch.cartesian_prod(*[torch.arange(9.0)] * 3)
    uneven = torch.randn(50_000, 3, generator=generator(0)) ** 5
    lattice[5], uneven[17] = torch.nan, torch.inf
    for points in (lattice, uneven):
        found, expected = nearest_neighbors(points.cuda(), 36), nearest_neighbors(points, 36)
        assert torch.equal(found.index.cpu(), expected.index)
        assert torch.allclose(found.spacing.cpu(), expected.spacing, rtol=1e-15, atol=0)
