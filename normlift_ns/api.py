"""Python API: open a trained scene or a lifted run, and lift features."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from jaxtyping import Float
from torch import Tensor

from normlift_ns.core.device import choose_device
from normlift_ns.core.field import SemanticField
from normlift_ns.core.scene import Scene, camera_summary, cameras_differ
from normlift_ns.data.extra_images import add_stored_images
from normlift_ns.data.images import SplitViews
from normlift_ns.data.nerfstudio.load import load_nerfstudio_scene
from normlift_ns.data.open_splat import is_saved_splat, open_saved_splat
from normlift_ns.errors import InputError
from normlift_ns.evidence_collection import FeatureExport
from normlift_ns.io.atomic import complete_interrupted_writes
from normlift_ns.io.run_dir import check_run, recorded_gsplat_version
from normlift_ns.lifted_run import LiftedRun, load_field
from normlift_ns.options import LiftOptions, SourceOptions, check_number, check_path
from normlift_ns.pipeline import LiftRequest, RunTarget, run_lift
from normlift_ns.progress import ProgressCallback
from normlift_ns.query.text_encoder import with_text_source


def open_scene(load_config: str | Path, *, data: str | Path | None = None, load_step: int | None = None) -> Scene:
    """Open a trained splatfacto run or a lifted run, from any working directory.

    For a splat without a nerfstudio run, see `open_splat`.

    Args:
        load_config: config.yml of the run.
        data: current path of the dataset, if it was moved.
        load_step: step of the checkpoint, the last one if None.
    Raises:
        FileNotFoundError: the config, the checkpoint, the dataset or an image is missing.
        ValueError: the config is from another method or program, the checkpoint is damaged, or the dataset is not that
            of the run.

    >>> scene = open_scene(config)
    >>> len(scene.train), scene.train[1].image.shape
    (12, torch.Size([120, 160, 3]))
    """
    config = check_path("load_config", load_config)
    data = None if data is None else check_path("data", data)
    load_step = None if load_step is None else check_number("load_step", load_step, int)
    run_dir = Path(os.path.abspath(config)).parent
    if not run_dir.exists():
        complete_interrupted_writes(run_dir.parent)  # a lift was killed while it replaced the run
    if config.is_file() and is_saved_splat(run_dir):
        scene = open_saved_splat(run_dir, data=data, load_step=load_step)
    else:
        scene = load_nerfstudio_scene(config, data=data, load_step=load_step, make_nerfstudio_views=_by_nerfstudio)
        scene = add_stored_images(scene, run_dir)
    rules = recorded_gsplat_version(run_dir)
    return scene if rules is None else replace(scene, identity={**scene.identity, "gsplat_rules": rules})


def _by_nerfstudio(*run: Any) -> tuple[SplitViews, SplitViews]:
    from normlift_ns.nerfstudio_plugin.views import nerfstudio_views  # noqa: PLC0415 (nerfstudio takes 13 s)

    return nerfstudio_views(*run)


def open_run(
    load_config: str | Path,
    *,
    data: str | Path | None = None,
    device: str = "auto",
    text_vectors: str | Path | None = None,
    text_template: str | None = None,
) -> LiftedRun:
    """Open a lifted run, from any working directory.

    Args:
        load_config: config.yml of the run.
        data: current path of the dataset, if it was moved.
        device: device of the text encoder (auto, cpu or cuda).
        text_vectors: NPZ file with a vector for each prompt, which replaces the text encoder of the lift.
        text_template: template such as "a photo of {}" that open_clip applies to prompts. If None, use that of the
            lift.
    Raises:
        FileNotFoundError, ValueError: as `open_scene`; also if the run has no semantics, or those of other Gaussians.

    >>> run = open_run(config)
    >>> answer = run.ask("red", "yellow", min_reliability=0.3)
    >>> answer["yellow"].objects[0].size > 20
    True
    """
    folder = Path(os.path.abspath(check_path("load_config", load_config))).parent
    vectors = None if text_vectors is None else check_path("text_vectors", text_vectors)
    check_run(folder)
    device, scene = choose_device(device), open_scene(load_config, data=data)
    loaded = load_field(folder, scene.gaussians.means, checkpoint=scene.checkpoint_path)
    changed = changed_cameras_warning(loaded, scene)
    for remark in (*scene.remarks, *([] if changed is None else [changed])):
        warnings.warn(remark, stacklevel=2)
    return LiftedRun(folder, scene, with_text_source(loaded, text_embeddings=vectors, template=text_template), device)


def changed_cameras_warning(field: SemanticField, scene: Scene) -> str | None:
    """Return a warning if the cameras differ from those of the lift.

    Return None if they do not, or if the field does not record its cameras.
    """
    changed = [
        split
        for split, key, views in (
            ("training", "cameras", scene.train),
            ("held-out", "cameras_held_out", scene.held_out),
        )
        if (recorded := field.manifest.get(key)) is not None and cameras_differ(recorded, camera_summary(views.cameras))
    ]
    if len(changed) == 0:
        return None
    return (
        f"the {' and '.join(changed)} cameras of {scene.name} are not those that the run was lifted with: the dataset "
        "has changed since. Query results are those of the lift, but renders and evaluations use the new cameras. "
        "Restore the dataset, give its path with --data, or lift again"
    )


def lift_run(
    config_or_scene: str | Path | Scene,
    *,
    source: SourceOptions | None = None,
    features: Sequence[tuple[Any, Any]] | Mapping[str, tuple[Any, Any]] | None = None,
    texts: Mapping[str, Float[Tensor, " d"]] | None = None,
    lift: LiftOptions | None = None,
    queries: Sequence[str] = (),
    data: str | Path | None = None,
    load_step: int | None = None,
    output_dir: str | Path | None = None,
    timestamp: str | None = None,
    overwrite: bool = False,
    check: bool = True,
    device: str = "auto",
    export: FeatureExport | None = None,
    report: ProgressCallback = lambda stage, done, total: None,
    say: Callable[[str], None] = lambda text: None,
) -> LiftedRun:
    """Lift 2D features onto the Gaussians of a trained run, and write a lifted run next to it.

    The new run is outputs/<experiment>/normlift/<timestamp>. ns-viewer, ns-render and the ns-normlift commands open it.

    Args:
        config_or_scene: config.yml of the trained run, or a scene from `open_scene` or `open_splat`.
        source: which 2D features to compute from the images. If None, use the defaults of ns-normlift.
        features: your own features, instead of `source`. A training image has a label map [H, W] and vectors [R, D].
            The label map has the size of the undistorted image after `lift_downscale`. Its values are regions 0..R-1,
            or -1 for no region. Pass one pair per image, or a dictionary by image name, which may omit images.
        texts: prompts of your own features, with their vectors [D]. The run stores them and can be queried with them.
        lift: options of the lift.
        queries: prompts to store in the run; ns-render and ns-viewer show their relevancy.
        data: as in `open_scene`, for a config only.
        load_step: as in `open_scene`, for a config only.
        output_dir: output folder, instead of the outputs folder of the trained run.
        timestamp: name of the new run directory. If None, use the current time, with a number if such a run exists.
        overwrite: replace a run directory of that name, and exported files with other content.
        check: compare three training images with renders of the scene first. Warn if they differ; raise if the splat
            does not show what the images show.
        device: auto, cpu or cuda.
        export: where to also write the 2D features, in LangSplat's format.
        report: called with (stage, steps done, total steps).
        say: called with each status line and warning, for example `print`.
    Raises:
        FileExistsError: the run directory exists and `overwrite` is False.
        FileNotFoundError, ValueError: as `open_scene`; also if an image, a label map or an option does not fit.
        MemoryError: the lift does not fit into GPU memory.
        TypeError: `config_or_scene` is neither a config nor a scene from `open_scene` or `open_splat`.

    >>> scene = open_scene(config)
    >>> import torch
    >>> left = [(torch.arange(160).expand(120, 160) // 80, torch.eye(2)) for _ in scene.train.names]
    >>> run = lift_run(scene, features=left, texts={"left": torch.tensor([1.0, 0.0])}, output_dir=folder)
    >>> 0.2 < run.ask("left")["left"].fraction < 0.8
    True
    """
    if not isinstance(config_or_scene, str | Path) and (data is not None or load_step is not None):
        raise InputError("data and load_step apply to a config only; pass them to open_scene")
    request = LiftRequest(
        open_scene=scene_opener(config_or_scene, data, load_step), source=source, features=features, texts=texts,
        lift=lift, queries=queries, target=RunTarget(output_dir, timestamp, overwrite), check=check, device=device,
        export=export, report=report, say=say,
    )  # fmt: skip
    return run_lift(request)


def scene_opener(
    config_or_scene: str | Path | Scene, data: str | Path | None = None, load_step: int | None = None
) -> Callable[[], Scene]:
    """Return a function that opens the scene when called."""
    if not isinstance(config_or_scene, str | Path):
        return lambda: config_or_scene
    return partial(open_scene, config_or_scene, data=data, load_step=load_step)
