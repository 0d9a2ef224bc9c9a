"""The rules of gsplat 1.4, 1.5 and 1.6 against formulas of their own, and how stock gsplat of any version is called."""

import itertools
import sys
from types import ModuleType, SimpleNamespace

import pytest
import torch

from normlift_ns import GaussianScene, RasterSettings, rasterize_evidence, render
from normlift_ns.options import GSPLAT_VERSIONS
from normlift_ns.rasterization import gsplat, triton
from normlift_ns.rasterization.projection import assign_tiles, prepare_gaussians, project
from normlift_ns.rasterization.rasterize import RasterBatch, RasterJob
from tests.kernels.test_regions import DEVICE, hard_scene
from tests.random_scenes import dense, generator, orbit, random_labels, random_scene
from tests.rasterization.oracle import compositing_matrix


def telling_scene() -> GaussianScene:
    """Needles, and opaque and faint discs whose edges lie about those of tiles: every rule changes what is drawn."""
    scene = random_scene(18, seed=3, size=0.9)
    scene.scales[:6, 1:] *= 0.02
    scene.scales[6:] = torch.linspace(0.15, 0.8, 12, dtype=torch.float64)[:, None]
    scene.means[6:, 0] = torch.linspace(-2, 2, 12, dtype=torch.float64)
    scene.means[6:, 2] = torch.linspace(-0.2, 0.2, 12, dtype=torch.float64)
    scene.opacities[6:] = torch.tensor([1.0, 0.9999, 0.02, 0.004, 0.999, 0.98], dtype=torch.float64).repeat(2)
    return scene


def drawn_by(rules: str, antialiased: bool):
    """What must come of the telling scene: its weights, labels of four regions, and the evidence of all powers of the
    weights: pixels without a label, then the regions.
    """
    scene, (camera,) = telling_scene(), orbit(1, width=50, height=41)
    weights = torch.from_numpy(compositing_matrix(scene, camera, antialiased, rules))
    labels = random_labels(camera, 4, seed=1)
    powers = [torch.where(weights > 0, weights**power, 0) for power in (0, 1, 2)]  # 0: the pixels it contributes to
    there = [(labels == region)[:, :, None] for region in range(-1, 4)]
    return scene, camera, labels, weights, [torch.stack([(x * y).sum((0, 1)) for y in there], 1) for x in powers]


@pytest.mark.parametrize("antialiased", [False, True])
def test_every_backend_draws_by_the_rules_and_these_differ(antialiased):
    found, values = [], torch.rand(18, 3, generator=generator(0), dtype=torch.float64)
    for rules in GSPLAT_VERSIONS:
        scene, camera, labels, weights, sums = drawn_by(rules, antialiased)
        found.append(weights)
        for backend in ("torch", "numba"):
            mode = "antialiased" if antialiased else "classic"
            how = {"backend": backend, "rasterize_mode": mode, "settings": RasterSettings.of_gsplat(rules)}
            for power, expected in enumerate(sums):
                evidence = rasterize_evidence(scene, [camera], [labels], num_regions=[4], weight_power=power, **how)
                both = torch.cat([dense(evidence.unlabeled, 1), dense(evidence.rows, 4)], 1)
                assert (both - expected).abs().max() < 1e-12 * expected.max(), (rules, backend, power)
            image, alpha = render(scene, camera, values, **how)
            assert (image - weights @ values).abs().max() < 1e-12, (rules, backend)
            assert (alpha - weights.sum(2)).abs().max() < 1e-12, (rules, backend)
    first, second, third = found
    assert (first - second).abs().max() > 1e-3 and (third - second).abs().max() > 1e-3


@pytest.mark.parametrize(
    ("rules", "antialiased"),
    [
        pytest.param("1.4", False, marks=pytest.mark.slow),
        ("1.6", True),
        *(pytest.param(*x, marks=pytest.mark.extra) for x in (("1.4", True), ("1.5", False), ("1.5", True))),
        pytest.param("1.6", False, marks=pytest.mark.extra),
    ],
)
def test_the_kernels_draw_by_the_rules(rules, antialiased):
    scene, camera, labels, _, (_, expected, _) = drawn_by(rules, antialiased)
    single = GaussianScene(*(x.float().to(DEVICE) for x in (scene.means, scene.quats, scene.scales, scene.opacities)))
    job = RasterJob(single, antialiased, RasterSettings.of_gsplat(rules), torch.float32)
    entries = triton.views_evidence(job, RasterBatch([camera], [labels.to(DEVICE)], [4]))
    found = torch.zeros(18, 5)
    found[entries.gaussian.long().cpu(), entries.column.long().cpu()] = entries.weight.cpu()
    assert (found - expected).abs().max() < 1e-3 * expected.max()
    assert (found - expected).norm() < 1e-4 * expected.norm()


def test_versions_have_rules(monkeypatch):
    assert RasterSettings.of_gsplat("1.4.0") == RasterSettings()
    with pytest.raises(ValueError, match=r"0\.9.* 1\.4, 1\.5, 1\.6"):
        RasterSettings.of_gsplat("0.9")
    monkeypatch.setattr(gsplat, "installed_gsplat_version", lambda: "1.5.3")
    asked = (("auto", None), ("auto", "1.5"), ("1.6", "1.4"), ("installed", "1.4"))
    assert [gsplat.resolve_gsplat_rules(*x) for x in asked] == ["1.4", "1.5", "1.6", "1.5"]


@pytest.fixture
def stock(monkeypatch):
    """gsplat's functions as of a version, replaced by the reference's projection and tiles."""

    def install(later: bool, camera, antialiased: bool) -> None:
        def fully_fused_projection(means, covars, quats, scales, poses, Ks, width, height, **options):
            rectangle = "opacities" in options
            assert later or not rectangle
            n = len(means)
            scene = GaussianScene(means, quats, scales, torch.ones(n))
            constants = RasterSettings.of_gsplat("1.5" if later else "1.4")
            known = options.get("opacities", torch.full((n,), 1e4))  # without, they shrink no rectangle
            world = prepare_gaussians(scene, torch.float32)
            seen = project(world._replace(opacities=known[world.gaussian]), camera, constants, antialiased)
            radii, means2d, conics = torch.zeros(n, 2), torch.zeros(n, 2), torch.zeros(n, 3)
            compensations, at = torch.zeros(n), seen.gaussian
            radii[at], means2d[at], conics[at] = seen.radii, seen.means2d, seen.conics
            compensations[at] = seen.opacities / known[at].clamp(min=1e-30)
            depths = means @ camera.world_to_camera[2, :3].float() + camera.world_to_camera[2, 3].float()
            radii = radii.clamp(max=2**31 - 128).int()
            radii = radii if later else radii[:, 0]
            return tuple(x[None] for x in (radii, means2d, depths, conics, compensations))

        def isect_tiles(means2d, radii, depths, size, across, down):
            assert radii.shape == (*depths.shape, *((2,) if later else ()))
            square = radii[0] if later else radii[0, :, None].expand(-1, 2)
            drawn = (square > 0).all(1).nonzero().squeeze(1)
            drawn = drawn[depths[0, drawn].argsort(stable=True)]
            shape = SimpleNamespace(means2d=means2d[0, drawn], radii=square[drawn].float())
            tiles = assign_tiles(shape, across * size, down * size, size)
            return None, tiles.offsets, drawn[tiles.indices.long()].int()

        module = ModuleType("gsplat.cuda._wrapper")
        module.fully_fused_projection, module.isect_tiles = fully_fused_projection, isect_tiles
        module.isect_offset_encode = lambda offsets, views, across, down: offsets[:-1].view(views, down, across).int()
        monkeypatch.setitem(sys.modules, "gsplat.cuda._wrapper", module)

    return install


@pytest.mark.parametrize(("later", "rules"), [(False, "1.4"), (True, "1.4"), (True, "1.5")])
@pytest.mark.parametrize("antialiased", [False, True])
def test_stock_gsplat_of_any_version_gives_the_lists_of_the_rules(later, rules, antialiased, stock):
    scene, (camera,) = hard_scene(), orbit(1, width=50, height=41)
    scene.scales[0] = 4.8e8
    settings = RasterSettings.of_gsplat(rules)
    stock(later, camera, antialiased)
    found = gsplat.project_views(RasterJob(scene, antialiased, settings, torch.float32), [camera])
    seen = project(prepare_gaussians(scene, torch.float32), camera, settings, antialiased)
    tiles = assign_tiles(seen, camera.width, camera.height, settings.tile_size)
    bounds = [*found.offsets.flatten().tolist(), len(found.indices)]
    for tile, (first, last) in enumerate(itertools.pairwise(bounds)):
        members = seen.gaussian[tiles.indices[tiles.offsets[tile] : tiles.offsets[tile + 1]].long()]
        # outside the rectangle of 3.33 standard deviations nothing is drawn: a later gsplat lists none of those
        missing = set(members.tolist()) ^ set(found.indices[first:last].tolist())
        assert not missing or (later and rules == "1.4")
        kept = [x for x in members.tolist() if x not in missing]
        assert found.indices[first:last].tolist() == kept
    listed = torch.isin(seen.gaussian, found.indices)
    at = seen.gaussian[listed]
    assert torch.allclose(found.opacities[0, at], seen.opacities[listed], rtol=1e-5, atol=1e-7)
    assert torch.allclose(found.means2d[0, at], seen.means2d[listed])


def test_pictures_of_any_number_of_channels():
    scene, (camera,) = hard_scene(), orbit(1, width=10, height=9)
    job = RasterJob(scene.to(DEVICE), False, RasterSettings(), torch.float32)
    for channels in (0, 19):
        values = torch.rand(len(scene), channels, generator=generator(0))
        found = triton.composite(job, camera, values.to(DEVICE))
        expected = render(scene, camera, values, backend="torch")
        for ours, theirs in zip(found, expected):
            assert ours.shape == theirs.shape
            assert theirs.numel() == 0 or (ours.cpu() - theirs).abs().max() < 2e-6 * max(1.0, float(theirs.max()))
