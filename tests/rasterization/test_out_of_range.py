"""Parameters that no float32 rasterizer can draw: the GPU backend leaves the same Gaussians out as the others do, which
research/hard_scenes.py tries.
"""

import sys
from dataclasses import replace

import pytest
import torch

from normlift_ns import RasterSettings, rasterize_evidence, render
from normlift_ns.core.evidence import Evidence
from normlift_ns.rasterization import triton
from normlift_ns.rasterization.rasterize import RasterBatch, RasterJob
from tests.kernels.test_regions import DEVICE, hard_scene
from tests.random_scenes import dense, orbit, random_labels, random_scene


def test_both_ends_are_drawn():
    scene = random_scene(3, dtype=torch.float32)
    scene.means[0, 0], scene.scales[1], scene.quats[2] = 1e18, torch.tensor([20.0, -1000.0, 0]).exp(), 0
    scene.quats[2, 3] = -1e-18
    assert scene.drawable.tolist() == [True] * 3
    scene.means[0, 0], scene.scales[1, 0], scene.quats[2, 3] = 1.1e18, 4.86e8, 9e-19
    assert replace(scene).drawable.tolist() == [False] * 3


@pytest.fixture
def without_gsplat(monkeypatch):
    for name in [name for name in sys.modules if name.split(".")[0] == "gsplat"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "gsplat", None)


MORE = [("classic", "1.4"), ("classic", "1.5"), ("antialiased", "1.5")]


@pytest.mark.parametrize(
    ("mode", "rules"), [("antialiased", "1.4"), *(pytest.param(*x, marks=pytest.mark.extra) for x in MORE)]
)
@pytest.mark.usefixtures("without_gsplat")
def test_the_gpu_backend_leaves_out_and_draws_the_same(mode, rules):
    """Without gsplat, in Triton's interpreter: bad parameters, enormous scales, ordinary hard Gaussians."""
    scene, cameras = hard_scene(), orbit(2, width=18, height=9)
    scene.scales[:3] = torch.tensor([[1e6] * 3, [4.8e8] * 3, [1e9, 1e9, 1.0]])
    scene.scales[30:32] = torch.tensor([5e8, torch.inf])[:, None]
    scene.means[32], scene.means[33, 1], scene.quats[34], scene.quats[35] = 1e19, torch.nan, 1e-30, 0
    scene.quats[36], scene.opacities[37] = 1e20, torch.nan
    labels = [random_labels(camera, 3, seed=v) for v, camera in enumerate(cameras)]
    job = RasterJob(scene.to(DEVICE), mode == "antialiased", RasterSettings.of_gsplat(rules), torch.float32)
    entries = triton.views_evidence(job, RasterBatch(cameras, [x.to(DEVICE) for x in labels], [3, 3]))
    found = Evidence.from_entries([entries], len(scene)).to("cpu")
    how = {"backend": "torch", "rasterize_mode": mode, "settings": job.settings}
    with pytest.warns(UserWarning, match="^9 of 60 Gaussians"):
        expected = rasterize_evidence(scene, cameras, labels, num_regions=[3, 3], **how)
    assert expected.num_excluded == 9
    ours, theirs = dense(found.rows, 6), dense(expected.rows, 6)
    assert theirs[:2].amin() >= 0 and theirs[:2].sum() > 1  # enormous, and seen
    assert ours[~scene.drawable].abs().max() == 0
    tolerance = 1e-5 if mode == "classic" else 1e-3
    assert (ours - theirs).abs().max() < tolerance * theirs.max()
    values = torch.rand(len(scene), 3, generator=torch.Generator().manual_seed(0))
    drawn = [x.cpu() for x in triton.composite(job, cameras[1], values.to(DEVICE))]
    pictures = render(scene, cameras[1], values, **how)
    for picture, known in zip(drawn, pictures):
        assert (picture - known).abs().max() < tolerance
