"""Opening a splat that no nerfstudio run holds: a PLY file or a checkpoint of gsplat, and a file of cameras."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from normlift_ns.core.gaussians import Camera, GaussianScene
from normlift_ns.errors import InputError
from normlift_ns.options import Background, RasterizeMode, SplatOptions
from normlift_ns.raster.colors import view_colors
from normlift_ns.scenes.cameras import Cameras, read_camera_file
from normlift_ns.scenes.colmap import read_points
from normlift_ns.scenes.formats.gsplat_checkpoint import GsplatCheckpoint, read_gsplat
from normlift_ns.scenes.formats.ply import PlySplat, read_ply
from normlift_ns.scenes.frames import Frame, World, moved
from normlift_ns.scenes.match import LEAST_PSNR, mean_psnr
from normlift_ns.scenes.photographs import PhotographViews
from normlift_ns.scenes.similarity import gsplat_normalization
from normlift_ns.scenes.splat import Splat
from normlift_ns.scenes.split import held_out_names

BACKGROUNDS: dict[Background, Tensor] = {"black": torch.zeros(3), "white": torch.ones(3)}
_FEW_POINTS, _PARALLEL = 4, 1e-6


@dataclass(frozen=True)
class SplatScene:
    """A `Scene`: a splat and its photographs, without any nerfstudio run."""

    splat: Splat
    train: PhotographViews
    held_out: PhotographViews
    name: str
    checkpoint_path: Path
    """The PLY file, the first checkpoint of gsplat, or the checkpoint of a lifted run."""
    step: int
    """Of the training; 0 where nothing tells."""
    runs_dir: Path
    photographs: Path
    """Folder that names of photographs are relative to."""
    identity: Mapping[str, Any]
    rasterize_mode: RasterizeMode
    background_name: Background
    remarks: tuple[str, ...] = ()
    """What a person should know of the photographs, in whole sentences."""

    renderer = None
    """normlift_ns draws it."""
    has_harmonics = True

    @property
    def gaussians(self) -> GaussianScene:
        """The N Gaussians, activated."""
        return self.splat.activated

    @property
    def parameters(self) -> dict[str, Tensor]:
        """As trained, by splatfacto's names."""
        return self.splat.parameters

    @property
    def background(self) -> Float[Tensor, " 3"]:
        """RGB in 0..1 behind the Gaussians."""
        return BACKGROUNDS[self.background_name]

    def colors(self, camera: Camera) -> Float[Tensor, "n 3"]:
        """RGB >= 0 of every Gaussian as the camera sees it."""
        coefficients = torch.cat([self.splat.features_dc[:, None], self.splat.features_rest], dim=1)
        return view_colors(self.splat.means, coefficients, camera, self.splat.degree)


def open_splat(
    path: str | Path, options: SplatOptions, *, say: Callable[[str], None] = lambda text: None
) -> SplatScene:
    """A trained splat and its photographs.

    Args:
        path: a PLY file of Inria's trainer, gsplat or ns-export, or ckpt_<step>_rank<r>.pt of gsplat's simple_trainer;
            its first bytes tell which.
        options: where its cameras and photographs are.
        say: called with a sentence for everything that had to be assumed, for example `print`.
    Raises:
        FileNotFoundError: a file or photograph is missing.
        ValueError: a file that cannot be read, that does not fit the others or that is no splat.
        TypeError: arguments of other types.

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
    frames = cameras.frames
    (splat, mode), checkpoint = _read(path)
    held_out = cameras.held_out
    if options.test_every is not None or len(options.holdout) > 0:
        names = [frame.name for frame in frames]
        held_out = held_out_names(names, test_every=options.test_every, holdout=options.holdout)
    if len(held_out) == len(frames) and options.views == "train":
        raise InputError(f"All {len(frames)} photographs are held out, none is left to lift; give --views all.")
    for text in _assumptions(path, options, mode, held_out, frames, cameras):
        say(text)
    worlds = _worlds(checkpoint, options, cameras)

    def placed(world: World) -> SplatScene:
        there = moved(frames, world)
        if checkpoint is not None and checkpoint.pose_adjust is not None:
            there = _adjusted(there, held_out, checkpoint.pose_adjust, path)
        background = BACKGROUNDS[options.background]
        kept = [frame for frame in there if options.views == "all" or frame.name not in held_out]
        rest = [frame for frame in there if options.views == "train" and frame.name in held_out]
        step = 0 if checkpoint is None else checkpoint.step
        train = PhotographViews(kept, background)
        return SplatScene(
            splat,
            train,
            PhotographViews(rest, background),
            cameras.folder.name or "splat",
            path,
            step,
            Path("outputs").absolute(),
            cameras.base,
            {
                "source_splat": str(path),
                "source_cameras": str(cameras.source),
                "source_step": step,
                "source_world": {"transform": world.transform.tolist(), "scale": float(world.scale)},
            },
            options.rasterize_mode or mode or "classic",
            options.background,
            train.check_files(),
        )

    return _best(placed, worlds, say)


def _read(path: Path) -> tuple[PlySplat, GsplatCheckpoint | None]:
    """The splat of a file, and the checkpoint that holds it, if one does."""
    if _is_checkpoint(path):
        checkpoint = read_gsplat(path)
        return PlySplat(checkpoint.splat, None), checkpoint
    return read_ply(path), None


def _is_checkpoint(path: Path) -> bool:
    """What torch.save writes is a ZIP archive; a missing file goes by its suffix."""
    if not path.is_file():
        return path.suffix == ".pt"
    with path.open("rb") as file:
        return file.read(2) == b"PK" or path.suffix == ".pt"


def _best(
    placed: Callable[[World], SplatScene], worlds: Sequence[tuple[str, World]], say: Callable[[str], None]
) -> SplatScene:
    """The scene in the first world that its photographs confirm; if none does, in the first of all."""
    (_, first), *others = worlds
    scene = placed(first)
    if len(others) == 0 or mean_psnr(scene) >= LEAST_PSNR:
        return scene
    for text, world in others:
        other = placed(world)
        if mean_psnr(other) >= LEAST_PSNR:
            say(text)
            return other
    return scene


_TURNED = (
    "The axes of gsplat's normalization point the other way; turned by half a turn, the splat fits its photographs."
)
_NORMALIZED = (
    "The splat does not lie in the world of its cameras, but fits its photographs in gsplat's normalized world."
)


def _worlds(checkpoint: GsplatCheckpoint | None, options: SplatOptions, cameras: Cameras) -> list[tuple[str, World]]:
    """From the world of the cameras to that of the splat, with what to say of it; several where only photographs tell.

    A PLY file may be of gsplat's trainer too: its normalized world is tried where that of the cameras does not fit.
    """
    if cameras.to_splat is not None:
        return [("", cameras.to_splat)]
    same = [("", World(np.eye(4)[:3], 1.0))]
    if not options.gsplat_normalize or (checkpoint is None and options.colmap is None):
        return same
    try:
        first, *turned = _normalized(options, cameras)
    except (ValueError, FileNotFoundError):
        if checkpoint is None:
            return same
        raise
    worlds = [("", first)] if checkpoint is not None else [*same, (_NORMALIZED, first)]
    return [*worlds, *((_TURNED, world) for world in turned)]


def _normalized(options: SplatOptions, cameras: Cameras) -> list[World]:
    """How gsplat's trainer normalized the world, from its COLMAP project."""
    if options.colmap is None:
        raise InputError(
            "gsplat's trainer normalized the world of the splat by the points of its COLMAP project, so a "
            "transforms.json is not enough. Give the project with --colmap; or --world-transform with the map that you "
            "know; or --gsplat-normalize False, if the training had --no-normalize-world-space."
        )
    try:
        points = read_points(cameras.source)
    except FileNotFoundError as error:
        raise FileNotFoundError(f"{error} gsplat's trainer normalized the world by points3D.") from error
    if len(points) < _FEW_POINTS:
        raise InputError(
            f"{cameras.source} has {len(points)} points, so the normalization of gsplat's trainer cannot be computed "
            "again. Give the project that the splat was trained with; or --gsplat-normalize False, if the training had "
            "--no-normalize-world-space."
        )
    return gsplat_normalization(cameras.frames, points)


def _adjusted(
    frames: Sequence[Frame], held_out: frozenset[str], moves: Float[Tensor, "v 9"], path: Path
) -> list[Frame]:
    """The training views where gsplat's --pose_opt moved them."""
    trained = [frame for frame in frames if frame.name not in held_out]
    if len(trained) != len(moves):
        eighth = len(frames) - len(range(0, len(frames), 8))
        hint = " The trainer holds out every eighth: give --test-every 8." if len(moves) == eighth else ""
        raise InputError(
            f"{path} moved the cameras of {len(moves)} training views (--pose_opt), but there are {len(trained)} of "
            f"{len(frames)} photographs. Say which were held out with --test-every or --holdout.{hint}"
        )
    by_name = {}
    for frame, move in zip(trained, moves.numpy()):
        first, second = move[3:6] + np.eye(3)[0], move[6:9] + np.eye(3)[1]
        if np.linalg.norm(np.cross(first, second)) < _PARALLEL:
            raise InputError(f"{path}: its `pose_adjust` turns {frame.name} by no rotation. Expected two axes.")
        x = first / np.linalg.norm(first)
        y = second - (x @ second) * x
        y /= np.linalg.norm(y)
        rotation = np.stack([x, y, np.cross(x, y)])
        opencv = frame.pose * [1, -1, -1, 1]
        pose = np.concatenate(
            [opencv[:, :3] @ rotation * [1, -1, -1], opencv[:, :3] @ move[:3, None] + opencv[:, 3:]], axis=1
        )
        by_name[frame.name] = replace(frame, pose=pose)
    return [by_name.get(frame.name, frame) for frame in frames]


def _assumptions(
    path: Path,
    options: SplatOptions,
    mode: RasterizeMode | None,
    held_out: frozenset[str],
    frames: Sequence[Frame],
    cameras: Cameras,
) -> list[str]:
    """What nothing in the files says."""
    texts = []
    if options.rasterize_mode is not None and mode is not None and mode != options.rasterize_mode:
        texts.append(f"{path.name} says SplatRenderMode {mode}; --rasterize-mode {options.rasterize_mode} counts.")
    if options.rasterize_mode is None and mode is None:
        texts.append(f"{path.name} does not say how it was rasterized: taken for classic, see --rasterize-mode.")
    texts.append(
        "Weights are those of gsplat, by the rules of --gsplat-rules (1.4 by default): a Gaussian covers at most 0.999 "
        "of a pixel, by those of 1.6 at most 0.99, as in Inria's trainer. That one "
        "puts the principal point in the middle; photographs with distortion are undistorted as ns-train does it."
    )
    if len(held_out) > 0:
        lifted = "lifted too" if options.views == "all" else "not lifted"
        texts.append(f"{len(held_out)} of {len(frames)} photographs were held out of the training; they are {lifted}.")
    else:
        texts.append(f"All {len(frames)} photographs are lifted; see --test-every and --holdout.")
    if options.colmap is not None:
        folder = (options.images or options.colmap / "images").absolute()
        unused = len({file for file in folder.rglob("*") if file.is_file()} - {frame.file for frame in frames})
        if unused > 0:
            texts.append(f"{unused} files in {folder} have no camera and are left out.")
    return texts
