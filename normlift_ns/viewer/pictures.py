"""Figures of answers: training images next to renders of the answer, in the colors of the viewers, and masks."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

import torch
from jaxtyping import Bool, UInt8
from PIL import Image
from torch import Tensor

from normlift_ns.asking import Answer, pixel_relevancy
from normlift_ns.colors import COLORMAPS
from normlift_ns.core.files import file_name, new_file, new_files, numbered
from normlift_ns.core.gaussians import Camera
from normlift_ns.core.scene import Scene
from normlift_ns.errors import InputError
from normlift_ns.observing import spread
from normlift_ns.raster.rasterize import render, render_picture
from normlift_ns.raster.settings import RasterSettings
from normlift_ns.viewer.display import make_display, whole_map
from normlift_ns.viewer.sheets import Found, Sheet, contact_sheet, picture_of

SHEET = "contact_sheet"
"""Beginning of the file names of contact sheets; those of other figures begin with the name of their view."""
_ZLIB_LEVEL = 4
"""PIL's default, 6, takes twice as long for files that are 6% smaller."""


def save_overlays(
    scene: Scene,
    answer: Answer,
    cameras: dict[str, Camera],
    folder: Path,
    *,
    settings: RasterSettings | None = None,
    overwrite: bool = False,
) -> list[Path]:
    """Write one PNG per camera and prompt, and for several cameras one contact sheet per prompt.

    Each figure shows the training image next to the rendered scene with the relevancy and the outline of the selection.
    All figures share one color scale.

    Args:
        cameras: training cameras by the names for the files, as from `training_cameras`.
        settings: rasterizer settings; None: those of gsplat 1.4.
        overwrite: replace existing files.
    Returns:
        Paths of the files.
    Raises:
        FileExistsError: a file exists, and `overwrite` is False.
        OSError: a file cannot be written.
        ValueError: two figures would have the same name.
    """
    files = {view: [f"{view}_{q}_{file_name(text)}.png" for q, text in enumerate(answer.texts)] for view in cameras}
    sheets = [f"{SHEET}_{q}_{file_name(text)}.png" for q, text in enumerate(answer.texts)] if len(cameras) > 1 else []
    counts = Counter([*sheets, *(name for names in files.values() for name in names)])
    duplicates = [name for name, count in counts.items() if count > 1]
    if len(duplicates) > 0:
        raise InputError(f"two figures would have the name {folder / duplicates[0]}; render their views one at a time")
    headers = [Found.of(finding) for finding in answer]
    sheet = Sheet(COLORMAPS[0], make_display(answer.field, answer).whole, answer.question.threshold)
    paths, overlays = [], [[] for _ in answer.texts]
    for view, camera in cameras.items():
        image = _training_image(scene, view)
        for q, overlay in enumerate(_overlays(scene, answer, camera, settings)):
            overlays[q].append((view, *overlay))
            paths.append(folder / files[view][q])
            with new_file(paths[-1], overwrite=overwrite) as draft:
                picture_of(sheet, headers[q], view, image, *overlay).save(draft, "PNG", compress_level=_ZLIB_LEVEL)
    for q, name in enumerate(sheets):
        paths.append(folder / name)
        with new_file(paths[-1], overwrite=overwrite) as draft:
            contact_sheet(sheet, headers[q], overlays[q]).save(draft, "PNG", compress_level=_ZLIB_LEVEL)
    return paths


def _overlays(
    scene: Scene, answer: Answer, camera: Camera, settings: RasterSettings | None
) -> list[tuple[UInt8[Tensor, "h w 3"], Tensor]]:
    """Return, for each prompt, the scene in gray under its relevancy, and the mask of selected pixels [H, W]."""
    count, display = len(answer.texts), make_display(answer.field, answer)
    values = torch.cat([answer.relevancy.float(), answer.selected.float()], dim=1)
    image, alpha = render(scene.gaussians, camera, values, rasterize_mode=scene.rasterize_mode, settings=settings)
    pixel = pixel_relevancy(image, alpha)
    rgb = render_picture(scene, camera, settings=settings).float() / 255
    maps = [whole_map(display, rgb, pixel[:, :, q], alpha) for q in range(count)]
    return [((map_ * 255).round().to(torch.uint8), pixel[:, :, count + q] > 0.5) for q, map_ in enumerate(maps)]


def _training_image(scene: Scene, view: str) -> UInt8[Tensor, "h w 3"] | None:
    """Return the training image of a view, or None if it cannot be read any more."""
    names = picture_names(list(scene.train.names))
    try:
        return scene.train[names.index(view)].image
    except (FileNotFoundError, InputError):
        return None


def training_cameras(scene: Scene, names: Sequence[str] = ()) -> dict[str, Camera]:
    """Return training cameras by the names for their files.

    Args:
        names: names as from `picture_names`, or image paths with or without suffix; empty: three evenly spaced views.
    Raises:
        ValueError: a name matches no training image, or several.
    """
    images, cameras = list(scene.train.names), scene.train.cameras
    unique = picture_names(images)
    if len(names) == 0:
        return {unique[i]: cameras[i] for i in spread(len(images), 3)}
    selected = {}
    for name in names:
        matches = [i for i, image in enumerate(images) if name in (unique[i], image, _without_suffix(image))]
        matches = matches or [i for i, image in enumerate(images) if PurePosixPath(image).stem == name]
        if len(matches) == 0:
            raise InputError(
                f"--render-views: there is no training image {name!r}. Expected one of {len(images)} names from "
                f"{unique[0]!r} to {unique[-1]!r}, without suffix; other images are held out for evaluation."
            )
        if len(matches) > 1:
            raise InputError(
                f"--render-views: {len(matches)} training images match {name!r}; choose one of: "
                f"{', '.join(unique[i] for i in matches)}"
            )
        selected[unique[matches[0]]] = cameras[matches[0]]
    return selected


def write_masks(
    scene: Scene,
    selected: Bool[Tensor, " n"],
    folder: Path,
    *,
    rest: bool = False,
    settings: RasterSettings | None = None,
    overwrite: bool = False,
) -> list[Path]:
    """Write one PNG per training image, of its size: 255 for pixels that show the selection, else 0.

    Either all files are written or none. Objects in front of the selection occlude it. The masks fit images without
    lens distortion, on which the scene was trained.

    Args:
        rest: invert the masks: 255 for pixels that show anything else, or nothing.
        settings: rasterizer settings; None: those of gsplat 1.4.
        overwrite: replace existing files.
    Returns:
        Paths of the files.
    Raises:
        FileExistsError: a file exists, and `overwrite` is False.
        OSError: a file cannot be written.
    """
    files = mask_files(scene, folder)
    with new_files(*files, overwrite=overwrite) as drafts:
        for camera, draft in zip(scene.train.cameras, drafts):
            mask = view_mask(scene, camera, selected, settings=settings) != rest
            Image.fromarray((mask.to(torch.uint8) * 255).cpu().numpy()).save(draft, "PNG")
    return files


def mask_files(scene: Scene, folder: Path) -> list[Path]:
    """Return the paths of the masks of a scene's training images."""
    return [folder / f"{name}.png" for name in picture_names(list(scene.train.names))]


def view_mask(
    scene: Scene, camera: Camera, selected: Bool[Tensor, " n"], *, settings: RasterSettings | None = None
) -> Bool[Tensor, "h w"]:
    """Return the mask of pixels in which the selection makes up more than half of the opacity."""
    values = selected.to(scene.gaussians.means)[:, None]
    image, alpha = render(scene.gaussians, camera, values, rasterize_mode=scene.rasterize_mode, settings=settings)
    return pixel_relevancy(image, alpha)[:, :, 0] > 0.5


def picture_names(images: Sequence[str]) -> list[str]:
    """Return a unique file name for each image: its stem, or its path in the dataset if several share the stem.

    >>> picture_names(["a/0.png", "b/0.png", "b/1.png", "c/2.png", "c/2.jpg"])
    ['a_0', 'b_0', '1', 'c_2.png', 'c_2.jpg']
    """
    names = [PurePosixPath(image).stem for image in images]
    for longer in (_without_suffix, str):
        counts = Counter(map(str.casefold, names))
        duplicate = [counts[name.casefold()] > 1 for name in names]
        names = [longer(image).replace("/", "_") if x else name for image, name, x in zip(images, names, duplicate)]
    taken: set[str] = set()
    return [_unique_name(name, taken) for name in names]


def _unique_name(name: str, taken: set[str]) -> str:
    """Return the first of the `numbered` names that is not taken, and add it to the taken ones."""
    unique = next(path.name for path in numbered(Path(name)) if path.name.casefold() not in taken)
    taken.add(unique.casefold())
    return unique


def _without_suffix(image: str) -> str:
    return str(PurePosixPath(image).with_suffix(""))
