"""What R knows of a scene: Gaussians without evidence, accuracy by R and by ||f||, R against opacity."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from normlift_ns.core.lift import Scalars
from normlift_ns.core.metrics import NO_CLASS, bin_means, kendall_test, lowest_jaccard, spearman_test

FAINT = 0.1
"""Opacity below which a Gaussian is faint."""
HISTOGRAM = 20
"""Bins of R from 0 to 1; R = 0 is apart."""


@dataclass(frozen=True)
class SceneSignals:
    """What is known of the Gaussians of one scene."""

    scalars: Scalars
    opacity: Float[Tensor, " n"]
    """In 0..1."""
    truth: Int[Tensor, " n"] | None = None
    """Class of every Gaussian, `NO_CLASS` where it does not count; None: nothing tells it, and there are no accuracies.
    """
    answers: Mapping[str, Int[Tensor, " n"]] = field(default_factory=dict)
    """Class that a direction answers: "unrefined", and "refined" where a vote was taken."""


def signals(*scenes: SceneSignals) -> dict[str, float]:
    """Figures by name, of the Gaussians of all scenes together.

    `all`, `zero` (R = 0) and `seen` (R > 0), as in the paper's table of zero-evidence Gaussians: `.share` of all
    Gaussians, mean `.opacity`, share of `.faint` ones, mean `.views` that see them, `.accuracy_unrefined` and
    `.accuracy_refined` of those whose truth is known. Of those with R > 0, R against opacity: `opacity.spearman` and
    `opacity.kendall` with their p-values `…_p`, `opacity.jaccard` of the lowest fifths, `opacity.quintile1` … mean
    opacity by ascending R. `reliability.bin1` … `bin10` and `norm.bin1` …: accuracy of unrefined answers in tenths of
    equal count, `….spearman_bins` their rank correlation with the order. `histogram.0.00` …: share of R.

    The p-values take Gaussians for independent of each other, which neighbours are not.
    """
    reliability, norm, views = (
        torch.cat([getattr(scene.scalars, name) for scene in scenes]) for name in ("reliability", "norm", "view_count")
    )
    opacity, seen = torch.cat([scene.opacity for scene in scenes]), reliability > 0
    known, correct = _answered(scenes)
    out: dict[str, float] = {}
    for name, group in (("all", torch.ones_like(seen)), ("zero", ~seen), ("seen", seen)):
        out[f"{name}.share"] = _mean(group, torch.ones_like(group))
        out[f"{name}.opacity"] = _mean(opacity, group)
        out[f"{name}.faint"] = _mean(opacity < FAINT, group)
        out[f"{name}.views"] = _mean(views, group)
        out |= {f"{name}.accuracy_{kind}": _mean(right, group & known) for kind, right in correct.items()}
    r, o = reliability[seen], opacity[seen]
    for name, found in (("spearman", spearman_test(r, o)), ("kendall", kendall_test(r, o))):
        out |= {f"opacity.{name}": found.value, f"opacity.{name}_p": found.p}
    out["opacity.jaccard"] = lowest_jaccard(r, o)
    out |= {f"opacity.quintile{i + 1}": x for i, x in enumerate(_bins(r, o, 5))}
    if "unrefined" in correct:
        for name, key in (("reliability", reliability), ("norm", norm)):
            bins = accuracy_bins(key[known], correct["unrefined"][known])
            out |= {f"{name}.bin{i + 1}": x for i, x in enumerate(bins)}
            order = torch.arange(len(bins), dtype=torch.float64)
            found = spearman_test(order, torch.tensor(bins, dtype=torch.float64))
            out |= {f"{name}.spearman_bins": found.value, f"{name}.spearman_bins_p": found.p}
    counts = torch.histc(r.double(), bins=HISTOGRAM, min=0, max=1) / max(1, len(reliability))
    return out | {f"histogram.{i / HISTOGRAM:.2f}": float(x) for i, x in enumerate(counts)}


def _answered(scenes: Sequence[SceneSignals]) -> tuple[Bool[Tensor, " n"], dict[str, Bool[Tensor, " n"]]]:
    """Where the truth is known, and where each kind of answer is right."""
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
    """Share of correct answers in bins of equal count by the key, where it is positive."""
    some = key > 0
    return list(_bins(key[some], correct[some].double(), bins))


def _bins(key: Tensor, values: Tensor, bins: int) -> Iterator[float]:
    return iter(bin_means(key, values, bins)[1].tolist())


def _mean(values: Tensor, group: Tensor) -> float:
    return float(values[group].double().mean())
