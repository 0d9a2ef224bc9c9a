"""The front door: opening a trained scene or a lifted run, and lifting."""

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

from normlift_ns.core.field import SemanticField
from normlift_ns.core.files import clean
from normlift_ns.core.gpu import choose_device
from normlift_ns.core.portions import ALONE
from normlift_ns.core.scene import Scene, camera_summary, cameras_differ
from normlift_ns.errors import InputError
from normlift_ns.lifted_run import LiftedRun
from normlift_ns.options import LiftOptions, SourceOptions
from normlift_ns.ranges import check_number, check_path
from normlift_ns.runs.files import (
    check_run,
    load_field,
    recorded_rules,
)
from normlift_ns.scenes.added import with_saved
from normlift_ns.scenes.nerfstudio.load import CheckedViews, load_scene
from normlift_ns.scenes.saved import is_saved_splat, open_saved_splat
from normlift_ns.stages import Report
from normlift_ns.team.seen import Export
from normlift_ns.text_encoders import with_texts
from normlift_ns.together import lift_run_together


def open_scene(load_config: str | Path, *, data: str | Path | None = None, load_step: int | None = None) -> Scene:
    """A trained splatfacto run or a lifted one, from any working directory. A splat without a run: see `open_splat`.

    Args:
        load_config: config.yml of the run.
        data: where the dataset is now, if it was moved.
        load_step: step of the checkpoint; None: the last.
    Raises:
        FileNotFoundError: config, checkpoint, dataset or an image is missing.
        ValueError: a config of another method or program, a damaged checkpoint, another dataset than the run's.

    >>> scene = open_scene(config)
    >>> len(scene.train), scene.train[1].image.shape
    (12, torch.Size([120, 160, 3]))
    """
    config, place = check_path("load_config", load_config), None if data is None else check_path("data", data)
    load_step = None if load_step is None else check_number("load_step", load_step, int)
    run_dir = Path(os.path.abspath(config)).parent
    if not run_dir.exists():
        clean(run_dir.parent)  # a lift that was killed while it replaced the run
    if config.is_file() and is_saved_splat(run_dir):
        scene = open_saved_splat(run_dir, data=place, load_step=load_step)
    else:
        scene = load_scene(config, data=place, load_step=load_step, by_nerfstudio=_by_nerfstudio)
        scene = with_saved(scene, run_dir)
    rules = recorded_rules(run_dir)
    return scene if rules is None else replace(scene, identity={**scene.identity, "gsplat_rules": rules})


def _by_nerfstudio(*run: Any) -> tuple[CheckedViews, CheckedViews]:
    from normlift_ns.nerfstudio_plugin.views import by_nerfstudio  # noqa: PLC0415 (nerfstudio takes 13 s)

    return by_nerfstudio(*run)


def open_run(
    load_config: str | Path,
    *,
    data: str | Path | None = None,
    device: str = "auto",
    text_vectors: str | Path | None = None,
    text_template: str | None = None,
) -> LiftedRun:
    """Opens a lifted run, from any working directory.

    Args:
        load_config: config.yml of the run.
        data: where the dataset is now, if it was moved.
        device: where the text encoder works: auto, cpu or cuda.
        text_vectors: NPZ file, text -> vector, to look texts up in instead of the encoder that the run was lifted with.
        text_template: what open_clip reads for a text, which takes the place of {}; None: as the run was lifted.
    Raises:
        FileNotFoundError, ValueError: as `open_scene`; a run without semantics, or with those of other Gaussians.

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
    changed = cameras_changed(loaded, scene)
    for remark in (*scene.remarks, *([] if changed is None else [changed])):
        warnings.warn(remark, stacklevel=2)
    return LiftedRun(folder, scene, with_texts(loaded, vectors=vectors, template=text_template), device)


def cameras_changed(field: SemanticField, scene: Scene) -> str | None:
    """A warning where the cameras are not those of the lift; None also for fields that do not know them."""
    changed = [
        what
        for what, key, views in (("training", "cameras", scene.train), ("held-out", "cameras_held_out", scene.held_out))
        if (known := field.manifest.get(key)) is not None and cameras_differ(known, camera_summary(views.cameras))
    ]
    if len(changed) == 0:
        return None
    return (
        f"the {' and '.join(changed)} cameras of {scene.name} are not those that the run was lifted with: the data set "
        "has changed since. Answers are those of the lift, but pictures and evaluations use the new cameras; restore "
        "the data set, say where it is with --data, or lift again"
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
    export: Export | None = None,
    report: Report = lambda stage, done, total: None,
    say: Callable[[str], None] = lambda text: None,
) -> LiftedRun:
    """Lifts 2D features onto the Gaussians of a trained run, and writes a lifted run beside it.

    The new run is outputs/<experiment>/normlift/<timestamp>, which ns-viewer, ns-render and the ns-normlift commands
    open.

    Args:
        config_or_scene: config.yml of the trained run, or a scene of `open_scene` or `open_splat`.
        source: which 2D features to make of the photographs; None: as ns-normlift does by default.
        features: features of your own in place of `source`: per training image a label map [H, W] of the undistorted
            image, at the size that `lift_downscale` leaves, with regions 0..R-1 and -1 for none, and vectors [R, D].
            One pair per image, or a dictionary by names of images, which may leave some out.
        texts: with `features`: what the run can be asked, with vectors [D]; they are stored in the run.
        lift: how to lift.
        queries: texts to store in the run; ns-render and ns-viewer show their relevancy.
        data: as in `open_scene`, for a config.
        load_step: likewise.
        output_dir: in place of the run's own outputs folder.
        timestamp: name of the new run directory; None: the present time, with a number where a run has that name.
        overwrite: replace a run directory of that name, and exported files of other content.
        check: compare three training views with renders of the scene first; warn where they differ, and refuse splats
            that do not show what their photographs show.
        device: auto, cpu or cuda.
        export: where to write the 2D features too, in LangSplat's format.
        report: called with (stage, steps done, steps in all).
        say: called with a sentence once the scene is loaded, for example `print`.
    Raises:
        FileExistsError: the run directory exists and `overwrite` is False.
        FileNotFoundError, ValueError: as `open_scene`; an image, a label map or an option that does not fit.
        MemoryError: the GPU's memory does not hold the lift.
        TypeError: neither a config nor a scene of `open_scene` or `open_splat`.

    >>> scene = open_scene(config)
    >>> import torch
    >>> left = [(torch.arange(160).expand(120, 160) // 80, torch.eye(2)) for _ in scene.train.names]
    >>> run = lift_run(scene, features=left, texts={"left": torch.tensor([1.0, 0.0])}, output_dir=folder)
    >>> 0.2 < run.ask("left")["left"].fraction < 0.8
    True
    """
    if not isinstance(config_or_scene, str | Path) and (data is not None or load_step is not None):
        raise InputError("data and load_step are for a config; give them to open_scene")
    run = lift_run_together(
        ALONE, opener(config_or_scene, data, load_step), source=source, features=features, texts=texts, lift=lift,
        queries=queries, output_dir=output_dir, timestamp=timestamp, overwrite=overwrite, check=check, device=device,
        export=export, report=report, say=say,
    )  # fmt: skip
    assert run is not None
    return run


def opener(
    config_or_scene: str | Path | Scene, data: str | Path | None = None, load_step: int | None = None
) -> Callable[[], Scene]:
    """What opens a scene when it is needed."""
    if not isinstance(config_or_scene, str | Path):
        return lambda: config_or_scene
    return partial(open_scene, config_or_scene, data=data, load_step=load_step)
