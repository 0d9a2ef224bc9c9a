"""Functions that open splats without a nerfstudio run."""

from __future__ import annotations

import math
import zipfile
from collections.abc import Callable
from pathlib import Path
from types import FunctionType

import numpy as np
from jaxtyping import Float

from normlift_ns.core.arguments import check_arguments
from normlift_ns.core.device import choose_device
from normlift_ns.data.cameras import adjust_poses, read_camera_file
from normlift_ns.data.fisheye import KEPT_SHARE, MAX_ANGLE, kept_share
from normlift_ns.data.frames import Frame
from normlift_ns.data.gltf import GLB_MAGIC
from normlift_ns.data.gsplat_config import find_gsplat_config
from normlift_ns.data.images import held_out_names
from normlift_ns.data.inria_config import TEST_EVERY, find_inria_config
from normlift_ns.data.open_scene import SplatScene, split_views
from normlift_ns.data.splat import SplatFile, SplatParameters, flatten_splat, validate_splat
from normlift_ns.data.spz import GZIP_MAGIC, SPZ_MAGIC
from normlift_ns.data.transforms import CameraFile
from normlift_ns.data.world_search import find_world
from normlift_ns.data.worlds import CandidateWorld, candidate_worlds
from normlift_ns.errors import InputError, summarize_error
from normlift_ns.io.guard import open_regular, protect_inputs
from normlift_ns.options import Background, Primitive, SplatOptions
from normlift_ns.rasterization.settings import RasterSettings
from normlift_ns.registry import Registry

_MAX_STEP = 0.1
"""Maximum step between neighboring float32 coordinates, as a fraction of the median width of the Gaussians."""


@check_arguments
def open_splat(
    path: str | Path,
    options: SplatOptions,
    *,
    device: str = "auto",
    say: Callable[[str], None] = lambda text: None,
) -> SplatScene:
    """Open a trained splat and its images, with the cameras in the world that `SplatOptions.world_transform` selects.

    Args:
        path: A plain or compressed PLY file, an SPZ, .splat, GLB or glTF file, or ckpt_<step>_rank<r>.pt of gsplat's
            simple_trainer. The first bytes or the suffix determine the format. Installed packages may add formats.
        options: Paths of the cameras and images, and settings of the splat.
        device: Device for the renders that find the world: auto, cpu, cuda, or one GPU such as cuda:1.
        say: Function that is called with a message about each assumption, for example `print`.
    Raises:
        FileNotFoundError: A file or image is missing.
        ValueError: A file cannot be read, does not match the others, or is not a splat. Also if `path` is not a path.
        TypeError: Another argument has the wrong type.

    >>> from normlift_ns import SplatOptions, open_run, open_splat
    >>> run = open_run(config)
    >>> rows = run.export(folder / "splat.ply")
    >>> transforms, world = run.scene.location.folder / "transforms.json", config.parent / "dataparser_transforms.json"
    >>> scene = open_splat(folder / "splat.ply", SplatOptions(transforms=transforms, world_transform=world))
    >>> len(scene.gaussians) == len(rows), len(scene.train)
    (True, 12)
    """
    path = Path(path).absolute()
    cameras = read_camera_file(options)
    file = _with_primitive(_read(path), path, options)
    file, background = _with_inria_config(file, path, options)
    _check_coordinates(
        file.splat, file.splat.means[:: len(file.splat) // 10_000 + 1].double().numpy(), str(path), options
    )
    held_out = _held_out(options, cameras, file.test_every)
    for text in _assumptions(path, options, file, held_out, cameras):
        say(text)

    def scene_in(candidate: CandidateWorld) -> SplatScene:
        placed, world = candidate.place(cameras.frames), candidate.world
        planes = candidate.clip_planes(file.clip_planes)
        if file.pose_adjust is not None:
            placed = adjust_poses(placed, held_out, file.pose_adjust, path)
        train, rest = split_views(placed, held_out if options.views == "train" else frozenset(), background)
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
                "source_world": {
                    "name": candidate.name,
                    "transform": world.transform.tolist(),
                    "scale": float(world.scale),
                    "opencv_cameras": candidate.opencv_cameras,
                },
                **({"primitive": "2dgs"} if file.primitive == "2dgs" else {}),
                **({} if planes is None else {"clip_planes": planes}),
            },
            options.rasterize_mode or file.rasterize_mode or "classic",
            background,
            train.check_files(),
        )

    candidates = candidate_worlds(file, options, cameras)
    if len(candidates) == 1:
        scene = scene_in(candidates[0])
    else:
        scene = find_world(candidates, scene_in, device=choose_device(device), say=say)
    positions = np.array([frame.pose[:, 3] for frame in (*scene.train.frames, *scene.held_out.frames)])
    _check_coordinates(file.splat, positions, f"The cameras of {cameras.source}", options, of_cameras=True)
    return scene


def _check_coordinates(
    splat: SplatParameters,
    positions: Float[np.ndarray, "n 3"],
    what: str,
    options: SplatOptions,
    *,
    of_cameras: bool = False,
) -> None:
    """Raise InputError if positions are so far from the origin that float32 is too coarse for the Gaussians.

    Args:
        splat: Gaussians of the scene.
        positions: Positions of the Gaussians, or of the cameras in the same world.
        what: File or objects with these positions, for the error message.
        options: Options of the splat.
        of_cameras: True if the positions are those of the cameras, and the splat itself was checked before.
    """
    center, width = np.median(positions, axis=0), float(splat.scales.median().exp())
    step = float(np.spacing(np.abs(center).max().astype(np.float32)))
    if not step > _MAX_STEP * width:
        return
    x, y, z = (round(float(f"{value:.2g}")) for value in center)
    matrix = f"1 0 0 {-x}\\n0 1 0 {-y}\\n0 0 1 {-z}\\n0 0 0 1\\n"
    command = f"run printf '{matrix}' > offset.txt, and give --world-transform offset.txt"
    given = options.world_transform if isinstance(options.world_transform, Path) else None
    if of_cameras:
        advice = (
            f"Subtract the offset that was subtracted from the splat. For the offset {x} {y} {z}, {command}."
            if given is None
            else f"Correct the transform in {given}."
        )
    else:
        advice = (
            f"Subtract the same offset, such as {x} {y} {z}, from the splat and the cameras. Export the splat with "
            "this offset from the program that wrote it. For the cameras, "
            f"{command if given is None else f'change the transform in {given}'}."
        )
    raise InputError(
        f"{what}: the median of the coordinates is ({', '.join(f'{value:.10g}' for value in center)}), far from the "
        f"origin. There, the step of float32 is {step:.2g}, too coarse for Gaussians {width:.2g} wide. {advice}"
    )


def _held_out(options: SplatOptions, cameras: CameraFile, test_every: int | None) -> frozenset[str]:
    """Return the names of the held-out images: from the options, else the training settings, else the camera file."""
    held_out, frames = cameras.held_out, cameras.frames
    if options.test_every is not None or len(options.eval_images) > 0:
        test_every = options.test_every
    if test_every is not None or len(options.eval_images) > 0:
        names = [frame.name for frame in frames]
        held_out = held_out_names(names, test_every=test_every, eval_images=options.eval_images)
    if len(held_out) == len(frames) and options.views == "train":
        raise InputError(f"All images are held out ({len(frames)}), expected at least one to lift; give --views all.")
    return held_out


_HEAD_BYTES = 64
_MAGIC = {b"ply": "ply", SPZ_MAGIC: "spz", GZIP_MAGIC: "spz", GLB_MAGIC: "glb"}
_SNIFFED = {*_MAGIC.values(), "pt", "splat", "gltf"}
"""Built-in formats, detected by the first bytes of a file, or by its suffix if the bytes match none of them."""
_UNREAD = ("sog", "ksplat", "lcc", "usdz", "usd", "usda", "usdc")
"""Suffixes of unsupported formats."""
_JSON_FORMATS = {"meta.json": "SOG", "lod-meta.json": "streamed SOG"}
"""Unsupported formats by the names of their files."""
_BY_SPLAT_TRANSFORM = ("SOG", "KSPLAT", "LCC")
_DOWNLOAD = "Download the file itself instead of the page that shows it."
_STRANGERS = {
    b"version https://git-lfs": ("a pointer of Git LFS", "Fetch the file itself with: git lfs pull"),
    b"<!doctype html": ("an HTML page", _DOWNLOAD),
    b"<html": ("an HTML page", _DOWNLOAD),
}
"""First bytes, in lower case, of files that a failed download leaves instead of a splat, with their kind and advice."""
SPLAT_READERS = Registry(
    "normlift_ns.scenes",
    {
        "ply": "normlift_ns.data.splat:read_ply",
        "pt": "normlift_ns.data.checkpoint:read_gsplat_checkpoint",
        "spz": "normlift_ns.data.spz:read_spz",
        "splat": "normlift_ns.data.antimatter:read_antimatter",
        "glb": "normlift_ns.data.gltf:read_gltf",
        "gltf": "normlift_ns.data.gltf:read_gltf",
    },
    plugin=FunctionType,
    noun="splat format",
    flag="--load-ply",
    default="splat.ply",
)
"""Readers of splat files by suffix: functions that take a path and return a `SplatFile`.

Other packages add readers with entry points of the group `normlift_ns.scenes`.
"""


def _read(path: Path) -> SplatFile:
    """Read a splat with the reader for its format.

    Raises:
        FileNotFoundError, ValueError: The file is missing or not a splat, or the reader of another package fails.
    """
    protect_inputs(path)
    name = _format(path)
    read = SPLAT_READERS.load(name)
    if name in ("ply", "pt"):
        return _with_gsplat_config(read(path), path)
    if name in SPLAT_READERS.built_in:
        return read(path)
    try:
        file = read(path)
    except (InputError, OSError):
        raise
    except Exception as error:  # readers of other packages may raise any exception
        reason = summarize_error(error)
        problem = f"{path} cannot be read by the installed reader of the format {name!r} ({reason})"
        raise InputError(f"{problem}; fix the package of this reader, or give a PLY file") from error
    if not isinstance(file, SplatFile):
        problem = f"the installed reader of the format {name!r} returned {type(file).__name__}, expected a SplatFile"
        raise InputError(f"{problem}; fix the package of this reader, or give a PLY file")
    validate_splat(file.splat, path)
    return file


def _with_gsplat_config(file: SplatFile, path: Path) -> SplatFile:
    """Add the settings in the cfg.yml of the training run to the contents of a checkpoint or PLY file."""
    config = find_gsplat_config(path)
    if config is None:
        return file
    normalized, mode = config.normalize_world_space, config.rasterize_mode
    return file._replace(
        rasterize_mode=mode or file.rasterize_mode,
        by_gsplat=file.by_gsplat if normalized is None else normalized,
        test_every=config.test_every,
        primitive=file.primitive or config.primitive,
        clip_planes=config.clip_planes,
        remarks=(*file.remarks, f"The training settings come from {config.path}."),
    )


def _with_inria_config(file: SplatFile, path: Path, options: SplatOptions) -> tuple[SplatFile, Background]:
    """Return the contents of a file with the settings in the cfg_args of the training run, and the background color."""
    config = find_inria_config(path)
    if config is None:
        return file, options.background or "black"
    test_every = TEST_EVERY if config.has_test_images and options.colmap is not None else None
    remarks = (*file.remarks, f"The training settings come from {config.path}.")
    mode = file.rasterize_mode or ("antialiased" if config.antialiased else None)
    file = file._replace(rasterize_mode=mode, test_every=file.test_every or test_every, remarks=remarks)
    return file, options.background or ("white" if config.white_background else "black")


_CLIP_PLANES = (0.2, 1e10)
"""Near and far planes for 2D Gaussians in world units, if no file contains them. 2DGS trainers use this near plane."""


def _with_primitive(file: SplatFile, path: Path, options: SplatOptions) -> SplatFile:
    """Set the primitive of a splat from the options, its files or its file name, in this order; flatten 2D Gaussians.

    Raises:
        ValueError: The options and the files contradict each other.
    """
    named: Primitive = "2dgs" if "2dgs" in path.name.lower() else "3dgs"
    if options.primitive is not None and file.primitive not in (None, options.primitive):
        raise InputError(
            f"{path} has {file.primitive} Gaussians, according to its scales or its training settings, but "
            f"--primitive is {options.primitive}. Omit --primitive, or give another file."
        )
    if (options.primitive or file.primitive or named) == "3dgs":
        is_usual = file.clip_planes == (RasterSettings.near_plane, RasterSettings.far_plane)
        return file._replace(primitive="3dgs", clip_planes=None if is_usual else file.clip_planes)
    if options.rasterize_mode == "antialiased":
        raise InputError(
            f"{path} contains 2D Gaussians, which do not support antialiasing; omit --rasterize-mode antialiased."
        )
    near, far = planes = file.clip_planes or _CLIP_PLANES
    remark = f"{path.name} contains 2D Gaussians, rendered from {near:g} to {far:g} world units in front of a camera."
    return file._replace(
        splat=flatten_splat(file.splat),
        rasterize_mode="classic",
        primitive="2dgs",
        clip_planes=planes,
        remarks=(*file.remarks, remark),
    )


def _format(path: Path) -> str:
    """Detect the format of a file, and return its key in `SPLAT_READERS`.

    The suffix decides for formats of other packages. For all other files, the first bytes decide, or else the suffix.

    Raises:
        ValueError: The path is a folder, or the file is not a splat or has an unsupported format.
    """
    suffix = path.suffix.removeprefix(".")
    if suffix in SPLAT_READERS.names() and suffix not in _SNIFFED:
        return suffix
    suffix = suffix.lower()
    head = b""
    if path.is_dir():
        raise InputError(f"{path} is a folder, expected the file of a splat. Give the path of the file.")
    if path.is_file():
        with open_regular(path) as file:
            head = file.read(_HEAD_BYTES)
    for start, (kind, advice) in _STRANGERS.items():
        if head.lstrip().lower().startswith(start):
            raise InputError(f"{path} is {kind}, expected a splat. {advice}")
    if head.startswith(b"PK"):  # torch.save writes ZIP archives
        if suffix in _UNREAD:
            raise _unread(path, suffix.upper())
        _refuse_archive(path)
        return "pt"
    for start, name in _MAGIC.items():
        if head.startswith(start):
            return name
    if suffix in _UNREAD or path.name in _JSON_FORMATS:
        raise _unread(path, _JSON_FORMATS.get(path.name, suffix.upper()))
    if head.lstrip()[:1] == b"{":
        return "gltf"
    return suffix if suffix in _SNIFFED else "ply"


def _refuse_archive(path: Path) -> None:
    """Raise InputError unless a ZIP archive was written by torch.save, or is too damaged to be listed."""
    try:
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
    except Exception:  # zipfile raises any kind of exception on a damaged file, which the reader reports
        return
    suffixes = {Path(name).suffix.lower() for name in names}
    if suffixes & {".usd", ".usda", ".usdc"}:
        raise _unread(path, "USDZ")
    if "meta.json" in names and ".webp" in suffixes:
        raise _unread(path, "SOG")
    if not any(Path(name).name == "data.pkl" for name in names):  # torch.save writes data.pkl
        raise InputError(
            f"{path} is a ZIP archive of {', '.join(names)[:200] or 'nothing'}, expected a splat. If the archive "
            "contains a splat, extract it, and give the extracted file."
        )


def _unread(path: Path, name: str) -> InputError:
    advice = "Export a PLY file from the program that wrote it, and give the PLY file."
    if name in _BY_SPLAT_TRANSFORM:
        advice = f"Convert it with: npx @playcanvas/splat-transform {path.name} {path.stem}.ply (Node 22 or newer)"
    return InputError(f"{path} has the format {name}, which is not supported. {advice}")


def _assumptions(
    path: Path, options: SplatOptions, file: SplatFile, held_out: frozenset[str], cameras: CameraFile
) -> list[str]:
    """Return messages about the settings in use and about files that are skipped."""
    texts, mode, frames = list(file.remarks), file.rasterize_mode, cameras.frames
    if options.rasterize_mode is not None and mode is not None and mode != options.rasterize_mode:
        texts.append(
            f"{path.name} was trained with rasterize mode {mode}, but --rasterize-mode {options.rasterize_mode} is "
            "used instead."
        )
    if options.rasterize_mode is None and mode is None:
        texts.append(f"{path.name} does not contain its rasterize mode; classic is assumed (see --rasterize-mode).")
    texts.append(
        "Weights are computed as in gsplat, with the version of --gsplat-version (default: 1.4). Versions before 1.6 "
        "cap the opacity of a Gaussian in a pixel at 0.999; version 1.6 and Inria's trainer cap it at 0.99. Inria's "
        "trainer assumes that the principal point is the image center. Images of perspective cameras are undistorted "
        "as in ns-train."
    )
    if len(held_out) > 0:
        lifted = "lifted too" if options.views == "all" else "not lifted"
        texts.append(f"Images held out of the training are {lifted} ({len(held_out)} of {len(frames)} images).")
    else:
        texts.append(
            f"No images are held out (number of images: {len(frames)}); to hold out some, give --test-every or "
            "--eval-images."
        )
    texts += cameras.remarks
    if frames[0].intrinsics.fisheye:
        texts.append(_fisheye_assumption(frames[0]))
    if options.colmap is not None:
        folder = (options.images or options.colmap / "images").absolute()
        unused = len({file for file in folder.rglob("*") if file.is_file()} - {frame.file for frame in frames})
        if unused > 0:
            texts.append(f"Files in {folder} that have no camera are skipped (number of files: {unused}).")
    return texts


def _fisheye_assumption(frame: Frame) -> str:
    """Return a message about the undistortion of fisheye images, given the frame of the first image."""
    try:
        kept = kept_share(frame.intrinsics)
    except InputError as error:
        raise InputError(f"The camera of {frame.file} cannot be used: {error}") from error
    angle = math.degrees(MAX_ANGLE)
    limit = "" if kept >= KEPT_SHARE else f"; the others do not lie within {angle:.0f} degrees of the optical axis"
    return (
        f"Fisheye images are undistorted to pinhole cameras of the same size. {frame.name} keeps {kept:.0%} of its "
        f"pixels{limit}. Masks and label maps are undistorted too: give those of the original images."
    )
