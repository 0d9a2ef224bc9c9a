"""Camera files: COLMAP projects and transforms.json."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from normlift_ns.data.colmap import colmap_intrinsics, colmap_pose, find_colmap_model, read_colmap_model
from normlift_ns.data.frames import Frame, WorldTransform, check_frames, find_images, find_masks, rescale_intrinsics
from normlift_ns.data.transforms import read_transforms, read_world_transform, relative_name
from normlift_ns.errors import InputError
from normlift_ns.options import SplatOptions


class CameraFile(NamedTuple):
    """Contents of a camera file."""

    frames: list[Frame]
    """All images, sorted by file, with cameras in the file's world."""
    held_out: frozenset[str]
    """Names of the images that the file excludes from the training."""
    source: Path
    """The file, or the folder of the COLMAP reconstruction."""
    folder: Path
    """Folder of the dataset."""
    names_root: Path
    """Folder that image names are relative to."""
    to_splat: WorldTransform | None
    """Transform to the splat's world, from --world-transform."""


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
    cameras = _transforms(options, advice) if options.colmap is None else _colmap(options, options.colmap, advice)
    check_frames(cameras.frames, cameras.source)
    return cameras._replace(frames=[rescale_intrinsics(frame, cameras.source) for frame in cameras.frames])


def _transforms(options: SplatOptions, advice: str) -> CameraFile:
    path = Path(options.transforms or "").absolute()
    path = path / "transforms.json" if path.is_dir() else path
    contents = read_transforms(path, options.images, options.masks, advice=advice)
    world = options.world_transform
    to_splat = (
        None if world is None else read_world_transform(world, contents.applied_transform, contents.applied_scale)
    )
    base = path.parent if options.images is None else options.images.absolute().parent
    return CameraFile(contents.frames, contents.held_out, path, path.parent, base, to_splat)


def _colmap(options: SplatOptions, folder: Path, advice: str) -> CameraFile:
    folder = folder.absolute()
    model = find_colmap_model(folder)
    cameras, images = read_colmap_model(model)
    registered = sorted(images, key=lambda image: image.name)  # as training tools sort them
    intrinsics = {camera_id: colmap_intrinsics(camera, model) for camera_id, camera in cameras.items()}
    images_dir = (options.images or folder / "images").absolute()
    if not images_dir.is_dir():
        raise FileNotFoundError(f"There is no image folder {images_dir}. Put it there, or {advice}.")
    names = [image.name for image in registered]
    files = find_images(names, images_dir, model, advice, allow_copies=True)
    masks: Sequence[Path | None] = [None] * len(files) if options.masks is None else find_masks(names, options.masks)
    base = folder if images_dir.is_relative_to(folder) else images_dir.parent
    frames = [
        Frame(file, relative_name(file, base), colmap_pose(image), intrinsics[image.camera_id], mask)
        for image, file, mask in zip(registered, files, masks)
    ]
    to_splat = None if options.world_transform is None else read_world_transform(options.world_transform)
    return CameraFile(frames, frozenset(), model, folder, base, to_splat)
