"""Lifting into a new run, in one or several processes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from jaxtyping import Float
from torch import Tensor

from normlift_ns.asking import answer
from normlift_ns.core.field import SemanticField
from normlift_ns.core.gpu import choose_device, wake
from normlift_ns.core.portions import Team
from normlift_ns.core.scene import Scene
from normlift_ns.encoders.build import make_source, source_settings
from normlift_ns.encoders.given import GivenFeatures, given_features
from normlift_ns.encoders.source import FeatureSource
from normlift_ns.errors import InputError
from normlift_ns.lifted_run import LiftedRun
from normlift_ns.lifting import drawn_by, lift_together
from normlift_ns.options import CANONICAL_NEGATIVES, LiftOptions, SourceOptions
from normlift_ns.question import Question, make_question
from normlift_ns.ranges import check_bool, check_path, check_texts
from normlift_ns.raster.settings import RasterSettings
from normlift_ns.runs.files import (
    FIELD_FOLDER,
    TEXTS_FILE,
    cache_folder,
    refuse_existing_run,
    run_directory,
    tidy,
    with_paths,
)
from normlift_ns.runs.write import write_run
from normlift_ns.scenes.match import judge, match_photographs
from normlift_ns.scenes.nerfstudio.load import NerfstudioScene
from normlift_ns.scenes.opening import SplatScene
from normlift_ns.stages import Report, Stages
from normlift_ns.team.seen import Export
from normlift_ns.text_encoders import encoder_settings, given_settings


def lift_run_together(
    team: Team,
    opened: Callable[[], Scene],
    *,
    source: SourceOptions | None,
    features: Sequence[tuple[Any, Any]] | Mapping[str, tuple[Any, Any]] | None,
    texts: Mapping[str, Float[Tensor, " d"]] | None,
    lift: LiftOptions | None,
    queries: Sequence[str],
    output_dir: str | Path | None,
    timestamp: str | None,
    overwrite: bool,
    check: bool,
    device: str,
    export: Export | None,
    report: Report,
    say: Callable[[str], None],
) -> LiftedRun | None:
    """Run `lift_run` in several processes, all with the same arguments. Only rank 0 writes and returns the run.

    Args:
        opened: opens the trained scene. It is called after all checks that do not need the scene.
    """
    if features is None and texts is not None:
        raise InputError("texts are for your own features; pass features, too, or omit texts")
    if features is not None and source is not None:
        raise InputError("features replace source; pass only one of the two")
    check_texts("queries", queries)
    check_bool("overwrite", overwrite)
    check_bool("check", check)
    target = None if output_dir is None else check_path("output_dir", output_dir)
    if timestamp is not None:
        run_directory(Path(), "run", timestamp)  # raise for a bad name before the scene loads
    for name, value, kind in (
        ("source", source, SourceOptions),
        ("lift", lift, LiftOptions),
        ("export", export, Export),
    ):
        if value is not None and not isinstance(value, kind):
            raise InputError(f"{name} must be {kind.__name__}, got {type(value).__name__}")
    device, options = choose_device(device), (source or SourceOptions()).looking_for(queries)
    wake(device)
    feature_source = None if features is not None else make_source(options, device)  # raises before the scene loads
    if feature_source is not None and len(queries) > 0:
        feature_source.text(queries)
    scene = opened()
    if not isinstance(scene, NerfstudioScene | SplatScene):
        raise TypeError(
            "lift_run takes the config.yml of a run, or a scene from open_scene or open_splat; got "
            f"{type(scene).__name__}"
        )
    run_dir = run_directory(target or scene.runs_dir, scene.name, timestamp)
    run_dir = run_dir.with_name(team.tell(run_dir.name))  # clocks differ
    if team.rank == 0:
        tidy(run_dir)
    if timestamp is not None and team.rank == 0:
        refuse_existing_run(run_dir, overwrite)
    lift, stages = lift or LiftOptions(), Stages(report)
    used = "" if lift.max_views is None else f"{min(lift.max_views, len(scene.train))} of "
    say(f"{len(scene.gaussians):,} Gaussians, {used}{len(scene.train)} training views, on {device}")
    for remark in scene.remarks:
        say(f"Warning: {remark}")
    if export is not None:
        _refuse_equal_stems(scene.train.names)
    settings = encoder_settings(options)
    if feature_source is None:
        feature_source = given_features(features, texts, scene.train.names)
        texts = feature_source.texts
        settings = given_settings(TEXTS_FILE if texts else None)
        if len(queries) > 0:
            feature_source.text(queries)
    if check and team.rank == 0:
        with stages("check") as step:
            match = match_photographs(scene, RasterSettings.of_gsplat(drawn_by(scene, lift)), device=device)
            warning = judge(match, own_cameras=not isinstance(scene, SplatScene))
            step()
        if warning is not None:
            say(f"Warning: {warning}")
    cache = cache_folder(run_dir)
    with team.shares(cache):
        result = lift_together(
            team, scene, feature_source, lift, cache, device=device, encoder=settings, export=export, report=report
        )
    if result is None:
        return None
    field, seconds = result
    if features is None:
        field = replace(field, manifest={**field.manifest, "source": source_settings(options, device)})
    seconds = {**stages.seconds, **seconds}
    with stages("write") as step:
        question = _question(field, scene.gaussians.means, feature_source, queries)
        run_dir = write_run(
            scene, field, run_dir, question=question, texts=texts, overwrite=overwrite, exact=timestamp is not None
        )
        field = field.to("cpu")
        step()
    seconds["write"] = stages.seconds["write"]
    return LiftedRun(run_dir, scene, with_paths(field, run_dir / FIELD_FOLDER), device, seconds)


def _refuse_equal_stems(names: Sequence[str]) -> None:
    """Raise if two images have the same stem, because LangSplat's format names files by it."""
    stems = [Path(name).stem for name in names]
    for i, stem in enumerate(stems):
        if stem in stems[:i]:
            raise InputError(
                f"{names[stems.index(stem)]} and {names[i]} would share the files {stem}_*.npy of LangSplat's format. "
                "Rename one of the images, or lift without --export-langsplat."
            )


def _question(
    field: SemanticField, means: Float[Tensor, "n 3"], source: FeatureSource, queries: Sequence[str]
) -> Question | None:
    if len(queries) == 0:
        return None
    length = source.text(queries).shape[1]
    if length != field.dimension:
        raise InputError(
            f"the vectors of --queries have {length} numbers, but the features have {field.dimension}; name the model "
            "of the features with --encoder-model and --encoder-pretrained, or give --text-vectors"
        )
    negatives = None
    if isinstance(source, GivenFeatures):  # the file with its prompts is not written yet
        negatives = CANONICAL_NEGATIVES if set(CANONICAL_NEGATIVES) <= set(source.texts) else ()
    return answer(field, means, make_question(field, source.text, queries, negatives=negatives)).question
