"""Extrapolation from measurements of a few views to the time, memory and disk space of a whole lift."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

_EVIDENCE_COPIES = 3
"""Copies of the evidence in memory while the parts of all blocks are joined and converted to regions."""
_DIRECTION_COPIES = 2
"""Copies of the directions in memory while the vote gathers them and a storage format is chosen."""
_OFFSET_BYTES = 16
"""Minimum bytes per Gaussian in an evidence file."""


@dataclass(frozen=True)
class Rate:
    """Cost of a stage: a fixed part, and a part for each item."""

    fixed: float
    each: float
    count: float
    """Number of items in the whole lift."""

    def of(self, share: float = 1.0) -> float:
        """Return the cost of a share of the items.

        >>> Rate(fixed=2.0, each=0.5, count=10).of(0.5)
        4.5
        """
        return self.fixed + self.each * self.count * share


@dataclass(frozen=True)
class Facts:
    """Measurements of a capture on a machine. Seconds are for one device."""

    device: str
    views: int
    """Number of views to lift."""
    gaussians: int
    dimension: int
    """Length of the feature vectors."""
    regions: float
    """Regions per view."""
    entries: float
    """Evidence entries per view."""
    entry_bytes: int
    """Bytes per evidence entry."""
    before_s: Mapping[str, float]
    """Seconds of steps that were done already and will be repeated, by name (start, open, kernels, check)."""
    load_s: float
    """Seconds until the network is loaded."""
    features_s: float | None
    """Seconds per view with new features; None if all are cached."""
    kept_features_s: float | None
    """Seconds per view with cached features; None if none are cached."""
    features_kept: float
    """Share of the views with cached features, in 0..1."""
    evidence_s: float
    """Seconds per view that is rasterized."""
    kept_evidence_s: float
    """Seconds per view with cached evidence."""
    evidence_kept: float
    """Share of the views with cached evidence, in 0..1."""
    core_s: Mapping[str, Rate]
    """Cost of consensus, lift, neighbors, vote and store, as far as they are enabled."""
    field_bytes: Rate
    """Size of the stored semantics."""
    run_bytes: int
    """Size of the checkpoint that is stored with them."""
    write_bytes_s: float
    """Bytes written per second."""
    view_bytes: float
    """Size of a view's features and regions in the cache."""
    host_bytes: int
    """Peak memory of this process so far."""
    device_bytes: int | None
    """Peak GPU memory until the evidence was computed; None without a GPU."""
    looked_at: int = 0
    """Number of views that were measured."""


@dataclass(frozen=True)
class Stage:
    """One stage of a lift."""

    name: str
    seconds: float
    remark: str = ""
    """Cached part of the stage, in words."""


@dataclass(frozen=True)
class Plan:
    """Estimated time, memory and disk space of a lift."""

    device: str
    num_devices: int
    views: int
    gaussians: int
    stages: tuple[Stage, ...]
    features_kept: int
    """Approximate number of views with cached 2D features."""
    evidence_kept: int
    """Approximate number of views with cached evidence."""
    host_bytes: int
    """Memory of each process."""
    device_bytes: int | None
    """Memory of each GPU; None without a GPU."""
    disk_bytes: int
    """Bytes to be written."""
    looked_at: int
    """Number of views that the estimate is based on."""

    @property
    def seconds(self) -> float:
        """Total time of all stages."""
        return sum(stage.seconds for stage in self.stages)

    def to_json(self) -> dict[str, Any]:
        """Return the plan as JSON types, with `seconds` of each stage and `total_s`."""
        facts = {name: value for name, value in asdict(self).items() if name != "stages"}
        return {**facts, "seconds": {stage.name: stage.seconds for stage in self.stages}, "total_s": self.seconds}


def make_plan(facts: Facts, *, num_devices: int = 1) -> Plan:
    """Estimate the cost of a lift.

    Views and Gaussians are divided among the devices. The preceding steps, loading and writing are not.

    Args:
        num_devices: number of processes that share the work, each with its own device; at least 1.
    Raises:
        ValueError: `num_devices` is less than 1.
    """
    if num_devices < 1:
        raise ValueError(f"num_devices must be at least 1, got {num_devices}")
    views, share = facts.views, 1 / num_devices
    features_cached, evidence_cached = (
        _share_of(views, cached) for cached in (facts.features_kept, facts.evidence_kept)
    )
    new = views - features_cached
    features = share * (new * (facts.features_s or 0.0) + features_cached * (facts.kept_features_s or 0.0))
    features += facts.load_s if new > 0 else 0.0
    evidence = share * ((views - evidence_cached) * facts.evidence_s + evidence_cached * facts.kept_evidence_s)
    field_bytes = facts.field_bytes.of()
    evidence_bytes = facts.entries * views * facts.entry_bytes
    stages = (
        *(Stage(name, seconds) for name, seconds in facts.before_s.items()),
        Stage("features", features, _cached(features_cached, views)),
        Stage("evidence", evidence, _cached(evidence_cached, views)),
        *(Stage(name, rate.of(share)) for name, rate in facts.core_s.items()),
        Stage("write", (field_bytes + facts.run_bytes) / facts.write_bytes_s),
    )
    table = facts.regions * views * facts.dimension * 4
    lift_bytes = (
        share * (_EVIDENCE_COPIES * evidence_bytes + _DIRECTION_COPIES * facts.gaussians * facts.dimension * 4)
        + 2 * table
    )
    files = (views - evidence_cached) / max(1, views) * (evidence_bytes + facts.gaussians * _OFFSET_BYTES * views / 16)
    on_gpu = facts.device_bytes is not None
    return Plan(
        device=facts.device,
        num_devices=num_devices,
        views=views,
        gaussians=facts.gaussians,
        stages=stages,
        features_kept=features_cached,
        evidence_kept=evidence_cached,
        host_bytes=round(facts.host_bytes + (table if on_gpu else lift_bytes)),
        device_bytes=None if facts.device_bytes is None else round(facts.device_bytes + lift_bytes),
        disk_bytes=round(files + new * facts.view_bytes + field_bytes + facts.run_bytes),
        looked_at=facts.looked_at,
    )


def _share_of(views: int, share: float) -> int:
    """Return the number of views in a share. It is all views only if the share is 1, and 0 only if the share is 0.

    >>> _share_of(45, 0.999), _share_of(45, 1.0), _share_of(45, 0.0)
    (44, 45, 0)
    """
    return views if share >= 1 else min(views - 1, max(int(share > 0), round(share * views)))


def _cached(cached: int, views: int) -> str:
    if cached in (0, views):
        return "" if cached == 0 else "cached"
    return f"about {cached} of {views} views cached"
