"""Which votes are tried."""

from __future__ import annotations

from dataclasses import replace

from normlift_ns.evaluation.votes import BETA, SWEEPS, own_vote, sweeps
from normlift_ns.options import RefineConfig


def test_sweeps_contain_and_mark_the_default_and_the_run():
    config = replace(RefineConfig(), k=17, tau=0.123)
    own = own_vote({"options": {"beta": 3.5, "vote": vars(config)}})
    labels = [each[0].label for each in sweeps([own])]
    for parameter, values in SWEEPS.items():
        some = [label for label in labels if label["parameter"] == parameter]
        numbers = {"beta": BETA, "k": RefineConfig().k, **RefineConfig().numbers._asdict()}
        used = {"beta": 3.5, "k": 17, "tau": 0.123}.get(parameter, numbers[parameter])
        assert [label["value"] for label in some] == sorted({*values, numbers[parameter], used})
        assert [label["value"] for label in some if label["default"]] == [numbers[parameter]]
        assert [label["value"] for label in some if label["own"]] == [used]


def test_runs_lifted_differently_are_swept_over_the_same_values():
    owns = [own_vote({"options": {"vote": vars(replace(RefineConfig(), sigma_d=s))}}) for s in (0.77, 1.33)]
    every = list(sweeps(owns))
    of_sigma = [each for each in every if each[0].label["parameter"] == "sigma_d"]
    assert {0.77, 1.33} <= {each[0].label["value"] for each in of_sigma}
    assert all(each[0].config.sigma_d == each[1].config.sigma_d == each[0].label["value"] for each in of_sigma)
    of_k = [each for each in every if each[0].label["parameter"] == "k"]
    assert all((each[0].config.sigma_d, each[1].config.sigma_d) == (0.77, 1.33) for each in of_k)
