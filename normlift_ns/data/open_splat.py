"""Opening of splats without a nerfstudio run."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from types import FunctionType

import numpy as np
from jaxtyping import Float
from torch import Tensor

from normlift_ns.data.alignment import MIN_PSNR, mean_psnr
from normlift_ns.data.colmap import read_colmap, read_colmap_points
from normlift_ns.data.frames import Frame, WorldTransform, check_frames, rescale_intrinsics, transform_frames
from normlift_ns.data.images import held_out_names
from normlift_ns.data.open_scene import SplatScene, split_views
from normlift_ns.data.splat import SplatFile, validate_splat
from normlift_ns.data.transforms import (
    CameraFile,
    gsplat_normalization,
    read_transforms,
    read_world_transform,
)
from normlift_ns.errors import InputError, summarize_error
from normlift_ns.options import SplatOptions
from normlift_ns.registry import Registry

_MIN_POINTS, _PARALLEL = 4, 1e-6


def read_camera_file(options: SplatOptions, advice: str = "give the folder of the images with --images") -> CameraFile:
    """Read the camera file that the options name, and check that its images exist.

    Args:
        options: locations of cameras, images and masks.
        advice: what to do about missing images, for error messages.
    Raises:
        FileNotFoundError: if a file, folder, image or mask is missing.
        ValueError: if the options name no camera file or two, or the file cannot be read.
    """
    count = (options.colmap is not None) + (options.transforms is not None)
    if count != 1:
        raise InputError(
            f"A splat needs one camera file, got {'two' if count else 'none'}: give the folder of a COLMAP project "
            "with --colmap, or a transforms.json with --transforms."
        )
    for name, folder in (("--images", options.images), ("--masks", options.masks)):
        if folder is not None and not folder.is_dir():
            raise FileNotFoundError(f"There is no folder {folder}, given with {name}. Give an existing folder.")
    if options.colmap is None:
        cameras = read_transforms(
            Path(options.transforms or "").absolute(), options.images, options.masks, advice=advice
        )
    else:
        cameras = read_colmap(options.colmap.absolute(), options.images, options.masks, advice=advice)
    check_frames(cameras.frames, cameras.source)
    return cameras._replace(frames=[rescale_intrinsics(frame, cameras.source) for frame in cameras.frames])


def open_splat(
    path: str | Path, options: SplatOptions, *, say: Callable[[str], None] = lambda text: None
) -> SplatScene:
    """Open a trained splat and its images.

    Args:
        path: a PLY file of Inria's trainer, gsplat or ns-export, or ckpt_<step>_rank<r>.pt of gsplat's simple_trainer;
            the first bytes of the file distinguish the two. Installed packages may add other formats by suffix.
        options: locations of its cameras and images.
        say: function that is called with one sentence per assumption, for example `print`.
    Raises:
        FileNotFoundError: if a file or image is missing.
        ValueError: if a file cannot be read, does not match the others or is not a splat.
        TypeError: if an argument has the wrong type.

    >>> from normlift_ns import SplatOptions, open_run, open_splat
    >>> run = open_run(config)
    >>> rows = run.export(folder / "splat.ply")
    >>> transforms, world = run.scene.location.folder / "transforms.json", config.parent / "dataparser_transforms.json"
    >>> scene = open_splat(folder / "splat.ply", SplatOptions(transforms=transforms, world_transform=world))
    >>> len(scene.gaussians) == len(rows), len(scene.train)
    (True, 12)
    """
    if not isinstance(path, str | Path) or not isinstance(options, SplatOptions):
        raise TypeError(
            f"open_splat takes a path and SplatOptions, got {type(path).__name__} and {type(options).__name__}"
        )
    path = Path(path).absolute()
    cameras = read_camera_file(options)
    file = _read(path)
    held_out = _held_out(options, cameras)
    for text in _assumptions(path, options, file, held_out, cameras):
        say(text)

    def scene_in(world: WorldTransform) -> SplatScene:
        placed = transform_frames(cameras.frames, world)
        if file.pose_adjust is not None:
            placed = _adjust_poses(placed, held_out, file.pose_adjust, path)
        train, rest = split_views(placed, held_out if options.views == "train" else frozenset(), options.background)
        return SplatScene(
            file.splat,
            train,
            rest,
            cameras.folder.name or "splat",
            path,
            file.step,
            Path("outputs").absolute(),
            cameras.names_root,
            {
                "source_splat": str(path),
                "source_cameras": str(cameras.source),
                "source_step": file.step,
                "source_world": {"transform": world.transform.tolist(), "scale": float(world.scale)},
            },
            options.rasterize_mode or file.rasterize_mode or "classic",
            options.background,
            train.check_files(),
        )

    (_, first), *others = _candidate_worlds(file, options, cameras)
    scene = scene_in(first)
    if len(others) == 0 or mean_psnr(scene) >= MIN_PSNR:
        return scene
    for text, world in others:
        other = scene_in(world)
        if mean_psnr(other) >= MIN_PSNR:  # renders match the images
            say(text)
            return other
    return scene


def _held_out(options: SplatOptions, cameras: CameraFile) -> frozenset[str]:
    """Return the names of the images that the training did not use."""
    held_out, frames = cameras.held_out, cameras.frames
    if options.test_every is not None or len(options.eval_images) > 0:
        names = [frame.name for frame in frames]
        held_out = held_out_names(names, test_every=options.test_every, eval_images=options.eval_images)
    if len(held_out) == len(frames) and options.views == "train":
        raise InputError(f"All {len(frames)} images are held out, so none is left to lift; give --views all.")
    return held_out


SPLAT_READERS = Registry(
    "normlift_ns.scenes",
    {
        "ply": "normlift_ns.data.splat:read_ply",
        "pt": "normlift_ns.data.checkpoint:read_gsplat_checkpoint",
    },
    plugin=FunctionType,
    noun="splat format",
    flag="--load-ply",
    default="splat.ply",
)
"""Readers of splat files by file name suffix, functions from a path to a `SplatFile`. Other packages add theirs with
entry points of this group."""


def _read(path: Path) -> SplatFile:
    """Read a splat by the reader of its format.

    Raises:
        FileNotFoundError, ValueError: If the file is missing or not a splat, or the reader of another package fails.
    """
    name = _format(path)
    read = SPLAT_READERS.load(name)
    if name in SPLAT_READERS.built_in:
        return read(path)
    try:
        file = read(path)
    except (InputError, OSError):
        raise
    except Exception as error:  # readers of other packages may raise anything
        reason = summarize_error(error)
        raise InputError(f"{path} cannot be read by the installed reader of the format {name!r} ({reason})") from error
    if not isinstance(file, SplatFile):
        kind = type(file).__name__
        raise InputError(f"the installed reader of the format {name!r} returned {kind}, expected a SplatFile")
    validate_splat(file.splat, path)
    return file


def _format(path: Path) -> str:
    """Return the name of a file's format: by its suffix, or by its first bytes for the built-in formats."""
    name = path.suffix.removeprefix(".")
    if name != "ply" and name in SPLAT_READERS.names():
        return name
    if not path.is_file():
        return "ply"
    with path.open("rb") as file:
        return "pt" if file.read(2) == b"PK" else "ply"  # torch.save writes ZIP archives


_TURNED = "The axes of gsplat's normalization point the other way; rotated by half a turn, the splat fits its images."
_NORMALIZED = "The splat does not fit its images in the world of its cameras, but it does in gsplat's normalized world."


def _candidate_worlds(file: SplatFile, options: SplatOptions, cameras: CameraFile) -> list[tuple[str, WorldTransform]]:
    """Return possible maps from the cameras' world to the splat's, each with a message for its use.

    There are several if only the images can tell. A PLY file may come from gsplat's trainer too, so its normalized
    world is the alternative if that of the cameras does not fit.
    """
    if options.world_transform is not None:
        world = read_world_transform(options.world_transform, cameras.applied_transform, cameras.applied_scale)
        return [("", world)]
    same = [("", WorldTransform(np.eye(4)[:3], 1.0))]
    if not options.gsplat_normalize or not (file.by_gsplat or options.colmap):
        return same
    try:
        first, *turned = _normalizations(options, cameras)
    except (ValueError, FileNotFoundError):
        if not file.by_gsplat:
            return same
        raise
    worlds = [("", first)] if file.by_gsplat else [*same, (_NORMALIZED, first)]
    return [*worlds, *((_TURNED, world) for world in turned)]


def _normalizations(options: SplatOptions, cameras: CameraFile) -> list[WorldTransform]:
    """Recompute the normalizations that gsplat's trainer may have applied, from its COLMAP project."""
    if options.colmap is None:
        raise InputError(
            "gsplat's trainer normalized the world of the splat by the points of its COLMAP project, so a "
            "transforms.json is not enough. Give the project with --colmap, or a known transform with "
            "--world-transform, or --gsplat-normalize False if the training used --no-normalize-world-space."
        )
    try:
        points = read_colmap_points(cameras.source)
    except FileNotFoundError as error:
        raise FileNotFoundError(f"{error} gsplat's trainer normalized the world by points3D.") from error
    if len(points) < _MIN_POINTS:
        raise InputError(
            f"{cameras.source} has {len(points)} points, too few to recompute the normalization of gsplat's trainer. "
            "Give the project that the splat was trained with, or --gsplat-normalize False if the training used "
            "--no-normalize-world-space."
        )
    return gsplat_normalization(cameras.frames, points)


def _adjust_poses(
    frames: Sequence[Frame], held_out: frozenset[str], deltas: Float[Tensor, "v 9"], path: Path
) -> list[Frame]:
    """Return the frames with the pose adjustments that gsplat's --pose_opt learned for the training views."""
    trained = [frame for frame in frames if frame.name not in held_out]
    if len(trained) != len(deltas):
        without_eighth = len(frames) - len(range(0, len(frames), 8))
        hint = " The trainer holds out every 8th image: give --test-every 8." if len(deltas) == without_eighth else ""
        raise InputError(
            f"{path} has pose adjustments for {len(deltas)} training views (--pose_opt), but {len(trained)} of "
            f"{len(frames)} images are training views. Name the others with --test-every or --eval-images.{hint}"
        )
    by_name = {}
    for frame, delta in zip(trained, deltas.numpy()):
        first, second = delta[3:6] + np.eye(3)[0], delta[6:9] + np.eye(3)[1]
        if np.linalg.norm(np.cross(first, second)) < _PARALLEL:
            raise InputError(
                f"{path}: its `pose_adjust` for {frame.name} is not a valid rotation. Expected two axes that are not "
                "parallel."
            )
        x = first / np.linalg.norm(first)
        y = second - (x @ second) * x
        y /= np.linalg.norm(y)
        rotation = np.stack([x, y, np.cross(x, y)])
        opencv = frame.pose * [1, -1, -1, 1]
        pose = np.concatenate(
            [opencv[:, :3] @ rotation * [1, -1, -1], opencv[:, :3] @ delta[:3, None] + opencv[:, 3:]], axis=1
        )
        by_name[frame.name] = replace(frame, pose=pose)
    return [by_name.get(frame.name, frame) for frame in frames]


def _assumptions(
    path: Path, options: SplatOptions, file: SplatFile, held_out: frozenset[str], cameras: CameraFile
) -> list[str]:
    """Return messages about settings that the files do not specify."""
    texts, mode, frames = [], file.rasterize_mode, cameras.frames
    if options.rasterize_mode is not None and mode is not None and mode != options.rasterize_mode:
        texts.append(
            f"{path.name} has SplatRenderMode {mode}; --rasterize-mode {options.rasterize_mode} is used instead."
        )
    if options.rasterize_mode is None and mode is None:
        texts.append(f"{path.name} does not name its rasterize mode; classic is assumed (see --rasterize-mode).")
    texts.append(
        "Weights are computed as in gsplat, in the version of --gsplat-version (default: 1.4). Versions before 1.6 cap "
        "the opacity of a Gaussian in a pixel at 0.999, version 1.6 and Inria's trainer at 0.99. Inria's trainer "
        "assumes the principal point in the middle of the image. Distorted images are undistorted as in ns-train."
    )
    if len(held_out) > 0:
        lifted = "lifted too" if options.views == "all" else "not lifted"
        texts.append(f"{len(held_out)} of {len(frames)} images were held out of the training; they are {lifted}.")
    else:
        texts.append(f"All {len(frames)} images are lifted; see --test-every and --eval-images.")
    if options.colmap is not None:
        folder = (options.images or options.colmap / "images").absolute()
        unused = len({file for file in folder.rglob("*") if file.is_file()} - {frame.file for frame in frames})
        if unused > 0:
            texts.append(f"{unused} files in {folder} have no camera and are skipped.")
    return texts
