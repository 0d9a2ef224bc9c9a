"""Candidates of the grid: every variant of the refinement with its parameters, the simplest first."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Vote = Literal["none", "linear", "plain_knn", "norm_only", "support_only", "paper", "posterior"]


@dataclass(frozen=True)
class Candidate:
    """A variant of the refinement."""

    vote: Vote = "none"
    consensus: float | None = None
    """Power of the consensus, or None for no consensus."""
    sigma_d: float = 1.0
    tau: float = 0.95
    gamma: float = 0.4
    delta: float = 0.0
    prior: float = 4.0
    """Prior of the posterior vote, in views."""

    @property
    def name(self) -> str:
        """The method, and each parameter in which it differs from the first entry of the method in the table."""
        method = f"consensus_{self.vote}" if self.consensus is not None else self.vote
        method = "consensus" if method == "consensus_none" else method
        first = FIRST[self.vote]
        changed = [f"{key} {value:g}" for key, value in vars(self).items()
                   if key not in ("vote", "consensus") and value != getattr(first, key)]  # fmt: skip
        power = [f"power {self.consensus:g}"] if self.consensus not in (None, POWER) else []
        return " ".join([method, *power, *changed])


POWER, POWERS = 1.0, (1.0, 2.0, 3.0)
"""Default power of the consensus in `core.consensus`, and all powers to try."""
FIRST: dict[Vote, Candidate] = {
    "none": Candidate(),
    "linear": Candidate("linear"),
    "plain_knn": Candidate("plain_knn"),
    "norm_only": Candidate("norm_only"),
    "support_only": Candidate("support_only"),
    "paper": Candidate("paper"),
    "posterior": Candidate("posterior", sigma_d=2.0),
}
"""First entry of each vote: version 0.1's fitted parameters, except for the posterior vote."""
PRIORS = (4.0, 2.0, 8.0)
CANDIDATES: tuple[Candidate, ...] = (
    *(FIRST[vote] for vote in ("none", "linear", "plain_knn", "norm_only", "support_only", "paper")),
    Candidate("paper", delta=0.1),
    Candidate("paper", delta=0.3),
    *(Candidate("posterior", sigma_d=2.0, prior=prior) for prior in PRIORS),
    Candidate("posterior", sigma_d=1.0),
    Candidate("posterior", sigma_d=2.0, tau=0.9, gamma=0.05),
    Candidate("posterior", sigma_d=2.0, delta=0.1),
    *(Candidate(consensus=power) for power in POWERS),
    Candidate("paper", consensus=POWER),
    Candidate("paper", consensus=POWER, delta=0.3),
    *(Candidate("posterior", consensus=power, sigma_d=2.0, prior=prior) for power in POWERS for prior in PRIORS),
    Candidate("posterior", consensus=POWER, sigma_d=1.0),
    *(Candidate("posterior", consensus=power, sigma_d=2.0, tau=0.9, gamma=0.05) for power in POWERS),
    Candidate("posterior", consensus=POWER, sigma_d=2.0, delta=0.1),
)
