"""Files of cameras, whatever wrote them: COLMAP projects and transforms.json."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from normlift_ns.errors import InputError
from normlift_ns.options import SplatOptions
from normlift_ns.scenes.colmap import intrinsics_of, model_folder, pose_of, read_model
from normlift_ns.scenes.frames import Frame, World, check_frames, find_masks, find_photographs, sized
from normlift_ns.scenes.similarity import read_world_transform
from normlift_ns.scenes.transforms import read_transforms, relative_name


class Cameras(NamedTuple):
    """What a file of cameras says."""

    frames: list[Frame]
    """All photographs in the order of their files, in the file's world."""
    held_out: frozenset[str]
    source: Path
    folder: Path
    """Of the dataset."""
    base: Path
    """What the names of the photographs are relative to."""
    to_splat: World | None
    """By --world-transform."""


def read_camera_file(options: SplatOptions, advice: str = "say where the photographs are with --images") -> Cameras:
    """The cameras that the options name, with photographs that exist.

    Args:
        advice: what to do about missing photographs.
    Raises:
        FileNotFoundError: a file, folder, photograph or mask is missing.
        ValueError: none or two files of cameras, or one that cannot be read.
    """
    given = {"--colmap": options.colmap, "--transforms": options.transforms}
    count = sum(value is not None for value in given.values())
    if count != 1:
        raise InputError(
            f"A splat needs one file of cameras, got {'two' if count else 'none'}: give the folder of a COLMAP project "
            "with --colmap, or a transforms.json with --transforms."
        )
    for name, folder in (("--images", options.images), ("--masks", options.masks)):
        if folder is not None and not folder.is_dir():
            raise FileNotFoundError(f"There is no folder {folder}, given with {name}. Give the folder of the files.")
    cameras = _transforms(options, advice) if options.colmap is None else _colmap(options, options.colmap, advice)
    check_frames(cameras.frames, cameras.source)
    return cameras._replace(frames=[sized(frame, cameras.source) for frame in cameras.frames])


def _transforms(options: SplatOptions, advice: str) -> Cameras:
    path = Path(options.transforms or "").absolute()
    path = path / "transforms.json" if path.is_dir() else path
    found = read_transforms(path, options.images, options.masks, advice=advice)
    world = options.world_transform
    to_splat = None if world is None else read_world_transform(world, found.applied, found.applied_scale)
    base = path.parent if options.images is None else options.images.absolute().parent
    return Cameras(found.frames, found.held_out, path, path.parent, base, to_splat)


def _colmap(options: SplatOptions, folder: Path, advice: str) -> Cameras:
    folder = folder.absolute()
    model = model_folder(folder)
    cameras, images = read_model(model)
    registered = sorted(images, key=lambda image: image.name)  # as training tools sort them
    intrinsics = {number: intrinsics_of(camera, model) for number, camera in cameras.items()}
    place = options.images or folder / "images"
    if not place.is_dir():
        raise FileNotFoundError(f"There is no folder {place} of photographs. Put it there, or {advice}.")
    listed = [image.name for image in registered]
    files = find_photographs(listed, place.absolute(), model, advice, copies=True)
    masks: Sequence[Path | None] = [None] * len(files) if options.masks is None else find_masks(listed, options.masks)
    base = folder if place.absolute().is_relative_to(folder) else place.absolute().parent
    frames = [
        Frame(file, relative_name(file, base), pose_of(image), intrinsics[image.camera], mask)
        for image, file, mask in zip(registered, files, masks)
    ]
    to_splat = None if options.world_transform is None else read_world_transform(options.world_transform)
    return Cameras(frames, frozenset(), model, folder, base, to_splat)
