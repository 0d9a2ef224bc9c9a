"""What R knows of a scene: Gaussians without evidence, accuracy by R and by ||f||, R against opacity."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from normlift_ns.core.lift import Scalars
from normlift_ns.core.metrics import NO_CLASS, bin_means, kendall, lowest_jaccard, spearman

SAMPLE = 20_000
"""Gaussians of which Kendall's tau is taken, which is slow."""
FAINT = 0.1
"""Opacity below which a Gaussian is faint."""
HISTOGRAM = 20
"""Bins of R from 0 to 1; R = 0 is apart."""


def signals(
    scalars: Scalars,
    opacity: Float[Tensor, " n"],
    truth: Int[Tensor, " n"] | None = None,
    found: Int[Tensor, " n"] | None = None,
) -> dict[str, float]:
    """Figures by name; accuracies only where a truth is given, and of Gaussians whose truth is not `NO_CLASS`.

    `all`, `zero` (R = 0) and `seen` (R > 0), as in the paper's table of zero-evidence Gaussians: `.share` of all
    Gaussians, mean `.opacity`, share of `.faint` ones, mean `.views` that see them, `.accuracy`. Of those with R > 0,
    R against opacity: `opacity.spearman`, `opacity.kendall` (of a sample), `opacity.jaccard` of the lowest fifths,
    `opacity.quintile1` … mean opacity by ascending R. `reliability.bin1` … `bin10` and `norm.bin1` …: accuracy in
    tenths of equal count, `….spearman_bins` their rank correlation with the order. `histogram.0.00` …: share of R.

    Args:
        opacity: in 0..1.
        truth: class of every Gaussian.
        found: class that the unrefined direction answers.
    """
    reliability, seen = scalars.reliability, scalars.reliability > 0
    views = scalars.view_count.double()
    correct = None if truth is None or found is None else (found == truth)
    known = torch.ones_like(seen) if truth is None else truth != NO_CLASS
    out: dict[str, float] = {}
    for name, group in (("all", torch.ones_like(seen)), ("zero", ~seen), ("seen", seen)):
        out[f"{name}.share"] = _mean(group, torch.ones_like(group))
        out[f"{name}.opacity"] = _mean(opacity, group)
        out[f"{name}.faint"] = _mean(opacity < FAINT, group)
        out[f"{name}.views"] = _mean(views, group)
        if correct is not None:
            out[f"{name}.accuracy"] = _mean(correct, group & known)
    r, o = reliability[seen], opacity[seen]
    some = torch.randperm(len(r), generator=torch.Generator().manual_seed(0))[:SAMPLE].to(r.device)
    out["opacity.spearman"], out["opacity.kendall"] = spearman(r, o), kendall(r[some], o[some])
    out["opacity.jaccard"] = lowest_jaccard(r, o)
    out |= {f"opacity.quintile{i + 1}": x for i, x in enumerate(_bins(r, o, 5))}
    if correct is not None:
        for name, key in (("reliability", reliability), ("norm", scalars.norm)):
            bins = accuracy_bins(key[known], correct[known])
            out |= {f"{name}.bin{i + 1}": x for i, x in enumerate(bins)}
            order = torch.arange(len(bins), dtype=torch.float64)
            out[f"{name}.spearman_bins"] = spearman(order, torch.tensor(bins, dtype=torch.float64))
    counts = torch.histc(r.double(), bins=HISTOGRAM, min=0, max=1) / max(1, len(reliability))
    return out | {f"histogram.{i / HISTOGRAM:.2f}": float(x) for i, x in enumerate(counts)}


def accuracy_bins(key: Float[Tensor, " n"], correct: Bool[Tensor, " n"], bins: int = 10) -> list[float]:
    """Share of correct answers in bins of equal count by the key, where it is positive."""
    some = key > 0
    return list(_bins(key[some], correct[some].double(), bins))


def _bins(key: Tensor, values: Tensor, bins: int) -> Iterator[float]:
    return iter(bin_means(key, values, bins)[1].tolist())


def _mean(values: Tensor, group: Tensor) -> float:
    return float(values[group].double().mean())
