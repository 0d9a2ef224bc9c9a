"""Lists of splats by cell: those of gsplat's tiles, without the cells that no pixel feels."""

import itertools

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from normlift_ns import Camera, GaussianScene, RasterSettings
from normlift_ns.rasterization import triton
from normlift_ns.rasterization.projection import assign_tiles, camera_depths, prepare_gaussians, project
from normlift_ns.rasterization.rasterize import RasterBatch, RasterJob
from tests.examples import examples
from tests.kernels.test_regions import DEVICE, NEEDLES, hard_scene
from tests.random_scenes import generator, orbit, random_labels, random_scene

RULES = ("1.4", "1.5", "1.6")


def see(scene, cameras, rules="1.4", antialiased=False, cull=True):
    job = RasterJob(scene.to(DEVICE), antialiased, RasterSettings.of_gsplat(rules), torch.float32)
    grid, seen, lists = triton.project_and_bin(job, cameras, cull=cull)
    return grid, *(type(x)(*(y.cpu() for y in x)) for x in (seen, lists))


def pairs(lists):
    cell = torch.repeat_interleave(torch.arange(len(lists.offsets) - 1), lists.offsets.diff())
    return list(zip(cell.tolist(), lists.members.tolist()))


ALL = list(itertools.product(("random", "hard"), (False, True), RULES[:2]))


@pytest.mark.parametrize(
    ("kind", "antialiased", "rules"),
    [ALL[0], ALL[-1], *(pytest.param(*case, marks=pytest.mark.extra) for case in ALL[1:-1])],
)
def test_lists_are_those_of_the_reference(kind, antialiased, rules, monkeypatch):
    monkeypatch.setattr(triton, "CELL", (16, 16))
    scene = random_scene(70, dtype=torch.float32) if kind == "random" else hard_scene()
    cameras = orbit(2, width=37, height=21)
    grid, seen, lists = see(scene, cameras, rules, antialiased, cull=False)
    constants = RasterSettings.of_gsplat(rules)
    bounds = lists.offsets.tolist()
    for view, camera in enumerate(cameras):
        projected = project(prepare_gaussians(scene, torch.float32), camera, constants, antialiased)
        tiles = assign_tiles(projected, camera.width, camera.height, constants.tile_size)
        faint = projected.opacities < constants.min_alpha  # no pixel draws them
        for tile in range(grid.cells):
            there = tiles.indices[tiles.offsets[tile] : tiles.offsets[tile + 1]].long()
            place = view * grid.cells + tile
            splats = lists.members[bounds[place] : bounds[place + 1]].long()
            ours, theirs = seen.keys[splats] // 2, projected.gaussian[there[~faint[there]]]
            assert torch.equal(seen.depth[splats], camera_depths(scene.means, camera)[ours])  # rounded as by CUDA
            if (kind, antialiased) == ("hard", True):  # no digit of a needle's determinant, and so of its opacity
                ours, theirs = ours[ours >= NEEDLES], theirs[theirs >= NEEDLES]
            assert torch.equal(ours, theirs)
            assert (seen.keys[splats] % 2 == view).all()


def felt(grid, splat, camera, min_alpha):
    """Cells with a pixel whose alpha is at least `min_alpha`, in float64, but for a last digit of float32."""
    u, v, a, c, b, opacity = splat.double()[:6]
    x, y = torch.arange(camera.width).double() + 0.5 - u, (torch.arange(camera.height).double() + 0.5 - v)[:, None]
    alpha = opacity * torch.exp(-(a * x * x + c * y * y + b * x * y))
    row, column = (alpha >= min_alpha * (1 + 1e-6)).nonzero(as_tuple=True)
    return set((row // grid.cell_height * grid.across + column // grid.cell_width).tolist())


@pytest.mark.parametrize("kind", ["random", "hard"])
def test_only_cells_that_no_pixel_feels_are_left_out(kind):
    scene = random_scene(60, seed=4, dtype=torch.float32, size=0.6) if kind == "random" else hard_scene()
    cameras = orbit(1, width=70, height=41)
    grid, seen, lists = see(scene, cameras)
    _, _, whole = see(scene, cameras, cull=False)
    kept, all_pairs = set(pairs(lists)), set(pairs(whole))
    assert kept < all_pairs
    needed = {(cell, row) for row, splat in enumerate(seen.splats) for cell in felt(grid, splat, cameras[0], 1 / 255)}
    assert needed & all_pairs <= kept
    assert len(kept - needed) < 0.005 * len(needed)


def wild_scene(seed: int) -> GaussianScene:
    """Needles, giants, dots, faint ones, off screen, before the lens."""
    scene, g = random_scene(14, seed=seed, dtype=torch.float32, size=0.5), generator(seed)
    scene.scales[:] *= 10 ** (8 * torch.rand(14, 3, generator=g) - 6)
    scene.scales[:2] = torch.tensor([[4.8e8, 1e8, 3e8], [1e3, 1e-6, 1e-6]])
    scene.means[2:4, 2] = -4 + 0.02 * torch.rand(2, generator=g)
    scene.means[4:6] *= 20
    scene.opacities[8:12] = torch.tensor([1 / 255, 1 / 254, 0.0039, 1.0])
    return scene


@examples(2)
@given(seed=st.integers(0, 2**31), rules=st.sampled_from(RULES), antialiased=st.booleans())
def test_leaving_cells_out_changes_no_bit(seed, rules, antialiased):
    scene = wild_scene(seed)
    cameras = orbit(1, width=20, height=18)
    labels = [random_labels(cameras[0], 3, seed=seed).to(DEVICE)]
    job = RasterJob(scene.to(DEVICE), antialiased, RasterSettings.of_gsplat(rules), torch.float32)
    found, whole = (triton.views_evidence(job, RasterBatch(cameras, labels, [3]), cull=cull) for cull in (True, False))
    for ours, theirs in zip(found[:3], whole[:3]):
        assert torch.equal(ours, theirs)


def test_an_empty_scene_and_an_empty_view():
    empty = GaussianScene(torch.zeros(0, 3), torch.zeros(0, 4), torch.zeros(0, 3), torch.zeros(0))
    far = random_scene(3, dtype=torch.float32)
    far.means[:] = torch.tensor([0.0, 0.0, -9.0])
    camera = orbit(1, width=20, height=9)[0]
    for scene in (empty, far):
        grid, seen, lists = see(scene, [camera])
        assert (len(seen.keys), len(lists.members), len(lists.offsets)) == (0, 0, grid.cells + 1)
        job = RasterJob(scene.to(DEVICE), False, RasterSettings(), torch.float32)
        entries = triton.views_evidence(job, RasterBatch([camera], [random_labels(camera, 3).to(DEVICE)], [3]))
        assert len(entries.weight) == 0
        image, alpha = triton.composite(job, camera, torch.ones(len(scene), 2, device=DEVICE))
        assert image.shape == (camera.height, camera.width, 2)
        assert float(image.abs().sum() + alpha.abs().sum()) == 0


def test_many_cells_need_wider_keys():
    scene = random_scene(3, dtype=torch.float32, size=0.07)
    camera = orbit(1, width=3000, height=3000, focal=3000.0)[0]  # 35,344 cells, or twice as many halves
    small = Camera(torch.diag(torch.tensor([1 / 40, 1 / 40, 1]).double()) @ camera.K, camera.world_to_camera, 75, 75)
    _, seen, lists = see(scene, [camera])
    assert len(lists.offsets) - 1 > 2**15
    _, few, _ = see(scene, [small])
    assert torch.equal(seen.keys, few.keys)
    counts = torch.bincount(lists.members, minlength=len(seen.keys))
    assert counts.max() > 100
