"""Which Gaussians make up a pixel: against the Python loops, the picture and the evidence."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from normlift_ns import Contributors, GaussianScene, RasterSettings, contributors, rasterize_evidence, render
from normlift_ns.options import GSPLAT_VERSIONS
from tests.examples import examples
from tests.random_scenes import dense, generator, orbit_camera, random_labels, random_scene
from tests.rasterization.oracle import compositing_matrix

BACKENDS = ["torch", "numba"]
DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA"))]


def matrix(found: Contributors, num_gaussians: int) -> torch.Tensor:
    pixel = torch.repeat_interleave(torch.arange(len(found.offsets) - 1), found.offsets.diff().cpu())
    full = torch.zeros(len(found.offsets) - 1, num_gaussians, dtype=torch.float64)
    full[pixel, found.gaussian.cpu()] = found.weight.double().cpu()
    return full


@examples(5)
@given(
    seed=st.integers(0, 2**31), count=st.integers(1, 40), rules=st.sampled_from(GSPLAT_VERSIONS), blurred=st.booleans()
)
def test_they_are_those_of_the_python_loops(seed, count, rules, blurred):
    scene, camera = random_scene(40, seed=seed, size=0.4), orbit_camera(seed % 7, width=37, height=21)
    scene.opacities[::3] = 0.999  # which rules cap
    pixels = (torch.rand(count, 2, generator=generator(seed)) * torch.tensor([37, 21])).long()
    mode = "antialiased" if blurred else "classic"
    expected = torch.from_numpy(compositing_matrix(scene, camera, blurred, rules))[pixels[:, 1], pixels[:, 0]]
    depth = scene.means @ camera.world_to_camera[2, :3]
    for backend in BACKENDS:
        how = {"rasterize_mode": mode, "settings": RasterSettings.of_gsplat(rules)}
        found = contributors(scene, camera, pixels, backend=backend, **how)
        assert torch.allclose(matrix(found, 40), expected, rtol=0, atol=1e-12)
        assert len(found.gaussian) == int((expected > 0).sum())
        for start, stop in zip(found.offsets[:-1].tolist(), found.offsets[1:].tolist()):
            assert (depth[found.gaussian[start:stop]].diff() >= 0).all()


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(("mode", "rules"), [("classic", "1.4"), ("antialiased", "1.5"), ("antialiased", "1.6")])
def test_a_picture_and_evidence_are_made_of_them(mode, rules, device):
    """Weights of a region's pixels add up to its evidence, those of a pixel to its alpha and color, in both precisions,
    with Gaussians among them that cannot be drawn.
    """
    scene = random_scene(80, seed=8, size=0.4)
    scene.means[3, 1], scene.opacities[4], scene.scales[5, 0], scene.quats[6] = torch.nan, torch.nan, torch.inf, 0
    camera = orbit_camera(0.7, width=33, height=21)
    labels = random_labels(camera, 4, seed=1)
    y, x = torch.meshgrid(torch.arange(21), torch.arange(33), indexing="ij")
    pixels = torch.stack([x, y], dim=2).view(-1, 2)
    how = {"rasterize_mode": mode, "settings": RasterSettings.of_gsplat(rules)}
    precisions = [(torch.float32, 3e-6), *([(torch.float64, 1e-12)] if device == "cpu" else [])]
    for dtype, error in precisions:
        here = GaussianScene(*(getattr(scene, x).to(device, dtype) for x in ("means", "quats", "scales", "opacities")))
        full = matrix(contributors(here, camera, pixels, **how), 80)
        with pytest.warns(UserWarning, match="4 of 80 Gaussians"):
            rows = rasterize_evidence(here, [camera], [labels], num_regions=[4], **how).rows
        expected = dense(rows, 4).cpu()
        flat = labels.long().flatten()
        found = torch.stack([full[flat == region].sum(dim=0) for region in range(4)], dim=1)
        assert (found - expected).abs().max() < error * expected.max()
        values = torch.rand(80, 3, generator=generator(1)).to(device, dtype)
        image, alpha = render(here, camera, values, **how)
        assert (full.sum(dim=1) - alpha.double().cpu().flatten()).abs().max() < error
        assert (full @ values.double().cpu() - image.double().cpu().view(-1, 3)).abs().max() < error
        assert bool((full[:, 3:7] == 0).all()) and int((full > 0).sum()) > 500


def test_pixels_of_all_kinds():
    """None, one that nothing covers, one named twice, and others, which are refused."""
    scene, camera = random_scene(60, seed=5, size=0.5), orbit_camera(0.2, width=20, height=20)
    found = contributors(scene, camera, torch.zeros(0, 2, dtype=torch.long))
    assert found.offsets.tolist() == [0] and len(found.gaussian) == len(found.weight) == 0
    nothing = GaussianScene(scene.means + 1e4, scene.quats, scene.scales, scene.opacities)
    assert contributors(nothing, camera, torch.tensor([[0, 0], [19, 19]])).offsets.tolist() == [0, 0, 0]
    found = contributors(scene, camera, torch.tensor([[10, 9], [3, 4], [10, 9]]))
    for x in (found.gaussian, found.weight):
        first, _, again = x.split(found.offsets.diff().tolist())
        assert torch.equal(first, again) and len(first) > 0


def test_other_pixels_are_refused(unchecked):
    for pixels, told in (
        (torch.tensor([[0, 0], [20, 3]]), r"pixels\[1\] .*\(20, 3\).* 20 columns .*10 rows"),
        (torch.tensor([[0, 10]]), r"pixels\[0\] .*\(0, 10\)"),
        (torch.tensor([[0, -1]]), r"pixels\[0\] .*\(0, -1\)"),
        (torch.tensor([[0.5, 1.0]]), r"\[p, 2\].* torch.float32 \(1, 2\)"),
        (torch.tensor([1, 2]), r"torch.int64 \(2,\)"),
    ):
        with pytest.raises(ValueError, match=told):
            contributors(random_scene(5), orbit_camera(0.0, width=20, height=10), pixels)
