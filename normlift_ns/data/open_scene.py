"""Functions that open splatfacto runs and lifted runs, including a splat or extra images stored in a lifted run."""

from __future__ import annotations

import json
import os
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import msgspec
import torch
from jaxtyping import Float
from torch import Tensor

from normlift_ns.core.arguments import check_arguments
from normlift_ns.core.field import SemanticField
from normlift_ns.core.gaussians import Camera, GaussianScene
from normlift_ns.core.scene import Scene, View, Views, camera_summary, cameras_differ
from normlift_ns.data.checkpoint import find_checkpoint, read_checkpoint
from normlift_ns.data.frames import Frame, check_frames, check_lens_types
from normlift_ns.data.images import ImageViews
from normlift_ns.data.nerfstudio.load import NerfstudioScene, load_nerfstudio_scene
from normlift_ns.data.splat import SplatParameters
from normlift_ns.data.transforms import read_json_file, read_transforms, write_transforms
from normlift_ns.errors import InputError
from normlift_ns.io.atomic import complete_interrupted_writes, write_text_file
from normlift_ns.io.run_dir import check_run, field_folder, recorded_gsplat_version, resolve_manifest_paths
from normlift_ns.options import Background, RasterizeMode, check_number, check_path
from normlift_ns.rasterization.rasterize import view_colors

if TYPE_CHECKING:
    from normlift_ns.data.alignment import Alignment

BACKGROUND_COLORS: dict[Background, Tensor] = {"black": torch.zeros(3), "white": torch.ones(3)}


@dataclass(frozen=True)
class SplatScene:
    """Scene made from a splat and its images, without a nerfstudio run."""

    splat: SplatParameters
    train: ImageViews
    held_out: ImageViews
    name: str
    checkpoint_path: Path
    """Path of the splat file or gsplat checkpoint that was given, or of the checkpoint of a lifted run."""
    step: int
    """Training step; 0 if unknown."""
    runs_dir: Path
    names_root: Path
    """Base folder of the relative image names."""
    identity: Mapping[str, Any]
    rasterize_mode: RasterizeMode
    background_name: Background
    remarks: tuple[str, ...] = ()
    """Warnings about the images, in whole sentences."""
    alignment: Alignment | None = None
    """Agreement between the images and renders by the rules of gsplat 1.4; None unless the search for the world found
    a world that fits."""

    renderer = None
    """Renderer of another package; None, because `normlift_ns` renders this scene."""
    has_harmonics = True

    @property
    def gaussians(self) -> GaussianScene:
        """All Gaussians, with activated scales and opacities."""
        return self._gaussians

    @cached_property
    def _gaussians(self) -> GaussianScene:
        primitive = self.identity.get("primitive", "3dgs")
        return self.splat.activated if primitive == "3dgs" else replace(self.splat.activated, primitive=primitive)

    @property
    def parameters(self) -> dict[str, Tensor]:
        """Raw parameters of the Gaussians, by splatfacto's names."""
        return self.splat.parameters

    @property
    def background(self) -> Float[Tensor, " 3"]:
        """Background color, RGB in 0..1."""
        return BACKGROUND_COLORS[self.background_name]

    def colors(self, camera: Camera) -> Float[Tensor, "n 3"]:
        """Return the RGB color of each Gaussian as seen from a camera, with values >= 0."""
        coefficients = torch.cat([self.splat.features_dc[:, None], self.splat.features_rest], dim=1)
        return view_colors(self.splat.means, coefficients, camera, self.splat.degree)


def split_views(
    frames: Sequence[Frame], held_out: frozenset[str], background: Background
) -> tuple[ImageViews, ImageViews]:
    """Return the views of the training images and of the held-out images.

    Args:
        frames: Frames of all images.
        held_out: Names of the held-out images.
        background: Color behind images with an alpha channel.
    """
    train, rest = (
        ImageViews([frame for frame in frames if (frame.name in held_out) == is_rest], BACKGROUND_COLORS[background])
        for is_rest in (False, True)
    )
    return train, rest


# Splat and cameras stored in a lifted run, so that it can be opened without the original files.


SPLAT_FILE, TRANSFORMS_FILE, CHECKPOINT_DIR = "splat.json", "transforms.json", "nerfstudio_models"
_EXPECTED = "the file that ns-normlift wrote next to config.yml; copy the whole run again"


class _Saved(msgspec.Struct):
    name: str
    rasterize_mode: RasterizeMode
    background: Background
    photographs: str
    identity: dict[str, Any]


def save_splat(folder: Path, scene: SplatScene) -> None:
    """Write the settings of a splat to splat.json, and its cameras to transforms.json, in the folder of a run."""
    write_transforms(folder / TRANSFORMS_FILE, scene.train.frames, scene.held_out.frames)
    saved = _Saved(scene.name, scene.rasterize_mode, scene.background_name, str(scene.names_root), dict(scene.identity))
    write_text_file(folder / SPLAT_FILE, json.dumps(msgspec.to_builtins(saved), indent=2) + "\n")


def splatfacto_checkpoint(scene: SplatScene) -> dict[str, Any]:
    """Return the content of a checkpoint that splatfacto can load: step and parameters.

    If there is only the constant spherical harmonic, the function adds zeros as harmonics of degree 1, because
    splatfacto would otherwise read colors as logits.
    """
    parameters = scene.parameters
    if scene.splat.degree == 0:
        parameters["features_rest"] = torch.zeros(len(scene.splat), 3, 3)
    return {
        "step": scene.step,
        "pipeline": {f"_model.gauss_params.{name}": tensor for name, tensor in parameters.items()},
    }


def open_saved_splat(run_dir: Path, *, data: Path | None = None, load_step: int | None = None) -> SplatScene:
    """Open the splat and the images of a lifted run.

    Args:
        run_dir: Folder of the lifted run.
        data: Current folder of the images, if they were moved.
        load_step: Step of the checkpoint; None for the last step.
    Raises:
        FileNotFoundError, ValueError: A file is missing or damaged. The message gives its path.
    """
    path = run_dir / SPLAT_FILE
    try:
        saved = msgspec.convert(read_json_file(path, _EXPECTED), _Saved)
        if any(text.strip() == "" or "\0" in text for text in (saved.name, saved.photographs)):
            raise msgspec.ValidationError("name or photographs is empty or contains a null character")
    except msgspec.ValidationError as error:
        raise InputError(f"{path} does not match the schema: {error}. Expected {_EXPECTED}.") from error
    checkpoint = read_checkpoint(find_checkpoint(run_dir / CHECKPOINT_DIR, load_step))
    if data is not None and not data.is_dir():
        problem = "is not a folder" if data.exists() else "does not exist"
        raise FileNotFoundError(f"{data}, given with --data, {problem}. Give the new path of {saved.photographs}.")
    cameras = read_transforms(
        run_dir / TRANSFORMS_FILE,
        None if data is None else data.absolute(),
        base=Path(saved.photographs),
        advice="give their folder with --data" if data is None else "lift the splat again without them",
    )
    check_frames(cameras.frames, run_dir / TRANSFORMS_FILE)
    train, held_out = split_views(cameras.frames, cameras.held_out, saved.background)
    return SplatScene(
        checkpoint.splat,
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


# Images that a lift added to a nerfstudio run.


EXTRA_IMAGES_FILE = "added_photographs.json"
"""Name of the file in a lifted nerfstudio run that contains the cameras of extra images, in the Gaussians' world."""
AnyScene = TypeVar("AnyScene", NerfstudioScene, SplatScene)


class _ConcatenatedViews:
    """Concatenation of two `Views`."""

    def __init__(self, first: Views, second: Views) -> None:
        self._first, self._second = first, second
        self.names = [*first.names, *second.names]
        self.cameras = [*first.cameras, *second.cameras]

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, index: int, /) -> View:
        if not -len(self) <= index < len(self):
            raise IndexError(f"view {index} does not exist; the number of views is {len(self)}")
        index %= len(self)
        first = self._first
        return first[index] if index < len(first) else self._second[index - len(first)]


def with_frames(scene: AnyScene, frames: Sequence[Frame]) -> AnyScene:
    """Return the scene with additional training views. Their cameras must be in the world of the scene.

    Raises:
        FileNotFoundError, ValueError: An image is missing or cannot be read, or a `SplatScene` would have both fisheye
            and perspective cameras.
    """
    views = ImageViews(frames, scene.background)
    remarks = (*scene.remarks, *views.check_files())
    if isinstance(scene, SplatScene):
        check_lens_types([*scene.train.frames, *frames], scene.checkpoint_path)
        train = sorted([*scene.train.frames, *frames], key=lambda frame: frame.file)
        return replace(scene, train=ImageViews(train, scene.background), remarks=remarks, alignment=None)
    return replace(scene, train=_ConcatenatedViews(scene.train, views), remarks=remarks, extra_frames=tuple(frames))


def add_stored_images(scene: NerfstudioScene, run_dir: Path) -> NerfstudioScene:
    """Return the scene with the extra images that a lifted run stores, if any.

    Raises:
        FileNotFoundError, ValueError: A file is missing or damaged. The message gives its path.
    """
    path = run_dir / EXTRA_IMAGES_FILE
    if not path.is_file():
        return scene
    added = read_transforms(path, base=scene.location.folder, advice="lift the original run again without --add-images")
    check_frames(added.frames, path)
    return with_frames(scene, added.frames)


# Scenes and lifted runs.


@check_arguments
def open_scene(load_config: str | Path, *, data: str | Path | None = None, load_step: int | None = None) -> Scene:
    """Open a trained splatfacto run or a lifted run, from any working directory.

    For a splat without a nerfstudio run, see `open_splat`.

    Args:
        load_config: Path of the config.yml of the run.
        data: Current path of the dataset, if it was moved.
        load_step: Step of the checkpoint; None for the last step.
    Raises:
        FileNotFoundError: The config, the checkpoint, the dataset or an image is missing.
        ValueError: The config is from another method or program, the checkpoint is damaged, or the dataset is not the
            dataset of the run.

    >>> scene = open_scene(config)
    >>> len(scene.train), scene.train[1].image.shape
    (12, torch.Size([120, 160, 3]))
    """
    config = check_path("load_config", load_config)
    data = None if data is None else check_path("data", data)
    load_step = None if load_step is None else check_number("load_step", load_step, int)
    run_dir = Path(os.path.abspath(config)).parent
    if not run_dir.exists():
        complete_interrupted_writes(run_dir.parent)  # an interrupted lift may have been replacing the run
    if config.is_file() and (run_dir / SPLAT_FILE).is_file():  # lifted from a splat without a nerfstudio run
        scene = open_saved_splat(run_dir, data=data, load_step=load_step)
    else:
        scene = load_nerfstudio_scene(config, data=data, load_step=load_step)
        scene = add_stored_images(scene, run_dir)
    rules = recorded_gsplat_version(run_dir)
    return scene if rules is None else replace(scene, identity={**scene.identity, "gsplat_rules": rules})


def load_field(
    run_dir: Path, means: Float[Tensor, "n 3"] | None = None, *, checkpoint: str | Path = "the checkpoint"
) -> SemanticField:
    """Load the semantic field of a lifted run.

    Args:
        run_dir: Run directory.
        means: Positions of the Gaussians, to check that the field belongs to them; None for no check.
        checkpoint: Name of the source of `means`, for error messages.
    Raises:
        FileNotFoundError: The run has no semantic field.
        ValueError: The field is damaged, or belongs to other Gaussians than `means`.
    """
    folder = field_folder(run_dir)
    return resolve_field_paths(SemanticField.load(folder, means, checkpoint=checkpoint), folder)


def resolve_field_paths(field: SemanticField, folder: Path) -> SemanticField:
    """Return the field with absolute paths in its manifest; see `resolve_manifest_paths`."""
    return replace(field, manifest=resolve_manifest_paths(field.manifest, folder))


class StoredRun(NamedTuple):
    """Lifted run on disk, with its open scene and field."""

    folder: Path
    """Run directory, which contains config.yml."""
    scene: Scene
    field: SemanticField


def open_stored_run(load_config: str | Path, data: str | Path | None = None) -> StoredRun:
    """Open the scene and the field of a lifted run, and issue warnings about the scene and about changed cameras.

    Args:
        load_config: Path of the config.yml of the run.
        data: Current path of the dataset, if it was moved.
    Raises:
        FileNotFoundError, ValueError: As in `open_scene` and `check_run`; also if the run has no semantic field, or
            the field belongs to other Gaussians.
    """
    folder = Path(os.path.abspath(check_path("load_config", load_config))).parent
    check_run(folder)
    scene = open_scene(load_config, data=data)
    field = load_field(folder, scene.gaussians.means, checkpoint=scene.checkpoint_path)
    for remark in (*scene.remarks, *_changed_cameras(field, scene)):
        warnings.warn(remark, stacklevel=3)
    return StoredRun(folder, scene, field)


def _changed_cameras(field: SemanticField, scene: Scene) -> list[str]:
    """Return a list with a warning if the cameras differ from the cameras of the lift, or an empty list."""
    changed = [
        split
        for split, key, views in (
            ("training", "cameras", scene.train),
            ("held-out", "cameras_held_out", scene.held_out),
        )
        if (recorded := field.manifest.get(key)) is not None and cameras_differ(recorded, camera_summary(views.cameras))
    ]
    if len(changed) == 0:
        return []
    return [
        f"The {' and '.join(changed)} cameras of {scene.name} have changed since the lift. Query results still use the "
        "old cameras, but renders and evaluations use the new ones. Restore the cameras of the lift, or lift again."
    ]
