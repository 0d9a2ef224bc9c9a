"""Many votes that share the cosines between the neighbors of every voter, computed once per feature table.

`refine` computes the cosines for each vote, which suits a single lift. The formulas are the same, and tests compare
both. On a GPU, cosines are stored in half precision.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from normlift_ns import Lifted, Neighbors
from normlift_ns.core.metrics import class_scores, classify
from research.candidates import Candidate
from research.variants import Scores, lifted_scores

CHUNK = {"cpu": 2**9, "cuda": 2**14}
"""Number of voters to process at a time, by device type."""


class Result(NamedTuple):
    """Result of one candidate."""

    miou: float
    """mIoU in percentage points."""
    copied: float
    """Share of the voters that take another Gaussian's direction."""


@dataclass(frozen=True)
class Voters:
    """Voters with their neighbors."""

    group: Tensor
    """[M, K + 1] index of each voter and of its neighbors, or -1 for missing neighbors."""
    distance: Tensor
    """[M, K + 1] distance in units of the scene's median spacing, or inf for missing neighbors."""
    truth: Tensor
    """[M] class of each voter."""
    classes: int


def voters_of(neighbors: Neighbors, truth: Tensor, classes: int, some: Tensor | None = None) -> Voters:
    """Return all Gaussians with a known class, or the Gaussians `some`, as voters."""
    chosen = (truth >= 0).nonzero().squeeze(1) if some is None else some
    finite = neighbors.spacing[neighbors.spacing.isfinite()]
    group = torch.cat([chosen[:, None], neighbors.index[chosen].long()], dim=1)
    distance = torch.nn.functional.pad(neighbors.distance[chosen], (1, 0)) / finite.median()
    return Voters(group, distance.float(), truth[chosen], classes)


def results(candidates: Sequence[Candidate], lifted: Lifted, voters: Voters, classes: Tensor) -> dict[str, Result]:
    """Return the mIoU of the voters and the share that copies, for candidates of the same feature table.

    Args:
        classes: [K, D] vectors of the classes.
    """
    scores = lifted_scores(lifted, classes)
    plain = classify(scores.cosine, scores.valid)
    own, gates = voters.group[:, 0], gates_of(candidates)
    sources: dict[Candidate, list[Tensor]] = {one: [] for some in gates.values() for one in some}
    averaged: dict[Candidate, list[Tensor]] = {one: [] for one in candidates if one.vote == "linear"}
    if len(sources) + len(averaged) > 0:
        for part in parts(lifted, voters, cosines=len(sources) > 0):
            for (tau, gamma), some in gates.items():
                for one, source in zip(some, part.sources(some, tau, gamma), strict=True):
                    sources[one].append(source)
            for one, answers in averaged.items():
                answers.append(part.averaged(one, scores))
    source = [torch.cat(sources[one]) if one in sources else own for one in candidates]
    answer = [torch.cat(averaged[one]) if one in averaged else plain[s] for one, s in zip(candidates, source)]
    copied = (torch.stack(source) != own).float().mean(1).tolist()
    return {one.name: Result(*x) for one, *x in zip(candidates, mious(torch.stack(answer), voters), copied)}


def gates_of(candidates: Sequence[Candidate]) -> dict[tuple[float, float], list[Candidate]]:
    """Return the candidates that vote by tau and gamma, because equal values share a sigmoid."""
    found: dict[tuple[float, float], list[Candidate]] = {}
    for one in candidates:
        if one.vote not in ("none", "linear"):
            found.setdefault((one.tau, one.gamma), []).append(one)
    return found


def mious(answers: Tensor, voters: Voters) -> list[float]:
    """Return the mIoU of each row of answers [V, M], in percentage points."""
    k = voters.classes
    key = voters.truth * (k + 1) + torch.where(answers < 0, k, answers)
    key = key + torch.arange(len(answers), device=key.device)[:, None] * k * (k + 1)
    counts = torch.bincount(key.flatten(), minlength=len(answers) * k * (k + 1)).view(-1, k, k + 1).cpu()
    return [100 * class_scores(one).miou for one in counts]


@dataclass(frozen=True)
class _Part:
    """Some voters with all inputs of their votes."""

    group: Tensor
    distance: Tensor
    gram: Tensor
    """[m, K + 1, K + 1] cosines."""
    norm: Tensor
    n_eff: Tensor
    """[m, K + 1], 0 for missing neighbors."""

    def reliability(self, vote: str) -> Tensor:
        """Return [m, K + 1], the R that a vote uses; see `variant_reliability`."""
        if vote == "plain_knn":
            return (self.norm > 0).to(self.norm)
        if vote == "norm_only":
            return self.norm
        support = torch.where(self.n_eff > 0, self.n_eff / (self.n_eff + 1), 0.0)
        return support if vote == "support_only" else self.norm * support

    def sources(self, candidates: Sequence[Candidate], tau: float, gamma: float) -> list[Tensor]:
        """Return, for each candidate, [m] the Gaussian whose direction each voter takes, as in `refine`."""
        terms = [self.terms(one) for one in candidates]
        gate = torch.sigmoid((self.gram.float() - tau) / gamma)
        agreed = torch.bmm(gate, torch.stack([weight.float() for _, weight, _ in terms], dim=2))
        return [self._winners(r, agreed[:, :, i], margin) for i, (r, _, margin) in enumerate(terms)]

    def terms(self, one: Candidate) -> tuple[Tensor, Tensor, Tensor | float]:
        """Return R and weights [m, K + 1], and the margin by which the best neighbor must win."""
        r, square = self.reliability(one.vote), (self.distance / one.sigma_d) ** 2
        if one.vote != "posterior":
            nearest = torch.where(r > 0, square, torch.inf).amin(1)
            return r, r * _decay(r, square), one.delta * torch.exp(0.5 * nearest) if one.delta > 0 else 0.0
        near = r[:, 1:] * _decay(r[:, 1:], square[:, 1:])
        total = near.sum(1, keepdim=True)
        own = (self.norm * self.n_eff)[:, :1]
        return r, torch.cat([own, torch.where(total > 0, one.prior * near / total, 0.0)], dim=1), one.delta

    def _winners(self, r: Tensor, agreed: Tensor, margin: Tensor | float) -> Tensor:
        score = r * agreed
        best, choice = score[:, 1:].max(1)
        wins = (best > score[:, 0] + margin) & (r[:, 1:] > 0).any(1)
        return torch.where(wins, self.group.gather(1, choice[:, None] + 1).squeeze(1), self.group[:, 0])

    def averaged(self, one: Candidate, scores: Scores) -> Tensor:
        """Return [m], the class after linear averaging."""
        r = self.reliability(one.vote)
        weight = r * _decay(r, (self.distance / one.sigma_d) ** 2)
        total = torch.einsum("mk,mkc->mc", weight, scores.cosine[self.group.clamp(min=0)])
        some, own = weight.sum(1) > 0, self.group[:, 0]
        cosine = torch.where(some[:, None], total, scores.cosine[own])
        return classify(cosine, scores.valid[own] | some)


def _decay(r: Tensor, square: Tensor) -> Tensor:
    """Return d_ik relative to the nearest reliable neighbor."""
    nearest = torch.where(r > 0, square, torch.inf).amin(1, keepdim=True)
    return torch.exp(-0.5 * (square - nearest).nan_to_num(0, posinf=torch.inf).clamp(min=0))


def parts(lifted: Lifted, voters: Voters, *, cosines: bool) -> Iterator[_Part]:
    numbers, kind = lifted.scalars, voters.group.device.type
    half = kind == "cuda"
    everyone = lifted.directions(dtype=torch.float16) if half and cosines else None
    for rows in torch.arange(len(voters.group), device=voters.group.device).split(CHUNK[kind]):
        group = voters.group[rows]
        there, place = group >= 0, group.clamp(min=0)
        norm, n_eff = (torch.where(there, x[place], 0.0) for x in (numbers.norm, numbers.n_eff))
        if not cosines:
            gram = norm.new_zeros(0)
        elif everyone is not None:
            u = everyone[place]
            gram = torch.bmm(u, u.transpose(1, 2))
        else:
            needed, place = place.unique(return_inverse=True)
            u = lifted.directions(needed)[place]
            gram = torch.bmm(u, u.transpose(1, 2))
        yield _Part(group, voters.distance[rows], gram, norm, n_eff)
