"""Parameters that no float32 rasterizer can draw: the same Gaussians are left out, and counted, on every backend."""

import itertools
import math
import sys
import warnings

import numpy as np
import pytest
import torch
from hypothesis import example, given
from hypothesis import strategies as st

from normlift_ns import GaussianScene, RasterSettings, rasterize_evidence, render
from normlift_ns.core.evidence import Evidence
from normlift_ns.rasterization import triton
from normlift_ns.rasterization.rasterize import RasterBatch, RasterJob
from tests.examples import examples
from tests.kernels.test_regions import DEVICE, hard_scene
from tests.random_scenes import dense, orbit, orbit_camera, random_labels, random_scene

BACKENDS = ["torch", "numba"]
NAMES = ("means", "quats", "scales", "opacities")
FLOATS = st.floats(width=32) | st.sampled_from(
    [0.0, -0.0, 1e-45, 1e-30, 1e-19, 1e-18, 1e18, 1e19, 1e30, 4.85e8, 4.86e8]
)


def drawable(mean, quat, scale, opacity):
    """The rule of docs/numerics.md, by itself."""
    longest = max(abs(x) for x in quat)
    return (
        all(math.isfinite(x) for x in (*mean, *quat, *scale, opacity))
        and all(abs(x) <= np.float32(1e18) for x in mean)
        and all(x <= np.float32(4.8517e8) for x in scale)  # e^20, however it is rounded
        and np.float32(1e-18) <= longest <= np.float32(1e18)
    )


def evidence_of(scene, cameras, labels, backend, **options):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return rasterize_evidence(scene, cameras, labels, num_regions=[3] * len(cameras), backend=backend, **options)


ROW = st.tuples(
    st.tuples(*[FLOATS] * 3),
    st.tuples(*[FLOATS] * 4),
    st.tuples(*[FLOATS.map(abs)] * 3),
    st.floats(0, 1, width=32) | st.just(math.nan),
)


ENDS = [((1e18, 0, 0), (0, 0, 0, -1e-18), (4.85e8, 0, 0), 0.5), ((1.1e18, 0, 0), (1, 0, 0, 0), (1, 1, 1), 0.5)]


@examples(3)
@example(rows=[*ENDS, ((0, 0, 0), (0, 9e-19, 0, 0), (1, 1, 1), 0.5)])
@given(rows=st.lists(ROW, min_size=1, max_size=4))
def test_any_parameters(rows):
    """All are drawn with finite weights or counted; the Gaussians beside them stay exactly as they are alone."""
    others = random_scene(12, seed=1, dtype=torch.float32, size=0.4)
    added = [torch.tensor(x, dtype=torch.float32) for x in zip(*rows)]
    scene = GaussianScene(*(torch.cat([getattr(others, name), x]) for name, x in zip(NAMES, added)))
    expected = [drawable(*row) for row in rows]
    assert scene.drawable.tolist() == [True] * 12 + expected
    cameras = orbit(2)
    labels = [random_labels(camera, 3, seed=v) for v, camera in enumerate(cameras)]
    keep = [name for name in range(len(scene)) if name < 12 or expected[name - 12]]
    drawn = GaussianScene(*(getattr(scene, name)[keep] for name in NAMES))
    for mode, backend, dtype in itertools.product(("classic", "antialiased"), BACKENDS, (torch.float32, torch.float64)):
        found = evidence_of(scene, cameras, labels, backend, rasterize_mode=mode, dtype=dtype)
        alone = evidence_of(drawn, cameras, labels, backend, rasterize_mode=mode, dtype=dtype)
        assert (found.num_excluded, alone.num_excluded) == (expected.count(False), 0)
        assert bool(found.rows.weight.isfinite().all())
        weights = dense(found.rows, 6)
        assert torch.equal(weights[keep], dense(alone.rows, 6))
        weights[keep] = 0
        assert int(weights.count_nonzero()) == 0


@pytest.mark.parametrize("backend", BACKENDS)
def test_scales_up_to_e_to_the_20_are_drawn_wherever_the_camera_stands_and_others_counted(backend):
    modes, places = ("classic", "antialiased"), ((4.0, 40.0), (0.02, 5000.0), (1e4, 40.0))
    for mode, exponent, (distance, focal) in itertools.product(modes, (4, 15, 19.9, 20), places):
        camera = orbit_camera(0.0, distance=distance, focal=focal)
        scales = torch.full((1, 3), float(exponent)).exp()
        scene = GaussianScene(torch.zeros(1, 3), torch.tensor([[1.0, 0, 0, 0]]), scales, torch.tensor([0.25]))
        image, alpha = render(scene, camera, torch.ones(1, 1), backend=backend, rasterize_mode=mode)
        exact, _ = render(scene, camera, torch.ones(1, 1), backend=backend, rasterize_mode=mode, dtype=torch.float64)
        assert (alpha - exact[:, :, 0]).abs().max() < 1e-4, (mode, exponent, distance)
        assert (image[:, :, 0] - alpha).abs().max() < 1e-6, (mode, exponent, distance)
        assert exponent < 11 or exact.min() > 0.2499, (mode, exponent, distance)
    cameras = orbit(1)
    for exponent in (20.1, 30, 45, 88, 200):
        scene = random_scene(5, seed=1, dtype=torch.float32)
        scene.scales[2, 1] = torch.tensor(float(exponent)).exp()
        with pytest.warns(UserWarning, match="^1 of 5 Gaussians"):
            evidence = rasterize_evidence(scene, cameras, [random_labels(cameras[0], 3)], backend=backend)
        assert evidence.num_excluded == 1 and evidence.rows.row_sums()[2] == 0, exponent


@pytest.fixture
def without_gsplat(monkeypatch):
    for name in [name for name in sys.modules if name.split(".")[0] == "gsplat"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "gsplat", None)


@pytest.mark.parametrize(
    ("mode", "rules"),
    [
        ("antialiased", "1.4"),
        *(pytest.param(*x, marks=pytest.mark.extra) for x in (("classic", "1.4"), ("classic", "1.5"))),
        pytest.param("antialiased", "1.5", marks=pytest.mark.extra),
    ],
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
    expected = evidence_of(scene, cameras, labels, "torch", rasterize_mode=mode, settings=job.settings)
    assert expected.num_excluded == 9
    ours, theirs = dense(found.rows, 6), dense(expected.rows, 6)
    assert theirs[:2].amin() >= 0 and theirs[:2].sum() > 1  # enormous, and seen
    assert ours[~scene.drawable].abs().max() == 0
    tolerance = 1e-5 if mode == "classic" else 1e-3
    assert (ours - theirs).abs().max() < tolerance * theirs.max()
    values = torch.rand(len(scene), 3, generator=torch.Generator().manual_seed(0))
    drawn = [x.cpu() for x in triton.composite(job, cameras[1], values.to(DEVICE))]
    pictures = render(scene, cameras[1], values, backend="torch", rasterize_mode=mode, settings=job.settings)
    for picture, known in zip(drawn, pictures):
        assert (picture - known).abs().max() < tolerance
