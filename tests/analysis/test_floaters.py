"""Scores of floaters: each term does what it says, and what cannot be scored is left alone."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from normlift_ns import GaussianScene, InputError
from normlift_ns.analysis.objects import find_floaters
from normlift_ns.core.lift import Scalars
from normlift_ns.options import FLOATER_THRESHOLD
from tests.examples import examples
from tests.random_scenes import generator


def scalars(norm: torch.Tensor) -> Scalars:
    return Scalars(norm, norm, norm, norm, norm, norm, norm.int())


def wall_and_specks(seed: int, specks: int = 5) -> tuple[GaussianScene, Scalars]:
    """A wall of 20 x 20 Gaussians that overlap, and half-transparent specks before it."""
    g = generator(seed)
    axis = torch.arange(20.0)
    wall = torch.cartesian_prod(axis, axis, torch.zeros(1))
    before = torch.rand(specks, 3, generator=g) * 20 + torch.tensor([0.0, 0.0, 8.0])
    n = len(wall) + specks
    opacities = torch.cat([torch.full((len(wall),), 0.95), torch.full((specks,), 0.4)])
    scene = GaussianScene(torch.cat([wall, before]), torch.ones(n, 4), torch.full((n, 3), 0.6), opacities)
    return scene, scalars(torch.cat([torch.full((len(wall),), 0.9), torch.full((specks,), 0.6)]))


@examples(5)
@given(seed=st.integers(0, 99), scale=st.floats(1e-3, 1e3))
def test_specks_are_found_and_the_wall_is_kept_in_any_unit(seed, scale):
    scene, known = wall_and_specks(seed)
    found = find_floaters(scene, known)
    assert found.mask.nonzero().flatten().tolist() == [400, 401, 402, 403, 404]
    scaled = GaussianScene(scale * scene.means, scene.quats, scale * scene.scales, scene.opacities)
    assert torch.allclose(find_floaters(scaled, known).score, found.score, atol=1e-3)


def test_the_score_is_the_sum_of_its_terms():
    scene, known = wall_and_specks(1)
    scene.opacities[404] = 0.1
    known.norm[:3] = torch.tensor([0.3, 1.8, 0.0])  # that disagrees with its neighbours, agrees more, has no evidence
    score = find_floaters(scene, known).score
    distance = torch.cdist(scene.means.double(), scene.means.double()).fill_diagonal_(torch.inf)
    eighth = distance.sort(dim=1).values[:, 7]
    norm = known.norm.double()
    doubt = 2 * (norm[norm > 0].median() / norm.clamp(min=1e-9)).log2().clamp(min=0) * (norm > 0)
    expected = (eighth / 1.2).log2() + doubt + 1 - scene.opacities
    assert torch.allclose(score.double(), expected, atol=1e-4)


def test_what_is_never_drawn_is_no_floater_and_nobodys_neighbour():
    scene, known = wall_and_specks(0)
    scene.opacities[400] = 0.001
    scene.means[401] = torch.nan
    found = find_floaters(scene, known)
    assert found.score[400:402].tolist() == [-torch.inf] * 2
    assert not found.mask[400:402].any() and found.mask[402:].all()
    for n in (0, 1):  # too few to tell
        few = GaussianScene(scene.means[:n], scene.quats[:n], scene.scales[:n], scene.opacities[:n])
        assert not find_floaters(few, known.map(lambda x, n=n: x[:n])).mask.any()
    alike = GaussianScene(torch.zeros(9, 3), torch.ones(9, 4), torch.zeros(9, 3), torch.ones(9))
    assert find_floaters(alike, scalars(torch.zeros(9))).score.isfinite().all()


def test_limits_and_lifts_that_do_not_fit():
    scene, known = wall_and_specks(0)
    assert find_floaters(scene, known, limit=100).mask.sum() == 0 < FLOATER_THRESHOLD
    for other, limit, hint in ((known, float("nan"), "floater_threshold"), (scalars(torch.ones(3)), 1.0, "3 .* 405")):
        with pytest.raises(InputError, match=hint):
            find_floaters(scene, other, limit=limit)
