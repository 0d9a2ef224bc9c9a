"""Statistics of R in a scene: Gaussians without evidence, accuracy by R and by ||f||, and R against opacity."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from normlift_ns.core.lift import Scalars
from normlift_ns.core.metrics import NO_CLASS, bin_means, kendall_test, lowest_jaccard, spearman_test

_FAINT_OPACITY = 0.1
"""Opacity below which a Gaussian is faint."""
_HISTOGRAM_BINS = 20
"""Number of bins of R from 0 to 1; R = 0 is counted separately."""


@dataclass(frozen=True)
class SceneSignals:
    """Data on the Gaussians of a scene."""

    scalars: Scalars
    opacity: Float[Tensor, " n"]
    """Opacity in 0..1."""
    truth: Int[Tensor, " n"] | None = None
    """Class of every Gaussian, `NO_CLASS` if it does not count. None means that it is unknown; there are no accuracies
    then."""
    answers: Mapping[str, Int[Tensor, " n"]] = field(default_factory=dict)
    """Predicted class of each direction: "unrefined", and "refined" after a vote."""


def signals(*scenes: SceneSignals) -> dict[str, float]:
    """Return statistics by name, over the Gaussians of all scenes together.

    The groups are `all`, `zero` (R = 0) and `seen` (R > 0), as in the paper's table of zero-evidence Gaussians. Each
    has its `.share` of all Gaussians, the mean `.opacity`, the share of `.faint` Gaussians and the mean number of
    `.views` that see them. It also has `.accuracy_unrefined` and `.accuracy_refined`, over Gaussians of known truth.

    For Gaussians with R > 0, R is compared with opacity. There are `opacity.spearman` and `opacity.kendall` with their
    p-values `…_p`, and `opacity.jaccard` of the lowest fifths. `opacity.quintile1` … are mean opacities by ascending R.

    `reliability.bin1` … `bin10` and `norm.bin1` … are the accuracies of unrefined predictions in tenths of equal count.
    `….spearman_bins` is their rank correlation with the order. `histogram.0.00` … are shares by R.

    The p-values assume that Gaussians are independent of each other, which neighbors are not.
    """
    reliability, norm, views = (
        torch.cat([getattr(scene.scalars, name) for scene in scenes]) for name in ("reliability", "norm", "view_count")
    )
    opacity, seen = torch.cat([scene.opacity for scene in scenes]), reliability > 0
    labeled, correct = _correct_predictions(scenes)
    out: dict[str, float] = {}
    for name, group in (("all", torch.ones_like(seen)), ("zero", ~seen), ("seen", seen)):
        out[f"{name}.share"] = _mean(group, torch.ones_like(group))
        out[f"{name}.opacity"] = _mean(opacity, group)
        out[f"{name}.faint"] = _mean(opacity < _FAINT_OPACITY, group)
        out[f"{name}.views"] = _mean(views, group)
        out |= {f"{name}.accuracy_{kind}": _mean(right, group & labeled) for kind, right in correct.items()}
    r, o = reliability[seen], opacity[seen]
    for name, test in (("spearman", spearman_test(r, o)), ("kendall", kendall_test(r, o))):
        out |= {f"opacity.{name}": test.value, f"opacity.{name}_p": test.p}
    out["opacity.jaccard"] = lowest_jaccard(r, o)
    out |= {f"opacity.quintile{i + 1}": x for i, x in enumerate(_bins(r, o, 5))}
    if "unrefined" in correct:
        for name, key in (("reliability", reliability), ("norm", norm)):
            bins = accuracy_bins(key[labeled], correct["unrefined"][labeled])
            out |= {f"{name}.bin{i + 1}": x for i, x in enumerate(bins)}
            order = torch.arange(len(bins), dtype=torch.float64)
            test = spearman_test(order, torch.tensor(bins, dtype=torch.float64))
            out |= {f"{name}.spearman_bins": test.value, f"{name}.spearman_bins_p": test.p}
    counts = torch.histc(r.double(), bins=_HISTOGRAM_BINS, min=0, max=1) / max(1, len(reliability))
    return out | {f"histogram.{i / _HISTOGRAM_BINS:.2f}": float(x) for i, x in enumerate(counts)}


def _correct_predictions(scenes: Sequence[SceneSignals]) -> tuple[Bool[Tensor, " n"], dict[str, Bool[Tensor, " n"]]]:
    """Return the Gaussians of known truth, and those for which each kind of prediction is correct."""
    truths = [scene.truth for scene in scenes if scene.truth is not None]
    if len(truths) < len(scenes):
        return torch.zeros(0, dtype=torch.bool), {}
    right = {
        kind: torch.cat([scene.answers[kind] == truth for scene, truth in zip(scenes, truths)])
        for kind in scenes[0].answers
        if all(kind in scene.answers for scene in scenes)
    }
    return torch.cat([truth != NO_CLASS for truth in truths]), right


def accuracy_bins(key: Float[Tensor, " n"], correct: Bool[Tensor, " n"], bins: int = 10) -> list[float]:
    """Return the share of correct predictions in bins of equal count by the key; only positive keys count."""
    positive = key > 0
    return list(_bins(key[positive], correct[positive].double(), bins))


def _bins(key: Tensor, values: Tensor, bins: int) -> Iterator[float]:
    return iter(bin_means(key, values, bins)[1].tolist())


def _mean(values: Tensor, group: Tensor) -> float:
    return float(values[group].double().mean())
