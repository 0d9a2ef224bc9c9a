"""Nonsense is refused where it is given: by the consensus, the lift and the vote, and with the argument's name."""

import pytest
import torch

from normlift_ns import Evidence, RefineConfig, consensus, lift, refine
from normlift_ns.core.checks import check_unit_rows
from normlift_ns.core.evidence import Entries
from tests.scenes import generator, unit_rows

EVIDENCE = Evidence.from_entries(
    [Entries(torch.tensor([0, 0, 1, 1]), torch.tensor([1, 3, 1, 3]), torch.ones(4), num_regions=(1, 1))], 2
)
GOOD = torch.tensor([[0.6, 0.8], [1.0, 0.0]])
BAD_ROWS = {"nan": torch.nan, "inf": torch.inf, "length 5": 5.0}
N = 40


def voters() -> dict:
    g = generator(1)
    return {
        "means": torch.rand(N, 3, generator=g),
        "directions": unit_rows(N, 6, seed=2).float(),
        "reliability": torch.rand(N, generator=g),
        "own": 5 * torch.rand(N, generator=g),
    }


@pytest.mark.parametrize("value", BAD_ROWS.values(), ids=BAD_ROWS)
def test_feature_rows_are_refused_alike(value):
    features = GOOD.clone()
    features[1, 0] = value
    for function in (lift, consensus):
        with pytest.raises(ValueError, match=r"^1 of 2 feature rows are not unit vectors \(row 1 has length"):
            function(EVIDENCE, features)


def test_a_consensus_takes_rows_of_zeros_and_a_lift_does_not():
    features = torch.stack([GOOD[0], torch.zeros(2)])
    assert consensus(EVIDENCE, features).features.isfinite().all()
    with pytest.raises(ValueError, match="row 1 has length 0"):
        lift(EVIDENCE, features)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"features": GOOD.tolist()}, "features must be a torch tensor, got list"),
        ({"features": torch.ones(2)}, r"features must be floating-point rows \[S, D\], got torch.float32 \(2,\)"),
        ({"features": GOOD.long()}, r"got torch.int64 \(2, 2\)"),
        ({"level": torch.tensor([0.0, 1.0])}, "level must be whole numbers >= 0"),
        ({"level": torch.tensor([0, -1])}, "level must be whole numbers >= 0"),
        ({"level": [0, 1]}, "level must be a torch tensor, got list"),
        ({"power": "1"}, "power must be a number >= 0, got '1'"),
        ({"power": float("nan")}, "power must be a number >= 0, got nan"),
        ({"sample": 1.5}, "sample must be a whole number >= 1, got 1.5"),
        ({"sample": "a"}, "sample must be a whole number >= 1, got 'a'"),
    ],
)
def test_a_consensus_names_what_is_wrong(change, told, unchecked):
    with pytest.raises(ValueError, match=told):
        consensus(EVIDENCE, **{"features": GOOD, **change})


@pytest.mark.parametrize("vote", ["paper", "posterior"])
@pytest.mark.parametrize("value", [torch.nan, torch.inf, -1.0])
@pytest.mark.parametrize("name", ["own", "reliability"])
def test_a_vote_refuses_numbers_that_are_none(vote, name, value):
    given = voters()
    given[name][7] = value
    if (vote, name) == ("paper", "own"):  # which it does not read
        assert torch.equal(refine(**given, config=RefineConfig(vote=vote, k=5)),
                           refine(**voters(), config=RefineConfig(vote=vote, k=5)))  # fmt: skip
        return
    with pytest.raises(ValueError, match=rf"^1 of 40 values of {name} are not .*: {name}\[7\] is "):
        refine(**given, config=RefineConfig(vote=vote, k=5))


@pytest.mark.parametrize("value", BAD_ROWS.values(), ids=BAD_ROWS)
def test_a_vote_refuses_directions_that_are_none(value):
    given = voters()
    given["directions"][3] *= value
    with pytest.raises(ValueError, match=r"^1 of 40 rows of directions are not unit vectors \(row 3 has length"):
        refine(**given, config=RefineConfig(k=5))
    given["directions"][3] = 0
    refine(**given, config=RefineConfig(k=5))


@pytest.mark.parametrize("name", ["means", "directions", "reliability", "own"])
def test_a_vote_names_what_is_no_tensor(name, unchecked):
    given = voters()
    given[name] = given[name].numpy()
    with pytest.raises(ValueError, match=f"^{name} must be a torch tensor, got ndarray"):
        refine(**given, config=RefineConfig(k=5))


@pytest.mark.parametrize(("n", "told"), [(0, "with 0 Gaussians there are"), (1, "with 1 Gaussian there are")])
def test_a_vote_of_nobody_says_so(n, told):
    with pytest.warns(UserWarning, match=told):
        source = refine(torch.zeros(n, 3), torch.ones(n, 1), torch.ones(n), own=torch.ones(n))
    assert source.tolist() == list(range(n))


def test_half_precision_rows_are_unit_rows():
    rows = unit_rows(500, 300, seed=4).half()
    assert (check_unit_rows(rows, "rows", "") - 1).abs().max() < 1e-3
