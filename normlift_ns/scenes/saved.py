"""Splat and cameras stored in a lifted run, which open it again without the original files."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import msgspec
import torch

from normlift_ns.core.files import write_text
from normlift_ns.errors import InputError
from normlift_ns.options import Background, RasterizeMode
from normlift_ns.scenes.checkpoint import GAUSSIAN_PARAMETERS, find_checkpoint, read_checkpoint
from normlift_ns.scenes.frames import check_frames
from normlift_ns.scenes.opening import BACKGROUNDS, SplatScene
from normlift_ns.scenes.photographs import PhotographViews
from normlift_ns.scenes.splat import from_parameters
from normlift_ns.scenes.transforms import read_transforms, write_transforms
from normlift_ns.scenes.transforms_file import read_json

SCENE_FILE, TRANSFORMS_FILE, CHECKPOINT_FOLDER = "splat.json", "transforms.json", "nerfstudio_models"
_EXPECTED = "the file that ns-normlift wrote next to config.yml; copy the whole run again"


class _Saved(msgspec.Struct):
    name: str
    rasterize_mode: RasterizeMode
    background: Background
    photographs: str
    identity: dict[str, Any]


def save_splat(folder: Path, scene: SplatScene) -> None:
    """Write splat.json and the cameras, transforms.json, into the folder of a run."""
    write_transforms(folder / TRANSFORMS_FILE, scene.train.frames, scene.held_out.frames)
    saved = _Saved(
        scene.name, scene.rasterize_mode, scene.background_name, str(scene.photographs), dict(scene.identity)
    )
    write_text(folder / SCENE_FILE, json.dumps(msgspec.to_builtins(saved), indent=2) + "\n")


def checkpoint_of(scene: SplatScene) -> dict[str, Any]:
    """Return the checkpoint that splatfacto loads: step and parameters.

    Without spherical harmonics, splatfacto would read the colors as logits, so the first degree is added as zeros.
    """
    parameters = scene.parameters
    if scene.splat.degree == 0:
        parameters["features_rest"] = torch.zeros(len(scene.splat), 3, 3)
    return {
        "step": scene.step,
        "pipeline": {f"_model.gauss_params.{name}": parameters[name] for name in GAUSSIAN_PARAMETERS},
    }


def is_saved_splat(run_dir: Path) -> bool:
    """Return whether the run was lifted from a splat without a nerfstudio run."""
    return (run_dir / SCENE_FILE).is_file()


def open_saved_splat(run_dir: Path, *, data: Path | None = None, load_step: int | None = None) -> SplatScene:
    """Open the splat of a lifted run.

    Args:
        run_dir: folder of the lifted run.
        data: current folder of the images, if they were moved.
        load_step: step of the checkpoint; None: the last.
    Raises:
        FileNotFoundError, ValueError: if a file is missing or damaged; the message names it.
    """
    path = run_dir / SCENE_FILE
    try:
        saved = msgspec.convert(read_json(path, _EXPECTED), _Saved)
        if any(text.strip() == "" or "\0" in text for text in (saved.name, saved.photographs)):
            raise msgspec.ValidationError("name or photographs is empty")
    except msgspec.ValidationError as error:
        raise InputError(f"{path} does not match the schema: {error}. Expected {_EXPECTED}.") from error
    checkpoint = read_checkpoint(find_checkpoint(run_dir / CHECKPOINT_FOLDER, load_step))
    parameters = {name: checkpoint.model[f"gauss_params.{name}"] for name in GAUSSIAN_PARAMETERS}
    if data is not None and not data.is_dir():
        raise FileNotFoundError(
            f"There is no folder {data}, given with --data. Expected the new location of {saved.photographs}."
        )
    cameras = read_transforms(
        run_dir / TRANSFORMS_FILE,
        None if data is None else data.absolute(),
        base=Path(saved.photographs),
        advice="give their folder with --data",
    )
    check_frames(cameras.frames, run_dir / TRANSFORMS_FILE)
    background = BACKGROUNDS[saved.background]
    train, held_out = (
        PhotographViews(
            [frame for frame in cameras.frames if (frame.name in cameras.held_out) == is_held_out], background
        )
        for is_held_out in (False, True)
    )
    return SplatScene(
        from_parameters(parameters, checkpoint.path),
        train,
        held_out,
        saved.name,
        checkpoint.path,
        checkpoint.step,
        run_dir.parents[2] if len(run_dir.parents) > 2 else run_dir.parent,
        Path(saved.photographs) if data is None else data.absolute(),
        saved.identity,
        saved.rasterize_mode,
        saved.background,
        train.check_files(),
    )
