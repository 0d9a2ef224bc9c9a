"""Nonsense is refused where it is given: by the consensus, the lift and the vote, and with the argument's name."""

import itertools
from math import inf, nan

import pytest
import torch

from normlift_ns import RefineConfig, consensus, lift, refine
from tests.random_scenes import generator, random_evidence, unit_rows

EVIDENCE = random_evidence(2, [1, 1], 0, fill=1.0, dtype=torch.float32)
GOOD = torch.tensor([[0.6, 0.8], [1.0, 0.0]])
BAD_ROWS = (nan, inf, 5.0)
N = 40


def voters() -> dict:
    g = generator(1)
    return {
        "means": torch.rand(N, 3, generator=g),
        "directions": unit_rows(N, 6, seed=2).float(),
        "reliability": torch.rand(N, generator=g),
        "own": 5 * torch.rand(N, generator=g),
    }


def test_feature_rows_are_refused_alike():
    """But for rows of zeros, which a consensus takes and a lift does not."""
    for value in BAD_ROWS:
        features = GOOD.clone()
        features[1, 0] = value
        for function in (lift, consensus):
            with pytest.raises(ValueError, match=r"^1 of 2 feature rows .*\(row 1 has length"):
                function(EVIDENCE, features)
    features = torch.stack([GOOD[0], torch.zeros(2)])
    assert consensus(EVIDENCE, features).features.isfinite().all()
    with pytest.raises(ValueError, match="row 1 has length 0"):
        lift(EVIDENCE, features)


def test_a_vote_refuses_numbers_and_directions_that_are_none():
    expected = refine(**voters(), config=RefineConfig(vote="paper", k=5))
    for vote, name, value in itertools.product(("paper", "posterior"), ("own", "reliability"), (nan, inf, -1.0)):
        given = voters()
        given[name][7] = value
        config = RefineConfig(vote=vote, k=5)
        if (vote, name) == ("paper", "own"):  # which it does not read
            assert torch.equal(refine(**given, config=config), expected)
            continue
        with pytest.raises(ValueError, match=rf"^1 of 40 values of {name} .*{name}\[7\] = "):
            refine(**given, config=config)
    for value in BAD_ROWS:
        given = voters()
        given["directions"][3] *= value
        with pytest.raises(ValueError, match=r"^1 of 40 rows of directions .*\(row 3 has length"):
            refine(**given, config=RefineConfig(k=5))
        given["directions"][3] = 0
        refine(**given, config=RefineConfig(k=5))


def test_a_vote_of_nobody_says_so():
    for n in (0, 1):
        with pytest.warns(UserWarning, match=f"{n} Gaussian"):
            source = refine(torch.zeros(n, 3), torch.ones(n, 1), torch.ones(n), own=torch.ones(n))
        assert source.tolist() == list(range(n))
