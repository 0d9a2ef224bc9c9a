"""From a trained scene and a source of 2D features to a semantic field: the page to read first."""

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

_FEW = 0.01
"""Share of Gaussians with features below which something is wrong, or nearly nothing was labelled."""


class LiftResult(NamedTuple):
    """A field and how it came about."""

    field: SemanticField
    seconds: dict[str, float]
    """Of each stage, in their order: features, evidence, consensus (if asked for), lift, neighbors, vote, store."""


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
    """Lifts 2D features onto the Gaussians of a trained scene.

    Args:
        cache: folder for 2D features and evidence; made if missing, may be deleted at any time.
        device: where to rasterize, lift and vote.
        encoder: the options that queries need to encode texts likewise; kept in the manifest.
        export: where to write the 2D features too, in LangSplat's format.
        report: told of the progress.
    Raises:
        ValueError, FileNotFoundError: an image, a label map or an option that does not fit; the message names it.
            Nothing that is labelled at all.
        MemoryError: the GPU's memory does not hold the lift.
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
    """`lift_scene` by the processes of a team, each with the whole scene; process 0 alone gets the result.

    It does not depend on how many there are: what is found of a view does not depend on the views beside it, and
    Gaussians are worked on in the same blocks.
    """
    stages = Stages(team.counted(report))
    gaussians, views = scene.gaussians.to(device), scene.train
    options = replace(options, vote=possible(options.vote, len(gaussians))) if options.refine else options
    drawing = drawing_of(scene, gaussians, options)
    names = set(source.available(views.names))
    usable = [index for index, name in enumerate(views.names) if name in names]
    used = [usable[i] for i in spread(len(usable), options.max_views)]
    if export is not None:
        refuse_equal_stems([views.names[index] for index in used])
    ready = get_ready(scene, gaussians, options, drawing)
    portion = Portion.of(team, gaussians.means)
    evidence, features, level = look(
        scene, gaussians, used, source, options, drawing, cache, export, stages, ready, portion
    )
    table, agreed = _agree(evidence, features, level, options, portion, stages) if options.consensus else (features, {})
    with stages("lift") as step:
        how = {"beta": options.beta, "unlabeled": options.unlabeled}
        lifted = lift(evidence, table, **how)
        _check_seen(evidence, lifted.scalars, source, portion)
        own = lifted.scalars.own_evidence
        if options.consensus:
            seen = lift(evidence, features, **how).scalars
            own = torch.where(lifted.scalars.norm > 0, seen.own_evidence, 0.0)
            lifted = replace(lifted, scalars=seen_reliability(lifted.scalars, seen))
        step()
    counts = {"views": len(used), "left_out": len(views) - len(usable), "excluded": evidence.num_excluded}
    voted = vote_together(gaussians.means, lifted, own, options.vote, portion, stages) if options.refine else (None, {})
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
            "gsplat_rules": drawing.rules,
            "backend": drawing.backend,
            "statistics": {**counts, **agreed, **_statistics(portion.join(lifted.scalars.reliability)), **voted[1]},
        }
        rule = {"tolerance": options.tolerance, "storage": options.storage}
        built = SemanticField.build_together(lifted, gaussians.means, voted[0], portion, provenance=provenance, **rule)
        step()
    if built is None:
        return None
    built = replace(built, manifest={**built.manifest, "cost": cost(stages.seconds, device)})
    return LiftResult(built, stages.seconds)


def drawn_by(scene: Scene, options: LiftOptions) -> str:
    """The version of gsplat by whose rules a lift draws the scene.

    Raises:
        ValueError: the rules of the installed gsplat are asked for, and none is there.
    """
    return rules_named(options.gsplat_rules, scene.identity.get("gsplat_rules"))


def drawing_of(scene: Scene, gaussians: GaussianScene, options: LiftOptions) -> Drawing:
    """How to rasterize, refused before anything has been looked at where it cannot be done."""
    rules = drawn_by(scene, options)
    dtype = torch.float64 if options.precision == "double" else torch.float32
    settings = RasterSettings.of_gsplat(rules)
    power = options.weight_power
    backend = backend_of(gaussians, options.backend, settings=settings, dtype=dtype, weight_power=power)
    return Drawing(rules, backend, dtype)


def get_ready(scene: Scene, gaussians: GaussianScene, options: LiftOptions, drawing: Drawing) -> Callable[[], None]:
    """Has kernels compiled or loaded meanwhile; waits for them when it is called."""
    if drawing.backend == "numba":
        from normlift_ns.raster.numba import warm  # noqa: PLC0415 (importing numba takes a second)

        return warm(drawing.dtype).join
    if drawing.backend != "triton" or len(scene.train) == 0:
        return lambda: None
    how = {"settings": drawing.settings, "backend": drawing.backend, "dtype": drawing.dtype}
    return rehearse(gaussians, scene.train.cameras[0], options, rasterize_mode=scene.rasterize_mode, **how).join


def _check_seen(evidence: Evidence, scalars: Scalars, source: FeatureSource, portion: Portion) -> None:
    """A lift that tells nothing is none.

    Raises:
        ValueError: no Gaussian has a direction.
    """
    entries = torch.tensor(evidence.nnz, device=scalars.norm.device)
    found, entries = portion.team.add(torch.stack([(scalars.norm > 0).sum(), entries])).tolist()
    total = len(portion.order)
    if found == 0 and entries == 0:
        raise InputError(
            f"nothing was labelled: no pixel that any of the {total:,} Gaussians is seen in belongs to a region (of "
            f"{_named(source)}). Likely causes: every value in the label maps is the background (--regions-background)"
            " or negative, the level has no regions (--level), masks leave nothing, or the cameras do not see the scene"
        )
    if found == 0:
        raise InputError(
            f"none of the {total:,} Gaussians got a direction, though regions were seen (of {_named(source)}): their "
            "features cancel in every Gaussian, or unlabelled pixels outweigh them (--unlabeled dilute)"
        )
    if found < _FEW * total:
        warnings.warn(
            f"only {found:,} of {total:,} Gaussians ({found / total:.2%}) are seen in labelled pixels; the others have "
            f"no features. If that is not meant, check the regions (of {_named(source)}) and the cameras",
            stacklevel=2,
        )


def _named(source: FeatureSource) -> str:
    """Where regions come from, for a message."""
    regions = getattr(source, "regions", source)
    kind, folder = regions.identity.get("kind", "your own source"), getattr(regions, "folder", None)
    return str(kind) if folder is None else f"{kind} in {folder}"


def _agree(
    evidence: Evidence,
    features: Float[Tensor, "s d"],
    level: Int64[Tensor, " s"],
    options: LiftOptions,
    portion: Portion,
    stages: Stages,
) -> tuple[Float[Tensor, "s d"], dict[str, Any]]:
    """The feature table on which the views agree, and what the manifest says of it."""
    with stages("consensus") as step:
        how = {
            "power": options.consensus_power, "sample": options.consensus_sample, "least": options.consensus_least
        }  # fmt: skip
        found = consensus(evidence, features, level=level, portion=portion, **how)
        step()
    facts = {**how, "seed": SEED, "gaussians": found.gaussians, "agreement": found.agreement}
    return found.features, {"consensus": facts}


def vote_together(
    means: Float[Tensor, "n 3"],
    lifted: Lifted,
    own: Float[Tensor, " m"],
    config: RefineConfig,
    portion: Portion,
    stages: Stages,
) -> tuple[Int32[Tensor, " m"], dict[str, float]]:
    """Whose direction every Gaussian of the portion takes, and the shares of all Gaussians that change theirs and that
    nobody supports.
    """
    mine = portion.gaussians
    with stages("neighbors", len(mine)):
        told = partial(stages.tell, "neighbors")
        of = mine if portion.team.size > 1 else None
        neighbors = nearest_neighbors(means, config.k, of=of, progress=told, team=portion.team)
    with stages("vote", len(mine)):
        told = partial(stages.tell, "vote")
        if portion.team.size == 1:
            reliability = lifted.scalars.reliability
            copied = refine(means, lifted.directions, reliability, config, own=own, neighbors=neighbors, progress=told)
        else:
            around = with_neighbors(lifted, neighbors, portion)
            neighbors, reliability = around.neighbors, portion.join(lifted.scalars.reliability)[around.gaussians]
            own = torch.cat([own, own.new_zeros(len(around.gaussians) - len(own))])
            how = {"own": None if config.vote == "paper" else own, "progress": told}
            width = decay_width(portion.team.join(neighbors.spacing), config)
            voting = around.lifted.directions
            places = vote_of(portion.along, neighbors, voting, reliability, config, width=width, **how)[: len(mine)]
            copied = around.gaussians[places.long()].int()
        changed, lost = (copied != mine).sum(), unsupported(neighbors, reliability).sum()
        changed, lost = portion.team.add(torch.stack([changed, lost])).tolist()
    return copied, {"refined_share": changed / len(means), "unsupported_share": lost / len(means)}


def _statistics(reliability: Float[Tensor, " n"]) -> dict[str, Any]:
    found = reliability[reliability > 0].double().sort().values
    shares = (0.05, 0.25, 0.5, 0.75, 0.95)
    quantiles = {str(q): float(found[round(q * (len(found) - 1))]) for q in shares} if len(found) > 0 else {}
    n = reliability.numel()
    return {"gaussians": n, "zero_evidence_share": 1 - len(found) / max(1, n), "reliability_quantiles": quantiles}
