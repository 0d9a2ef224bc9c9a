"""Studies of lifted runs: ablation, sweeps, signals, timing and baselines."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

import torch
from jaxtyping import Bool, Float, Int, Int32
from torch import Tensor

from normlift_ns.core.arguments import check_arguments
from normlift_ns.core.field import SemanticField
from normlift_ns.core.lift import Lifted, Scalars
from normlift_ns.core.lowrank import StoredDirections
from normlift_ns.core.metrics import NO_CLASS, bin_means, classify, kendall_test, lowest_jaccard, spearman_test
from normlift_ns.core.neighbors import Neighbors, nearest_neighbors
from normlift_ns.core.refine import decay_width, refine, voting_weights
from normlift_ns.core.reliability import reliability
from normlift_ns.errors import InputError
from normlift_ns.evaluation.baselines import BASELINES, baseline_field, time_dense_lift, timing_obstacle, with_consensus
from normlift_ns.evaluation.options import Evaluation, ScannetOptions, mean
from normlift_ns.evaluation.protocols import EvaluatedRun, MaskTruth, scene_names
from normlift_ns.evaluation.scannet import label_scene, predict_classes, read_labels
from normlift_ns.io.atomic import atomic_file
from normlift_ns.options import LiftOptions, RefineConfig, VoteKind

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Variant = Literal["none", "plain_knn", "linear", "norm_only", "support_only", "paper", "posterior"]


@check_arguments
def refine_variant(
    variant: Variant,
    means: Float[Tensor, "n 3"],
    lifted: Lifted,
    config: RefineConfig | None = None,
    *,
    beta: float = 1.0,
    neighbors: Neighbors | None = None,
) -> Float[Tensor, "n d"]:
    """Return the directions after one variant of the refinement, as unit rows or 0.

    Args:
        variant: "none" returns the directions of the lift. "linear" returns `linear_average`. The others vote with
            `variant_config` and `variant_reliability`.
        beta: Prior strength of the shrinkage of R, as in `lift`.
    Raises:
        ValueError: If the variant is unknown.

    >>> import torch
    >>> from normlift_ns import Evidence, RefineConfig, lift, refine_variant
    >>> from normlift_ns.core.evidence import Entries
    >>> entries = Entries(torch.tensor([0, 1, 2]), torch.tensor([1, 2, 1]), torch.ones(3), (2,))
    >>> lifted = lift(Evidence.from_entries([entries], 3), torch.eye(2))
    >>> means = torch.tensor([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]])
    >>> [refine_variant(name, means, lifted, RefineConfig(k=2))[1] for name in ("none", "linear", "paper")]
    [tensor([0., 1.]), tensor([0.7716, 0.6361]), tensor([1., 0.])]
    """
    reliability, directions = variant_reliability(variant, lifted.scalars, beta), lifted.directions()
    config = variant_config(variant, config or RefineConfig())
    if variant == "none":
        return directions
    neighbors = neighbors or nearest_neighbors(means, config.k)
    if variant == "linear":
        return linear_average(directions, reliability, neighbors, config)
    source = variant_source(variant, means, directions, lifted.scalars, config, beta=beta, neighbors=neighbors)
    return directions[source.long()]


def variant_source(
    variant: Variant,
    means: Float[Tensor, "n 3"],
    directions: Float[Tensor, "n d"] | Callable[[Tensor], Tensor],
    scalars: Scalars,
    config: RefineConfig,
    *,
    beta: float = 1.0,
    neighbors: Neighbors | None = None,
) -> Int32[Tensor, " n"]:
    """Run `refine` with the options and reliability of a variant.

    Raises:
        ValueError: If the variant is unknown, or an argument of `refine` is invalid.
    """
    reliability, config = variant_reliability(variant, scalars, beta), variant_config(variant, config)
    return refine(means, directions, reliability, config, own=scalars.own_evidence, neighbors=neighbors)


def variant_config(variant: Variant, config: RefineConfig) -> RefineConfig:
    """Return the vote options of a variant.

    "posterior" needs options of the posterior vote, and all other variants need those of the paper's vote. The result
    is `config` if it is of this kind. Otherwise, it has the defaults of this kind, with `k` and `prior` of `config`.

    >>> variant_config("posterior", RefineConfig(vote="paper", k=12, sigma_d=3.0)).numbers.sigma_d
    2.0
    """
    kind: VoteKind = "posterior" if variant == "posterior" else "paper"
    return config if config.vote == kind else RefineConfig(vote=kind, k=config.k, prior=config.prior)


def variant_reliability(variant: Variant, scalars: Scalars, beta: float = 1.0) -> Float[Tensor, " n"]:
    """Return the reliability R for the vote of a variant.

    R is 1 for every Gaussian with a direction ("plain_knn"), ||f|| ("norm_only"), or N_eff / (N_eff + beta)
    ("support_only"). All other variants use the product of the last two, which is NormLift's R.

    Raises:
        ValueError: If the variant is unknown.
    """
    if variant not in get_args(Variant):
        raise InputError(f"variant must be one of {', '.join(get_args(Variant))}, got {variant!r}")
    if variant == "plain_knn":
        return (scalars.norm > 0).to(scalars.norm.dtype)
    if variant == "norm_only":
        return scalars.norm
    support = reliability(1.0, scalars.n_eff, beta)
    return support if variant == "support_only" else scalars.norm * support


def linear_average(
    directions: Float[Tensor, "n d"], reliability: Float[Tensor, " n"], neighbors: Neighbors, config: RefineConfig
) -> Float[Tensor, "n d"]:
    """Return normalize(sum_{k in N+} R_k d_ik u_k) for every Gaussian i, or its direction u_i if the sum is 0.

    N+ contains i and its neighbors, R_k is the reliability, and d_ik decreases with the distance.
    """
    out, width = torch.empty_like(directions), decay_width(neighbors.spacing, config)
    for i in torch.arange(len(directions), device=directions.device).split(2**14):
        group = torch.cat([i[:, None], neighbors.index[i]], dim=1).clamp(min=0)
        weight = voting_weights(neighbors, width, i, reliability).to(directions.dtype)
        out[i] = torch.einsum("ik,ikd->id", weight, directions[group])
    length = torch.linalg.vector_norm(out, dim=1, keepdim=True)
    return torch.where(length > 0, out / length, directions)


# Alternative votes over the stored directions of a run, for the paper's ablation and a sweep of every parameter.


SWEEPS: dict[str, tuple[float, ...]] = {
    "beta": (0.25, 0.5, 1.0, 2.0, 4.0),
    "k": (12, 24, 36, 48, 60),
    "sigma_d": (0.5, 1.0, 1.5, 2.0, 3.0),
    "tau": (0.7, 0.75, 0.8, 0.85, 0.9),
    "gamma": (0.05, 0.1, 0.2, 0.4, 0.8),
    "delta": (0.0, 0.05, 0.1, 0.2, 0.3),
}
"""Values of each parameter, in addition to its default and the values of the runs.

Other parameters keep the values of the lift. The values of beta, K and Delta are those of the paper's appendix.
"""
CONSENSUS_VARIANTS: dict[str, Variant] = {
    "consensus": "none",
    "consensus_paper": "paper",
    "consensus_posterior": "posterior",
}
"""Variants of the vote after the consensus, by their name in the table."""
BETA = LiftOptions().reliability_beta
"""Default of `LiftOptions.reliability_beta`."""


@dataclass(frozen=True)
class Vote:
    """Variant and parameters of a vote."""

    variant: Variant
    config: RefineConfig
    beta: float
    label: Mapping[str, Any]
    """Columns of the table that distinguish the vote from others."""


def recorded_vote(manifest: Mapping[str, Any]) -> Vote:
    """Return the vote of the lift from its manifest, with defaults for missing values."""
    options = manifest.get("options", {})
    kind: dict[str, Any] = {"vote": "paper"} if "vote" in options else {}  # the only kind in version 0.1
    config = RefineConfig(**{**kind, **options.get("vote", {})})
    return Vote(config.vote, config, options.get("reliability_beta", BETA), {})


def voting_scalars(field: SemanticField) -> Scalars:
    """Return the scalars for a vote on a run.

    With consensus, ||f|| is the value before the consensus, from which the paper's R was computed. For other kinds of
    R, this value is unknown, and the vote uses ||f|| and R as stored.
    """
    scalars, options = field.scalars, field.manifest.get("options", {})
    if not options.get("consensus", False) or options.get("reliability", "paper") != "paper":
        return scalars
    support = reliability(1.0, scalars.n_eff, options.get("reliability_beta", BETA))
    return replace(scalars, norm=torch.where(support > 0, scalars.reliability / support, 0.0).clamp(max=1))


def variant_votes(variants: Mapping[str, Variant], owns: Sequence[Vote]) -> Iterator[list[Vote]]:
    """Yield the votes of every variant, one vote per run."""
    for name, variant in variants.items():
        yield [replace(own, variant=variant, label={"variant": name}) for own in owns]


def sweeps(owns: Sequence[Vote]) -> Iterator[list[Vote]]:
    """Yield the votes with each value of each parameter, one vote per run.

    The values are those of `SWEEPS`, the default and the values of the runs. Other parameters keep the values of the
    run. Labels mark the default and the values of the runs.
    """
    for parameter, values in SWEEPS.items():
        default = default_value(parameter, owns[0].config.vote)
        used = {_value(own, parameter) for own in owns}
        for value in sorted({*values, default, *used}):
            label = {"parameter": parameter, "value": value, "default": value == default, "own": value in used}
            yield [_changed(own, parameter, value, label) for own in owns]


def default_value(parameter: str, kind: VoteKind) -> float:
    """Return the default value of a parameter of `SWEEPS` for a kind of vote."""
    return _value(Vote(kind, RefineConfig(vote=kind), BETA, {}), parameter)


def _value(vote: Vote, parameter: str) -> float:
    if parameter == "beta":
        return vote.beta
    return getattr(vote.config if parameter == "k" else vote.config.numbers, parameter)


def _changed(own: Vote, parameter: str, value: float, label: Mapping[str, Any]) -> Vote:
    if parameter == "beta":
        return replace(own, beta=value, label=label)
    changed: dict[str, Any] = {parameter: int(value) if parameter == "k" else value}
    return replace(own, config=replace(own.config, **changed), label=label)


def make_voter(field: SemanticField, means: Float[Tensor, "n 3"], device: str) -> Callable[[Vote], SemanticField]:
    """Return a function that repeats the vote of a field with other options, on `device`.

    The function searches for neighbors once per K. Only linear averaging keeps all directions in memory.
    """
    device_field, means = field.to(device), means.to(device)
    scalars = voting_scalars(device_field)

    @cache
    def neighbors(k: int) -> Neighbors:
        return nearest_neighbors(means, k)

    def unrefined(gaussians: Tensor) -> Tensor:
        return device_field.directions(gaussians, refined=False)

    def apply(vote: Vote) -> SemanticField:
        near = neighbors(vote.config.k)
        own = torch.arange(len(field), dtype=torch.int32)
        if vote.variant == "none":
            return replace(field, source=own)
        if vote.variant == "linear":
            r = variant_reliability(vote.variant, scalars, vote.beta)
            config = variant_config(vote.variant, vote.config)
            directions = linear_average(unrefined(own.long().to(device)), r, near, config)
            valid = (directions != 0).any(dim=1)
            norm = torch.where(valid & (device_field.scalars.norm <= 0), 1.0, device_field.scalars.norm)
            changed = replace(field.scalars, norm=norm.to(field.scalars.norm))
            store = StoredDirections(directions[valid].half().cpu(), None)
            return replace(field, scalars=changed, source=own, store=store)
        kwargs = {"beta": vote.beta, "neighbors": near}
        source = variant_source(vote.variant, means, unrefined, scalars, vote.config, **kwargs)
        return replace(field, source=source.cpu())

    return apply


# Statistics of Gaussians without evidence, of accuracy by R and by ||f||, and of R against opacity.


_FAINT_OPACITY = 0.1
"""Opacity below which Gaussians count as faint."""
_HISTOGRAM_BINS = 20
"""Number of bins of R from 0 to 1. Gaussians with R = 0 are counted separately."""


@dataclass(frozen=True)
class SceneSignals:
    """Reliability, opacity, and true and predicted classes of the Gaussians of a scene."""

    scalars: Scalars
    opacity: Float[Tensor, " n"]
    """Opacity in 0..1."""
    truth: Int[Tensor, " n"] | None = None
    """Class of every Gaussian, or `NO_CLASS` for Gaussians to ignore. None without ground truth."""
    predictions: Mapping[str, Int[Tensor, " n"]] = field(default_factory=dict)
    """Predicted class of every Gaussian, under the keys "unrefined" and, if there was a vote, "refined"."""


def signal_statistics(*scenes: SceneSignals) -> dict[str, float]:
    """Return statistics by name, over the pooled Gaussians of all scenes.

    The groups are `all`, `zero` (R = 0) and `seen` (R > 0), as in the paper's table of zero-evidence Gaussians. Each
    has its `.share` of all Gaussians, the mean `.opacity`, the share of `.faint` Gaussians and the mean number of
    `.views`. With ground truth, each also has `.accuracy_unrefined` and, after a vote, `.accuracy_refined`.

    Opacity is compared with R for Gaussians with R > 0. `opacity.spearman` and `opacity.kendall` are correlations, with
    p-values `…_p`. `opacity.jaccard` is the Jaccard index of the fifth with the lowest R and the fifth with the lowest
    opacity. `opacity.quintile1` … are mean opacities in fifths of ascending R.

    With ground truth, `reliability.bin1` … are the accuracies of unrefined predictions in ten bins of equal count by R.
    `norm.bin1` … are those by ||f||. `….spearman_bins` is their rank correlation with the bin number.

    `histogram.0.00` … are shares of all Gaussians in bins of R, in which Gaussians with R = 0 are not counted. The
    p-values assume that Gaussians are independent, but neighbors are not independent.
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
    """Return a mask of the Gaussians with ground truth, and a mask of the correct predictions of each kind.

    Both are empty if a scene has no ground truth.
    """
    truths = [scene.truth for scene in scenes if scene.truth is not None]
    if len(truths) < len(scenes):
        return torch.zeros(0, dtype=torch.bool), {}
    right = {
        kind: torch.cat([scene.predictions[kind] == truth for scene, truth in zip(scenes, truths)])
        for kind in scenes[0].predictions
        if all(kind in scene.predictions for scene in scenes)
    }
    return torch.cat([truth != NO_CLASS for truth in truths]), right


def accuracy_bins(key: Float[Tensor, " n"], correct: Bool[Tensor, " n"], bins: int = 10) -> list[float]:
    """Return the share of correct predictions in bins of equal count by the key, for Gaussians with a key > 0."""
    positive = key > 0
    return list(_bins(key[positive], correct[positive].double(), bins))


def _bins(key: Tensor, values: Tensor, bins: int) -> Iterator[float]:
    return iter(bin_means(key, values, bins)[1].tolist())


def _mean(values: Tensor, group: Tensor) -> float:
    return float(values[group].double().mean())


# Figures of sweeps and signals.


def save_figure(figure: Figure, path: Path, *, overwrite: bool = False) -> None:
    """Write a figure reproducibly, without a date or random ids.

    Args:
        overwrite: Replace an existing file.
    """
    import matplotlib as mpl  # noqa: PLC0415 (only drawing needs it)

    with mpl.rc_context({"svg.hashsalt": "normlift"}), atomic_file(path, overwrite=overwrite) as draft:
        figure.savefig(draft, metadata={"Date": None} if path.suffix == ".svg" else None)


def sweeps_figure(rows: Sequence[Mapping[str, Any]], metric: str, label: str, result: float | None = None) -> Figure:
    """Plot the metric against each parameter of `SWEEPS`, with one panel per parameter.

    Args:
        rows: Rows with parameter, value and metric. The flags `default` and `own` mark the default and the run's value.
        label: Axis label of the metric.
        result: Main result of the run, drawn as a horizontal line in all panels.
    """
    parameters = list(dict.fromkeys(row["parameter"] for row in rows))
    figure, axes = make_figure((2 * (len(parameters) + 1), 5), 2, -(-len(parameters) // 2), sharey=True)
    for panel, parameter in zip(axes, parameters):
        points = sorted((row for row in rows if row["parameter"] == parameter), key=lambda row: row["value"])
        values = [row[metric] for row in points]
        panel.plot(range(len(points)), values, marker="o", markersize=4)
        panel.set_xticks(range(len(points)), [f"{row['value']:g}" for row in points])
        for mark, style in _MARKS.items():
            marked = [i for i, row in enumerate(points) if row.get(mark)]
            if len(marked) > 0:
                panel.plot(marked, [values[i] for i in marked], linestyle="none", **style)
        if result is not None:
            panel.axhline(result, color="tab:gray", linestyle="--", label="result")
        panel.set_xlabel(parameter, parse_math=False)
        panel.grid(alpha=0.3)
    axes[0].set_ylabel(label, parse_math=False)
    if len(axes[0].get_legend_handles_labels()[0]) > 0:
        axes[0].legend(fontsize="small")
    return figure


_MARKS: dict[str, dict[str, Any]] = {
    "default": {"marker": "D", "color": "tab:orange", "label": "default"},
    "own": {"marker": "o", "color": "black", "markerfacecolor": "none", "markersize": 11, "label": "this run"},
}


def signals_figure(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """Plot accuracy and reliability, with two panels per row of the study.

    The left panel shows the accuracy of unrefined predictions in ten bins by R and by ||f||, if there is ground truth.
    The right panel shows the histogram of R, with a separate bar for R = 0.
    """
    figure, axes = make_figure((9, 3.5 * len(rows)), len(rows), 2)
    for row, curves, histogram in zip(rows, axes[::2], axes[1::2]):
        for name, label in (("reliability", "R"), ("norm", "||f||")):
            bins = [100 * x for key, x in row.items() if key.startswith(f"{name}.bin")]
            if len(bins) > 0:
                curves.plot(range(1, len(bins) + 1), bins, marker="o", label=f"by {label}")
        curves.set_title(row.get("scene", ""), parse_math=False)
        curves.set_xlabel("tenth of the Gaussians, ascending")
        curves.set_ylabel("accuracy, unrefined, %")
        counts = {float(k.removeprefix("histogram.")): 100 * x for k, x in row.items() if k.startswith("histogram.")}
        width = 1 / len(counts)
        histogram.bar(list(counts), list(counts.values()), width=width, align="edge", label="R > 0")
        histogram.bar([-2 * width], [100 * row["zero.share"]], width=width, color="tab:red", label="R = 0")
        histogram.set_xlabel("R")
        histogram.set_ylabel("Gaussians, %")
        for panel in (curves, histogram):
            panel.grid(axis="y", alpha=0.3)
            if len(panel.get_legend_handles_labels()[0]) > 0:
                panel.legend()
    return figure


def make_figure(size: tuple[float, float], rows: int, columns: int, **options: Any) -> tuple[Figure, list[Any]]:
    """Return a figure with the given size in inches, and its panels row by row."""
    from matplotlib.figure import Figure  # noqa: PLC0415 (only drawing needs it)

    figure = Figure(figsize=size, layout="constrained")
    return figure, list(figure.subplots(rows, columns, squeeze=False, **options).flat)


Evaluate = Callable[[Iterable[EvaluatedRun]], Evaluation]
Row = Mapping[str, Any]


def study_votes(
    runs: Sequence[EvaluatedRun],
    evaluate: Evaluate,
    votes: Callable[[Sequence[Vote]], Iterator[Sequence[Vote]]],
    device: str,
) -> list[Row]:
    """Evaluate the protocol with the votes that `votes` yields for the runs. Equal votes are evaluated once."""
    voters = [make_voter(lifted.field, lifted.scene.gaussians.means, device) for lifted in runs]
    results: dict[Any, Mapping[str, float]] = {}
    rows: list[Row] = []
    for run_votes in votes([recorded_vote(lifted.field.manifest) for lifted in runs]):
        key = tuple((vote.variant, vote.config, vote.beta) for vote in run_votes)
        if key not in results:
            fields = (vote_again(vote) for vote_again, vote in zip(voters, run_votes))
            voted = (replace(lifted, field=field, refined=True) for lifted, field in zip(runs, fields))
            results[key] = evaluate(voted).results
        rows.append({**run_votes[0].label, **results[key]})
    return rows


def study_ablation(
    runs: Sequence[EvaluatedRun], evaluate: Evaluate, device: str, warn: Callable[[str], None] = lambda text: None
) -> list[Row]:
    """Evaluate the protocol with every variant without consensus, and with `CONSENSUS_VARIANTS` after a consensus.

    Args:
        warn: Function that receives a warning if variants are skipped because features of a run are not available.
    """
    rows: list[Row] = []
    for on, names in ((False, {name: name for name in get_args(Variant)}), (True, CONSENSUS_VARIANTS)):
        try:
            again = [with_consensus(lifted, on, device) for lifted in runs]
        except (ValueError, FileNotFoundError) as error:
            warn(f"The ablation skips all variants {'with' if on else 'without'} consensus: {error}")
            continue
        rows += study_votes(again, evaluate, partial(variant_votes, names), device)
    return rows


def signal_rows(names: Sequence[str], scenes: Sequence[SceneSignals]) -> list[Row]:
    """Return `signal_statistics` of every scene and, if there are several scenes, of all scenes pooled."""
    rows: list[Row] = [{"scene": name, **signal_statistics(scene)} for name, scene in zip(names, scenes)]
    return [*rows, {"scene": POOLED_SCENE, **signal_statistics(*scenes)}] if len(rows) > 1 else rows


POOLED_SCENE = "all scenes"
"""Scene name in the row of pooled statistics."""


def scannet_signals(runs: Sequence[EvaluatedRun], labels: Sequence[Path], options: ScannetOptions) -> list[Row]:
    """Return `signal_rows` of runs for the 19 classes of ScanNet."""
    names, scenes = scene_names(labels), []
    kwargs = {"min_opacity": options.min_opacity, "without_direction": options.without_direction}
    for lifted, name, path in zip(runs, names, labels):
        nyu40, predictions, truth = read_labels(path), {}, None
        for kind, run in _by_refinement(lifted).items():
            truth, predictions[kind] = predict_classes(label_scene(run, name, path, nyu40, options), 19, **kwargs)
        scenes.append(SceneSignals(lifted.field.scalars, lifted.scene.gaussians.opacities, truth, predictions))
    return signal_rows(names, scenes)


def mask_signals(lifted: EvaluatedRun, truth: MaskTruth) -> list[Row]:
    """Return `signal_rows` of a run for the classes of its masks."""
    predictions = {kind: classify(run.cosine(truth.classes), run.valid) for kind, run in _by_refinement(lifted).items()}
    scene = SceneSignals(lifted.field.scalars, lifted.scene.gaussians.opacities, truth.gaussians, predictions)
    return signal_rows([lifted.scene.name], [scene])


def plain_signals(runs: Sequence[EvaluatedRun], labels: Sequence[Path]) -> list[Row]:
    """Return `signal_rows` of runs without ground truth."""
    scenes = [SceneSignals(lifted.field.scalars, lifted.scene.gaussians.opacities) for lifted in runs]
    return signal_rows(scene_names(labels), scenes)


def _by_refinement(lifted: EvaluatedRun) -> dict[str, EvaluatedRun]:
    """Return the run with unrefined directions and, if it was lifted with a vote, with refined directions."""
    voted = lifted.field.manifest.get("options", {}).get("refine", True)
    kinds = {"unrefined": False, **({"refined": True} if voted else {})}
    return {kind: replace(lifted, refined=refined) for kind, refined in kinds.items()}


def study_baselines(runs: Sequence[EvaluatedRun], evaluate: Evaluate, device: str) -> list[Row]:
    """Evaluate the protocol for the runs and for `BASELINES` on the same features. Baselines are not refined.

    Raises:
        ValueError, FileNotFoundError: If the features of a run are not available (see `lifted_batches`).
    """
    rows: list[Row] = []
    for name, what, refined in (("normlift", "the run, refined", True), ("unrefined", "the run, unrefined", False)):
        results = evaluate(replace(lifted, refined=refined) for lifted in runs).results
        rows.append({"method": name, "what": what, **results})
    for method, what in BASELINES.items():
        relifted = (replace(lifted, field=baseline_field(method, lifted, device), refined=False) for lifted in runs)
        rows.append({"method": method, "what": what, **evaluate(relifted).results})
    return rows


def study_timing(
    runs: Sequence[EvaluatedRun], device: str = "cpu", tell: Callable[[str], None] = lambda text: None
) -> list[Row]:
    """Return the seconds of every stage and the peak memory of every lift from the manifests, and means over the lifts.

    On a GPU, also time the method of Splat Feature Solver and that of this package on some views of each run.

    Args:
        tell: Function that receives a message with the reason if the method of Splat Feature Solver is skipped.
    """
    rows = []
    for lifted in runs:
        row = {"scene": lifted.scene.name, **lifted.field.manifest.get("cost", {})}
        reason = timing_obstacle(lifted, device)
        if reason is None:
            try:
                row |= time_dense_lift(lifted, device)
            except (ValueError, FileNotFoundError) as error:  # features are not available
                reason = str(error)
        if reason is not None:
            method = "the method of Splat Feature Solver (all channels of feature maps through gsplat)"
            tell(f"The timing of {lifted.scene.name} skips {method}: {reason}")
        rows.append(row)
    keys = list(dict.fromkeys(key for row in rows for key in row if key != "scene"))
    table: list[Row] = [{"scene": row["scene"], **{key: row.get(key, math.nan) for key in keys}} for row in rows]
    means = {key: mean([row[key] for row in table]) for key in keys}
    return [*table, {"scene": "mean", **means}] if len(table) > 1 else table
