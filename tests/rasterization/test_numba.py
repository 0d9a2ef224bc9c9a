"""The compiled CPU rasterizer: what its shortcuts leave out is nothing, and its kernels come from the cache."""

import os
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numba
import numpy as np
import pytest
import torch

import normlift_ns
from normlift_ns import GaussianScene, RasterSettings, rasterize_evidence, render
from normlift_ns.rasterization import numba as backend
from normlift_ns.rasterization.numba import cached_njit
from normlift_ns.rasterization.projection import assign_tiles
from normlift_ns.rasterization.rasterize import RasterBatch, RasterJob
from tests.processes import run
from tests.random_scenes import dense, generator, orbit_camera, random_labels, random_scene

SETTINGS = RasterSettings()


def shapes_of_all_kinds(n: int, seed: int, dtype: torch.dtype) -> GaussianScene:
    """Needles, pancakes, points and sheets larger than the image, of any opacity."""
    g = generator(seed)
    random = random_scene(n, seed=seed, dtype=torch.float64)
    scales = 10 ** (4 * torch.rand(n, 3, generator=g, dtype=torch.float64) - 3)
    opacities = 10 ** (-3 * torch.rand(n, generator=g, dtype=torch.float64))
    return GaussianScene(*(x.to(dtype) for x in (random.means, random.quats, scales, opacities)))


@pytest.mark.parametrize("primitive", ["3dgs", "2dgs"])
@pytest.mark.parametrize(("dtype", "seed"), [(torch.float32, 0), (torch.float64, 1)])
def test_culling_of_tiles_and_rows_leaves_the_sums_bitwise(dtype, seed, primitive):
    camera = orbit_camera(0.4, width=75, height=53)
    labels = random_labels(camera, 6, seed=seed)
    job = RasterJob(replace(shapes_of_all_kinds(300, seed, dtype), primitive=primitive), False, SETTINGS, dtype)
    projected = job.project(camera)
    arrays, limits, (_, culled, shapes) = backend._tiles(projected, camera, SETTINGS)
    tiles = assign_tiles(projected, camera.width, camera.height, 16)
    assert len(culled) < 0.9 * len(tiles.indices)
    offsets, members = tiles.offsets.numpy(), tiles.indices.numpy()
    everywhere = np.zeros_like(shapes)
    everywhere[:, 2] = np.inf  # every row of a tile
    most = np.diff(offsets) * backend.count_labels(labels.numpy(), 16)
    first, used = np.cumsum(most) - most, np.zeros(len(most), np.int64)
    slots = tuple(np.empty(most.sum(), t) for t in (np.int32, np.int32, np.float64))
    regions = (projected.gaussian.numpy(), labels.numpy(), 1, 16)
    backend.sum_tiles(offsets, members, *arrays, everywhere, *regions, limits, first, used, slots, 3)
    expected = backend.merge_slots(first, used, slots, 300, 7)
    found = backend.views_evidence(job, RasterBatch([camera], [labels], [6]))
    for got, exact in zip(found[:3], expected):
        assert torch.equal(got, torch.from_numpy(exact).to(got.dtype))
    assert len(found.weight) > 300


@pytest.mark.parametrize(
    ("primitive", "dtype", "close"),
    [("3dgs", torch.float64, 1e-12), ("2dgs", torch.float64, 1e-12), ("2dgs", torch.float32, 1e-4)],
)
def test_equals_the_reference_whatever_the_tile_and_the_labels(primitive, dtype, close):
    """Also where each pixel is a region of its own."""
    scene = replace(shapes_of_all_kinds(80, 5, dtype), primitive=primitive)
    camera, values = orbit_camera(0.4, width=45, height=38), torch.rand(80, 3, generator=generator(1), dtype=dtype)
    every = torch.arange(45 * 38, dtype=torch.int32).view(38, 45)
    for size, power, regions in ((5, 0, 3), (16, 0, 1), (16, 2, 40), (16, 1, 45 * 38), (20, 1, 1), (20, 2, 3)):
        labels = [random_labels(camera, regions) if regions < every.numel() else every]
        rules = replace(SETTINGS, tile_size=size)
        how = {"num_regions": [regions], "weight_power": power, "settings": rules}
        found, expected = (
            dense(rasterize_evidence(scene, [camera], labels, backend=name, **how).rows, regions)
            for name in ("numba", "torch")
        )
        assert (found - expected).abs().max() < close * expected.max(), (size, power, regions)
        pictures = [render(scene, camera, values, settings=rules, backend=name) for name in ("numba", "torch")]
        for got, exact in zip(*pictures):
            assert (got - exact).abs().max() < max(close, 1e-6), size


def test_any_number_of_threads_gives_the_same_bits():
    scene, camera = random_scene(200, seed=3, dtype=torch.float32, size=0.4), orbit_camera(0.3, width=70, height=50)
    labels, before = [random_labels(camera, 5)], numba.get_num_threads()
    try:
        found = []
        for threads in {1, before}:
            numba.set_num_threads(threads)
            found.append(rasterize_evidence(scene, [camera], labels, backend="numba").rows.weight)
    finally:
        numba.set_num_threads(before)
    assert all(torch.equal(found[0], other) for other in found)


@pytest.mark.parametrize(("dtype", "bound"), [(np.float32, 1e-7), (np.float64, 4e-16)])
def test_exp_is_exact_to_the_last_bits(dtype, bound):
    """Against a wider format, in the range that a pixel can feel and beyond."""

    @numba.njit
    def fill(values, found):
        for i in range(len(values)):
            found[i] = backend.exp(values[i])

    draw = np.random.default_rng(0)
    x = np.concatenate([[0, -1e30, -np.inf], *(draw.uniform(low, 0, 100_000) for low in (-1e-3, -6.0, -80.0))])
    x, found = x.astype(dtype), np.empty(len(x), np.float64)
    fill(x, found)
    assert np.array_equal(found, found.astype(dtype))
    assert found[0] == 1 and max(found[1:3]) < 1e-37
    assert np.abs(found / np.exp(x.astype(np.longdouble)) - 1)[3:].max() < bound


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_what_is_warmed_is_what_is_called(dtype):
    """A call after `warm` finds every kernel with its types: it adds no signature."""
    backend.compile_kernels(dtype).join()
    before = {kernel: list(kernel.signatures) for kernel, _ in backend.kernel_signatures(dtype)}
    scene, camera = random_scene(20, dtype=dtype, size=0.4), orbit_camera(0.0)
    rasterize_evidence(scene, [camera], [random_labels(camera, 3)], backend="numba")
    render(scene, camera, torch.ones(20, 1, dtype=dtype), backend="numba")
    assert {kernel: list(kernel.signatures) for kernel in before} == before


CHILD = """
import sys, torch
from normlift_ns.rasterization import numba as backend
pairs = backend.kernel_signatures(torch.float32)[int(sys.argv[1]):]
for kernel, signature in pairs:
    kernel.compile(signature)
stats = [kernel.stats for kernel, _ in pairs]
print(sum(sum(s.cache_hits.values()) for s in stats), sum(sum(s.cache_misses.values()) for s in stats))
print(stats[-1].cache_path)
"""


@pytest.mark.slow
def test_a_second_process_compiles_nothing_even_beside_code_that_cannot_be_written(tmp_path):
    """Where no folder for bytecode can be made beside the code, numba keeps its cache in the user's folder.

    The last kernel shows it: all of them take a minute. Beside the code, all are found that were compiled once.
    """

    def hits_and_misses(first_kernel: int) -> tuple[str, Path]:
        counts, path = run(sys.executable, "-c", CHILD, first_kernel, cwd=tmp_path, env=environment).split("\n")[:2]
        return counts, Path(path)

    environment = {**os.environ, "PYTHONPATH": str(Path(normlift_ns.__file__).parents[1])}
    environment.pop("NUMBA_CACHE_DIR", None)
    backend.compile_kernels(torch.float32).join()
    assert hits_and_misses(0)[0] == "5 0"
    package = tmp_path / "installed" / "normlift_ns"
    shutil.copytree(Path(normlift_ns.__file__).parent, package, ignore=shutil.ignore_patterns("__pycache__"))
    (package / "rasterization" / "__pycache__").write_bytes(b"")
    environment |= {"PYTHONPATH": str(package.parent), "XDG_CACHE_HOME": str(tmp_path / "cache")}
    (first, path), (second, _) = hits_and_misses(-1), hits_and_misses(-1)
    assert [first, second] == ["0 1", "1 0"]
    assert path.is_relative_to(tmp_path / "cache")


def test_without_a_place_for_a_cache_kernels_are_compiled_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    njit, asked = numba.njit, []

    def nowhere(cache: bool = False, **options: object):
        asked.append(cache)
        if cache:
            raise RuntimeError("cannot cache function 'twice': no locator available for file 'twice.py'")
        return njit(**options)

    with monkeypatch.context() as patch:
        patch.setattr(numba, "njit", nowhere)
        twice = cached_njit()(lambda x: 2 * x)
    assert twice(21) == 42
    assert asked == [True, False]
