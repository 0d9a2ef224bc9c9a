"""From what a few views have shown to seconds and bytes of the whole lift: arithmetic, nothing else."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

_EVIDENCE_COPIES = 3
"""Copies of the evidence that are held while the parts of all blocks are joined, and their regions formed."""
_DIRECTION_COPIES = 2
"""Copies of the directions that are held while the vote gathers and storage chooses."""
_OFFSETS = 16
"""Bytes per Gaussian of a file of evidence, whatever it holds."""


@dataclass(frozen=True)
class Rate:
    """What a stage costs: a fixed part, and so much for each of its items."""

    fixed: float
    each: float
    count: float
    """Items in the whole lift."""

    def of(self, share: float = 1.0) -> float:
        """The cost of a share of the items.

        >>> Rate(fixed=2.0, each=0.5, count=10).of(0.5)
        4.5
        """
        return self.fixed + self.each * self.count * share


@dataclass(frozen=True)
class Facts:
    """What a short look has shown of a capture on a machine. Seconds are of one device."""

    device: str
    views: int
    """That will be lifted."""
    gaussians: int
    dimension: int
    """Of the features."""
    regions: float
    """Per view."""
    entries: float
    """Of the evidence, per view."""
    entry_bytes: int
    """Of the evidence, per entry."""
    before_s: Mapping[str, float]
    """What has been done already and will be done again, by name: start, open, kernels, check."""
    load_s: float
    """Until a network is loaded."""
    features_s: float | None
    """Per view whose features are new; None: all are kept."""
    kept_features_s: float | None
    """Per view whose features are kept; None: none are."""
    features_kept: float
    """Share of the views whose features are kept, in 0..1."""
    evidence_s: float
    """Per view that is rasterized."""
    kept_evidence_s: float
    """Per view whose evidence is kept."""
    evidence_kept: float
    """Share of the views whose evidence is kept, in 0..1."""
    core_s: Mapping[str, Rate]
    """Of consensus, lift, neighbors, vote and store, as far as they are asked for."""
    field_bytes: Rate
    """Of the stored semantics."""
    run_bytes: int
    """Of the checkpoint that goes with them."""
    write_bytes_s: float
    """Bytes that are written in a second."""
    view_bytes: float
    """Of the features and regions of a view in the cache."""
    host_bytes: int
    """The most that this process has held so far."""
    device_bytes: int | None
    """The most that it has held on the GPU until the evidence was there; None: there is none."""
    looked_at: int = 0
    """Views that were looked at for this."""


@dataclass(frozen=True)
class Stage:
    """One stage of a lift."""

    name: str
    seconds: float
    remark: str = ""
    """What of it is cached."""


@dataclass(frozen=True)
class Plan:
    """What a lift will take."""

    device: str
    num_devices: int
    views: int
    gaussians: int
    stages: tuple[Stage, ...]
    features_kept: int
    """Views whose 2D features are cached, about."""
    evidence_kept: int
    """Views whose evidence is cached, about."""
    host_bytes: int
    """Memory of each process."""
    device_bytes: int | None
    """Memory of each GPU; None: there is none."""
    disk_bytes: int
    """What will be written."""
    looked_at: int
    """Views that the plan rests on."""

    @property
    def seconds(self) -> float:
        """Of all stages."""
        return sum(stage.seconds for stage in self.stages)

    def to_json(self) -> dict[str, Any]:
        """The same as plain types, with `seconds` of each stage and `total_s`."""
        facts = {name: value for name, value in asdict(self).items() if name != "stages"}
        return {**facts, "seconds": {stage.name: stage.seconds for stage in self.stages}, "total_s": self.seconds}


def make_plan(facts: Facts, *, num_devices: int = 1) -> Plan:
    """The plan of a lift.

    Views and Gaussians are shared out between the devices; what is done before, loading and writing are not.

    Args:
        num_devices: processes that share the work, each with a device of its own; at least 1.
    Raises:
        ValueError: fewer devices than one.
    """
    if num_devices < 1:
        raise ValueError(f"num_devices must be at least 1, got {num_devices}")
    views, share = facts.views, 1 / num_devices
    kept, rasterized = (_share_of(views, part) for part in (facts.features_kept, facts.evidence_kept))
    new = views - kept
    look = share * (new * (facts.features_s or 0.0) + kept * (facts.kept_features_s or 0.0))
    features = look + (facts.load_s if new > 0 else 0.0)
    evidence = share * ((views - rasterized) * facts.evidence_s + rasterized * facts.kept_evidence_s)
    field_bytes = facts.field_bytes.of()
    evidence_bytes = facts.entries * views * facts.entry_bytes
    stages = (
        *(Stage(name, seconds) for name, seconds in facts.before_s.items()),
        Stage("features", features, _cached(kept, views)),
        Stage("evidence", evidence, _cached(rasterized, views)),
        *(Stage(name, rate.of(share)) for name, rate in facts.core_s.items()),
        Stage("write", (field_bytes + facts.run_bytes) / facts.write_bytes_s),
    )
    table = facts.regions * views * facts.dimension * 4
    held = (
        share * (_EVIDENCE_COPIES * evidence_bytes + _DIRECTION_COPIES * facts.gaussians * facts.dimension * 4)
        + 2 * table
    )
    files = (views - rasterized) / max(1, views) * (evidence_bytes + facts.gaussians * _OFFSETS * views / 16)
    on_gpu = facts.device_bytes is not None
    return Plan(
        device=facts.device,
        num_devices=num_devices,
        views=views,
        gaussians=facts.gaussians,
        stages=stages,
        features_kept=kept,
        evidence_kept=rasterized,
        host_bytes=round(facts.host_bytes + (table if on_gpu else held)),
        device_bytes=None if facts.device_bytes is None else round(facts.device_bytes + held),
        disk_bytes=round(files + new * facts.view_bytes + field_bytes + facts.run_bytes),
        looked_at=facts.looked_at,
    )


def _share_of(views: int, share: float) -> int:
    """How many views; all only if the share is 1, and none only if it is 0.

    >>> _share_of(45, 0.999), _share_of(45, 1.0), _share_of(45, 0.0)
    (44, 45, 0)
    """
    return views if share >= 1 else min(views - 1, max(int(share > 0), round(share * views)))


def _cached(kept: int, views: int) -> str:
    if kept in (0, views):
        return "" if kept == 0 else "cached"
    return f"about {kept} of {views} views cached"
