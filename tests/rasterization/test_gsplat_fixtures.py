"""The CPU backends against weights that gsplat 1.4.0's CUDA kernels gave on trained scenes."""

from functools import cache

import numpy as np
import pytest
import torch

from normlift_ns import rasterize_evidence
from tests.captures import fixture_view, needs_shared, trained_scene, weight_fixtures

pytestmark = [pytest.mark.slow, needs_shared]
scene_of = cache(trained_scene)


def weight_errors(path, scene, backend):
    """Frobenius norm of the difference to the CUDA kernels' weights, weights that only one has, and the difference of
    the sums, all relative; and the sum.
    """
    camera, labels, arrays = fixture_view(path)
    columns = int(labels.max()) + 2
    place = arrays["gaussian"].astype(np.int64) * columns + arrays["region"] + 1
    expected = torch.zeros(len(scene) * columns, dtype=torch.float64)
    expected[torch.from_numpy(place)] = torch.from_numpy(arrays["weight"]).double()

    mode = path.stem.split("_")[2]
    evidence = rasterize_evidence(scene, [camera], [labels], backend=backend, rasterize_mode=mode).to("cpu")
    assert evidence.rows.weight.dtype == torch.float32
    found = torch.zeros_like(expected)
    found[evidence.rows.row_index() * columns + evidence.rows.column + 1] = evidence.rows.weight.double()
    found[evidence.unlabeled.row_index() * columns] = evidence.unlabeled.weight.double()
    one_sided = (found + expected)[(found == 0) != (expected == 0)].sum() / expected.sum()
    frobenius, total = (found - expected).norm() / expected.norm(), abs(found.sum() / expected.sum() - 1)
    return map(float, (frobenius, one_sided, total, found.sum()))


TORCH = ("tabletop_view21_classic", "fox_view00_antialiased", "tabletop_view02_antialiased")
"""A view takes the torch backend a minute."""


@pytest.mark.parametrize(
    ("backend", "some"),
    [("numba", None), ("torch", TORCH[:1]), pytest.param("torch", TORCH[1:], marks=pytest.mark.extra)],
)
def test_float32_weights_are_those_of_the_cuda_kernels(backend, some):
    for path in weight_fixtures():
        if some is None or path.stem in some:
            frobenius, one_sided, total, whole = weight_errors(path, scene_of(path.stem.split("_")[0]), backend)
            told = f"{path.stem}: Frobenius {frobenius:.1e}, one-sided weight {one_sided:.1e}, total {total:.1e}"
            assert frobenius <= 2e-5 and one_sided < 1e-6 and total < 1e-6, told
            alpha = np.load(path)["alpha"].astype(np.float64)  # stored in float16: its sum is off by up to 1e-4
            assert abs(whole / alpha.sum() - 1) < 1.2e-4, told
