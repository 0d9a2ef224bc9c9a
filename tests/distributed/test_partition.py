"""What a team finds is what one process finds, bit for bit, however many there are."""

from collections import Counter
from dataclasses import fields
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from normlift_ns import Evidence, RefineConfig, consensus, lift
from normlift_ns.core import partition
from normlift_ns.core.field import SemanticField
from normlift_ns.core.lift import Scalars
from normlift_ns.core.lowrank import StoredEvidence
from normlift_ns.core.partition import Partition
from normlift_ns.distributed.communicator import EvidenceShard, TorchCommunicator, redistribute_evidence
from normlift_ns.distributed.lift import build_field_distributed, consensus_distributed, vote_distributed
from normlift_ns.evidence_collection import ViewObservations
from normlift_ns.options import LiftOptions, Storage
from normlift_ns.pipeline import vote_directions
from normlift_ns.progress import StageTimer
from tests.distributed.threads import Threads, together
from tests.random_scenes import generator, random_evidence, same_evidence, unit_rows

N, VIEWS, REGIONS, D = 150, (3, 0, 2, 4, 1), 10, 24


@pytest.fixture(autouse=True)
def small_grains(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(partition, "PARTITION_BLOCK", 16)
    monkeypatch.setattr("normlift_ns.core.refine._BLOCK", (32, 32))
    monkeypatch.setattr("normlift_ns.distributed.communicator._RENUMBER_BLOCK", 32)


def world(seed: int) -> tuple[torch.Tensor, Evidence, torch.Tensor]:
    means = torch.randn(N, 3, generator=generator(seed))
    means[:5] = means[5]  # coincident
    means[7] = torch.nan
    return means, random_evidence(N, VIEWS, seed), unit_rows(REGIONS, D, seed, torch.float32)


@given(n=st.integers(0, 70), size=st.integers(1, 5), seed=st.integers(0, 9))
def test_everybody_is_of_one_portion(n: int, size: int, seed: int) -> None:
    means = torch.randn(n, 3, generator=generator(seed))

    def work(team: Threads) -> tuple[torch.Tensor, torch.Tensor]:
        portion = Partition.from_means(team, means)
        assert torch.equal(portion.indices, portion.indices.sort().values)
        assert torch.equal(
            torch.cat([*portion.blocks(), portion.curve_rows[:0]]).sort().values, torch.arange(len(portion))
        )
        return portion.indices, portion.all_gather(means[portion.indices])

    found = together(size, work)
    assert torch.equal(torch.cat([mine for mine, _ in found]).sort().values, torch.arange(n))
    assert all(torch.equal(joined, means) for _, joined in found)


@pytest.mark.parametrize(("seed", "size"), [(0, 1), (0, 3), (1, 2)])
def test_evidence_changes_hands(seed: int, size: int) -> None:
    means, evidence, _ = world(seed)
    chunks = [[0], [1, 2], [3], [4]]

    def work(team: Threads) -> tuple[Evidence, torch.Tensor]:
        portion = Partition.from_means(team, means)
        pieces = {
            c: EvidenceShard.split(evidence.select_views(chunks[c]), portion) for c in team.claim_chunks(len(chunks))
        }
        return redistribute_evidence(pieces, portion, len(chunks)), portion.indices

    for found, gaussians in together(size, work):
        assert same_evidence(found, evidence.select_gaussians(gaussians))


def voting(vote: Any) -> LiftOptions:
    """Options of a vote that measures its gate; some Gaussians have too little weight in regions to change."""
    return LiftOptions(vote=RefineConfig(vote=vote, k=9, min_labeled=0.1))


def lifted_alone(seed: int, vote: str, storage: Storage) -> SemanticField:
    means, evidence, features = world(seed)
    lifted = lift(evidence, consensus(evidence, features, sample=5).features)
    options, stages = voting(vote), StageTimer(lambda stage, done, total: None)
    own, level = lifted.scalars.own_evidence, torch.zeros(REGIONS, dtype=torch.int64)
    copied, _, shares = vote_directions(means, lifted, own, options, stages, level=level)
    assert "gate" in shares or seed == 2  # which has too few pairs
    return SemanticField.build(lifted, means, copied, tolerance=0.3, storage=storage, provenance=shares)


def lifted_by(team: Threads, seed: int, vote: str, storage: Storage) -> SemanticField | None:
    means, evidence, features = world(seed)
    portion = Partition.from_means(team, means)
    mine = evidence.select_gaussians(portion.indices)
    levels = torch.zeros(REGIONS, dtype=torch.int64)
    table = consensus_distributed(ViewObservations(mine, features, levels), portion, sample=5).features
    lifted = lift(mine, table)
    options, stages = voting(vote), StageTimer(lambda stage, done, total: None)
    own = lifted.scalars.own_evidence
    copied, _, shares = vote_distributed(means, lifted, own, options, portion, stages, level=levels)
    how = {"tolerance": 0.3, "storage": storage, "provenance": shares}
    return build_field_distributed(lifted, means, copied, portion, **how)


def stored(field: SemanticField) -> list[torch.Tensor]:
    if isinstance(field.store, StoredEvidence):
        return [getattr(field.store.evidence.rows, name) for name in ("offsets", "column", "weight")]
    return [field.store.coordinates]


@pytest.mark.parametrize(
    ("vote", "storage", "seed"),
    [("posterior", "low_rank", 0), ("paper", "float16", 1), ("posterior", "evidence", 2), ("posterior", "auto", 3)],
)
def test_the_field_is_the_same(vote: str, storage: Storage, seed: int) -> None:
    expected = lifted_alone(seed, vote, storage)
    assert float((expected.source != torch.arange(N)).float().mean()) > 0.1
    for size in (1, 2, 13):  # of which some have nothing
        found, *others = together(size, lambda team: lifted_by(team, seed, vote, storage))
        assert others == [None] * (size - 1) and found is not None
        assert found.manifest == expected.manifest
        assert torch.equal(found.source, expected.source)
        for field in fields(Scalars):
            assert torch.equal(getattr(found.scalars, field.name), getattr(expected.scalars, field.name)), field.name
        for a, b in zip(stored(found), stored(expected)):
            assert torch.equal(a, b)


def test_process_0_reports_the_views_of_all() -> None:
    done: Counter[str] = Counter()
    store = SimpleNamespace(add=lambda stage, new: done.update({stage: new}) or done[stage])
    told: list[tuple[str, int, int]] = []
    team = [TorchCommunicator(rank=r, world_size=2, device=torch.device("cpu"), store=store) for r in (0, 1)]
    reports = [one.aggregate_progress(lambda *progress: told.append(progress)) for one in team]
    for count in (1, 2, 4):
        for report in reports[::-1]:
            report("evidence", count, 9)
            report("vote", count, 9)
    assert told == [(stage, n, 9) for n, m in ((1, 2), (2, 4), (4, 8)) for stage, n in (("evidence", m), ("vote", n))]
