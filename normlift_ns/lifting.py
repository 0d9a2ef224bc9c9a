"""Pipeline from a trained scene and a source of 2D features to a semantic field. Read this module first."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int32, Int64
from torch import Tensor

from normlift_ns.core.consensus import SEED, consensus, seen_reliability
from normlift_ns.core.evidence import Evidence
from normlift_ns.core.field import SemanticField
from normlift_ns.core.gaussians import GaussianScene
from normlift_ns.core.lift import Lifted, Scalars, lift
from normlift_ns.core.neighbors import nearest_neighbors
from normlift_ns.core.portions import ALONE, Portion, Team
from normlift_ns.core.refine import decay_width, possible, refine, unsupported, vote_of
from normlift_ns.core.scene import Scene, camera_summary
from normlift_ns.encoders.langsplat.source import refuse_equal_stems
from normlift_ns.encoders.source import FeatureSource
from normlift_ns.errors import InputError
from normlift_ns.observing import spread
from normlift_ns.options import LiftOptions, RefineConfig
from normlift_ns.raster.gsplat import rules_named
from normlift_ns.raster.rasterize import backend_of
from normlift_ns.raster.settings import RasterSettings
from normlift_ns.rehearsal import rehearse
from normlift_ns.stages import Report, Stages, cost
from normlift_ns.team.exchange import with_neighbors
from normlift_ns.team.seen import Drawing, Export, look

_MIN_LIFTED_SHARE = 0.01
"""Share of Gaussians with features below which to warn: something is wrong, or almost no pixel was labeled."""


class LiftResult(NamedTuple):
    """Semantic field of a lift, and the time it took."""

    field: SemanticField
    seconds: dict[str, float]
    """Duration of each stage, in order: features, evidence, consensus (if enabled), lift, neighbors, vote, store."""


def lift_scene(
    scene: Scene,
    source: FeatureSource,
    options: LiftOptions,
    cache: Path,
    *,
    device: str = "cpu",
    encoder: Mapping[str, Any],
    export: Export | None = None,
    report: Report = lambda stage, done, total: None,
) -> LiftResult:
    """Lift 2D features onto the Gaussians of a trained scene.

    Args:
        cache: folder for 2D features and evidence. It is created if missing, and may be deleted at any time.
        device: device for rasterizing, lifting and voting.
        encoder: options that queries need to encode prompts in the same way. The manifest stores them.
        export: where to also write the 2D features, in LangSplat's format.
        report: called with the progress.
    Raises:
        ValueError, FileNotFoundError: an image, a label map or an option does not fit, which the message names, or no
            pixel is labeled.
        MemoryError: the lift does not fit into GPU memory.
    """
    result = lift_together(
        ALONE, scene, source, options, cache, device=device, encoder=encoder, export=export, report=report
    )
    assert result is not None
    return result


def lift_together(
    team: Team,
    scene: Scene,
    source: FeatureSource,
    options: LiftOptions,
    cache: Path,
    *,
    device: str,
    encoder: Mapping[str, Any],
    export: Export | None,
    report: Report,
) -> LiftResult | None:
    """Run `lift_scene` in several processes, each with the whole scene. Only rank 0 gets the result.

    The result does not depend on the number of processes. The evidence of a view does not depend on other views, and
    Gaussians are processed in the same blocks.
    """
    stages = Stages(team.counted(report))
    gaussians, views = scene.gaussians.to(device), scene.train
    options = replace(options, vote=possible(options.vote, len(gaussians))) if options.refine else options
    config = drawing_of(scene, gaussians, options)
    names = set(source.available(views.names))
    usable = [index for index, name in enumerate(views.names) if name in names]
    used = [usable[i] for i in spread(len(usable), options.max_views)]
    if export is not None:
        refuse_equal_stems([views.names[index] for index in used])
    wait_for_kernels = get_ready(scene, gaussians, options, config)
    portion = Portion.of(team, gaussians.means)
    evidence, features, level = look(
        scene, gaussians, used, source, options, config, cache, export, stages, wait_for_kernels, portion
    )
    table, consensus_facts = features, {}
    if options.consensus:
        table, consensus_facts = _run_consensus(evidence, features, level, options, portion, stages)
    with stages("lift") as step:
        kwargs = {"beta": options.beta, "unlabeled": options.unlabeled}
        lifted = lift(evidence, table, **kwargs)
        _check_directions(evidence, lifted.scalars, source, portion)
        own = lifted.scalars.own_evidence
        if options.consensus:
            before = lift(evidence, features, **kwargs).scalars
            own = torch.where(lifted.scalars.norm > 0, before.own_evidence, 0.0)
            lifted = replace(lifted, scalars=seen_reliability(lifted.scalars, before))
        step()
    counts = {"views": len(used), "left_out": len(views) - len(usable), "excluded": evidence.num_excluded}
    copied, vote_facts = None, {}
    if options.refine:
        copied, vote_facts = vote_together(gaussians.means, lifted, own, options.vote, portion, stages)
    with stages("store") as step:
        provenance = {
            **scene.identity,
            "encoder": dict(encoder),
            "cameras": camera_summary(scene.train.cameras),
            "cameras_held_out": camera_summary(scene.held_out.cameras),
            "features": source.identity,
            "options": asdict(options),
            "views_lifted": [views.names[index] for index in used],
            "views_without_features": [name for name in views.names if name not in names],
            "gsplat_rules": config.rules,
            "backend": config.backend,
            "statistics": {
                **counts,
                **consensus_facts,
                **_statistics(portion.join(lifted.scalars.reliability)),
                **vote_facts,
            },
        }
        kwargs = {"tolerance": options.tolerance, "storage": options.storage}
        field = SemanticField.build_together(lifted, gaussians.means, copied, portion, provenance=provenance, **kwargs)
        step()
    if field is None:
        return None
    field = replace(field, manifest={**field.manifest, "cost": cost(stages.seconds, device)})
    return LiftResult(field, stages.seconds)


def drawn_by(scene: Scene, options: LiftOptions) -> str:
    """Return the gsplat version whose rasterization rules a lift follows.

    Raises:
        ValueError: the options ask for the rules of the installed gsplat, but it is not installed.
    """
    return rules_named(options.gsplat_rules, scene.identity.get("gsplat_rules"))


def drawing_of(scene: Scene, gaussians: GaussianScene, options: LiftOptions) -> Drawing:
    """Choose how to rasterize, and raise before any image is read if that is impossible."""
    rules = drawn_by(scene, options)
    dtype = torch.float64 if options.precision == "double" else torch.float32
    settings = RasterSettings.of_gsplat(rules)
    power = options.weight_power
    backend = backend_of(gaussians, options.backend, settings=settings, dtype=dtype, weight_power=power)
    return Drawing(rules, backend, dtype)


def get_ready(scene: Scene, gaussians: GaussianScene, options: LiftOptions, drawing: Drawing) -> Callable[[], None]:
    """Start to compile or load kernels in the background; return a function that waits for them."""
    if drawing.backend == "numba":
        from normlift_ns.raster.numba import warm  # noqa: PLC0415 (importing numba takes a second)

        return warm(drawing.dtype).join
    if drawing.backend != "triton" or len(scene.train) == 0:
        return lambda: None
    kwargs = {"settings": drawing.settings, "backend": drawing.backend, "dtype": drawing.dtype}
    return rehearse(gaussians, scene.train.cameras[0], options, rasterize_mode=scene.rasterize_mode, **kwargs).join


def _check_directions(evidence: Evidence, scalars: Scalars, source: FeatureSource, portion: Portion) -> None:
    """Raise if no Gaussian received a direction.

    Raises:
        ValueError: no Gaussian has a direction.
    """
    entries = torch.tensor(evidence.nnz, device=scalars.norm.device)
    lifted, entries = portion.team.add(torch.stack([(scalars.norm > 0).sum(), entries])).tolist()
    total = len(portion.order)
    if lifted == 0 and entries == 0:
        raise InputError(
            f"nothing was labeled: no pixel that shows any of the {total:,} Gaussians belongs to a region (from "
            f"{_describe(source)}). Likely causes: every value in the label maps is negative or the background "
            "(--regions-background), the level has no regions (--level), masks exclude everything, or the cameras do "
            "not see the scene"
        )
    if lifted == 0:
        raise InputError(
            f"none of the {total:,} Gaussians received a direction, although they have regions (from "
            f"{_describe(source)}): the features cancel out in every Gaussian, or unlabeled pixels outweigh them "
            "(--unlabeled dilute)"
        )
    if lifted < _MIN_LIFTED_SHARE * total:
        warnings.warn(
            f"only {lifted:,} of {total:,} Gaussians ({lifted / total:.2%}) appear in labeled pixels; the others have "
            f"no features. If you did not expect this, check the regions (from {_describe(source)}) and the cameras",
            stacklevel=2,
        )


def _describe(source: FeatureSource) -> str:
    """Describe the source of the regions, for a message."""
    regions = getattr(source, "regions", source)
    kind, folder = regions.identity.get("kind", "your own source"), getattr(regions, "folder", None)
    return str(kind) if folder is None else f"{kind} in {folder}"


def _run_consensus(
    evidence: Evidence,
    features: Float[Tensor, "s d"],
    level: Int64[Tensor, " s"],
    options: LiftOptions,
    portion: Portion,
    stages: Stages,
) -> tuple[Float[Tensor, "s d"], dict[str, Any]]:
    """Return the features after consensus, and what the manifest records about it."""
    with stages("consensus") as step:
        kwargs = {
            "power": options.consensus_power, "sample": options.consensus_sample, "least": options.consensus_least
        }  # fmt: skip
        result = consensus(evidence, features, level=level, portion=portion, **kwargs)
        step()
    facts = {**kwargs, "seed": SEED, "gaussians": result.gaussians, "agreement": result.agreement}
    return result.features, {"consensus": facts}


def vote_together(
    means: Float[Tensor, "n 3"],
    lifted: Lifted,
    own: Float[Tensor, " m"],
    config: RefineConfig,
    portion: Portion,
    stages: Stages,
) -> tuple[Int32[Tensor, " m"], dict[str, float]]:
    """Vote in one or several processes.

    Returns:
        For every Gaussian of the partition, the Gaussian whose direction it takes. Also the shares of all Gaussians
        that change their direction and that have no support.
    """
    gaussians = portion.gaussians
    with stages("neighbors", len(gaussians)):
        progress = partial(stages.tell, "neighbors")
        of = gaussians if portion.team.size > 1 else None
        neighbors = nearest_neighbors(means, config.k, of=of, progress=progress, team=portion.team)
    with stages("vote", len(gaussians)):
        progress = partial(stages.tell, "vote")
        if portion.team.size == 1:
            reliability = lifted.scalars.reliability
            copied = refine(
                means, lifted.directions, reliability, config, own=own, neighbors=neighbors, progress=progress
            )
        else:
            halo = with_neighbors(lifted, neighbors, portion)
            neighbors, reliability = halo.neighbors, portion.join(lifted.scalars.reliability)[halo.gaussians]
            own = torch.cat([own, own.new_zeros(len(halo.gaussians) - len(own))])
            kwargs = {"own": None if config.vote == "paper" else own, "progress": progress}
            width = decay_width(portion.team.join(neighbors.spacing), config)
            directions = halo.lifted.directions
            rows = vote_of(portion.along, neighbors, directions, reliability, config, width=width, **kwargs)
            copied = halo.gaussians[rows[: len(gaussians)].long()].int()
        changed, lost = (copied != gaussians).sum(), unsupported(neighbors, reliability).sum()
        changed, lost = portion.team.add(torch.stack([changed, lost])).tolist()
    return copied, {"refined_share": changed / len(means), "unsupported_share": lost / len(means)}


def _statistics(reliability: Float[Tensor, " n"]) -> dict[str, Any]:
    positive = reliability[reliability > 0].double().sort().values
    n, count, shares = reliability.numel(), len(positive), (0.05, 0.25, 0.5, 0.75, 0.95)
    quantiles = {str(q): float(positive[round(q * (count - 1))]) for q in shares} if count > 0 else {}
    return {"gaussians": n, "zero_evidence_share": 1 - count / max(1, n), "reliability_quantiles": quantiles}
