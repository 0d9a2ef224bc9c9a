"""Pictures of answers: the photograph, and beside it what a text finds, in the colours of the viewers."""

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
"""What contact sheets are called, where other pictures have the name of their view."""
_ZLIB_LEVEL = 4
"""PIL's own, 6, takes twice as long for files that are 6% smaller."""


def save_overlays(
    scene: Scene,
    answer: Answer,
    cameras: dict[str, Camera],
    folder: Path,
    *,
    settings: RasterSettings | None = None,
    overwrite: bool = False,
) -> list[Path]:
    """Writes one PNG per camera and text, and, of several cameras, one contact sheet per text.

    Each shows the photograph, and the rendered scene with the relevancy and the outline of what is selected. Colours
    mean the same in all of them.

    Args:
        cameras: training cameras by the name that the files get, as `training_cameras` has them.
        settings: constants of the rasterizer; those of gsplat 1.4 by default.
        overwrite: replace files of these names.
    Raises:
        FileExistsError: there is one, and `overwrite` is False.
        OSError: it cannot be written.
        ValueError: two pictures would have the same name.
    """
    files = {view: [f"{view}_{q}_{file_name(text)}.png" for q, text in enumerate(answer.texts)] for view in cameras}
    sheets = [f"{SHEET}_{q}_{file_name(text)}.png" for q, text in enumerate(answer.texts)] if len(cameras) > 1 else []
    counts = Counter([*sheets, *(name for names in files.values() for name in names)])
    twice = [name for name, count in counts.items() if count > 1]
    if len(twice) > 0:
        raise InputError(f"two pictures would be called {folder / twice[0]}; render one of their views at a time")
    found = [Found.of(finding) for finding in answer]
    sheet = Sheet(COLORMAPS[0], make_display(answer.field, answer).whole, answer.question.threshold)
    paths, overlays = [], [[] for _ in answer.texts]
    for view, camera in cameras.items():
        photograph = _photograph(scene, view)
        for q, overlay in enumerate(_overlays(scene, answer, camera, settings)):
            overlays[q].append((view, *overlay))
            paths.append(folder / files[view][q])
            with new_file(paths[-1], overwrite=overwrite) as draft:
                picture_of(sheet, found[q], view, photograph, *overlay).save(draft, "PNG", compress_level=_ZLIB_LEVEL)
    for q, name in enumerate(sheets):
        paths.append(folder / name)
        with new_file(paths[-1], overwrite=overwrite) as draft:
            contact_sheet(sheet, found[q], overlays[q]).save(draft, "PNG", compress_level=_ZLIB_LEVEL)
    return paths


def _overlays(
    scene: Scene, answer: Answer, camera: Camera, settings: RasterSettings | None
) -> list[tuple[UInt8[Tensor, "h w 3"], Tensor]]:
    """For each text, the scene in grey under its relevancy, and which pixels [H, W] are selected."""
    count, display = len(answer.texts), make_display(answer.field, answer)
    values = torch.cat([answer.relevancy.float(), answer.selected.float()], dim=1)
    image, alpha = render(scene.gaussians, camera, values, rasterize_mode=scene.rasterize_mode, settings=settings)
    pixel = pixel_relevancy(image, alpha)
    rgb = render_picture(scene, camera, settings=settings).float() / 255
    maps = [whole_map(display, rgb, pixel[:, :, q], alpha) for q in range(count)]
    return [((map_ * 255).round().to(torch.uint8), pixel[:, :, count + q] > 0.5) for q, map_ in enumerate(maps)]


def _photograph(scene: Scene, view: str) -> UInt8[Tensor, "h w 3"] | None:
    """The training photograph that pictures of this name are of; None: it is not there any more."""
    names = picture_names(list(scene.train.names))
    try:
        return scene.train[names.index(view)].image
    except (FileNotFoundError, InputError):
        return None


def training_cameras(scene: Scene, names: Sequence[str] = ()) -> dict[str, Camera]:
    """Training cameras by what files of their pictures are called: those named, or three of them, evenly spread.

    Args:
        names: as `picture_names` has them, or the images themselves, with or without suffix.
    Raises:
        ValueError: no training image of that name, or several.
    """
    images, cameras = list(scene.train.names), scene.train.cameras
    called = picture_names(images)
    if len(names) == 0:
        return {called[i]: cameras[i] for i in spread(len(images), 3)}
    chosen = {}
    for name in names:
        found = [i for i, image in enumerate(images) if name in (called[i], image, _without_suffix(image))]
        found = found or [i for i, image in enumerate(images) if PurePosixPath(image).stem == name]
        if len(found) == 0:
            raise InputError(
                f"--render-views: there is no training image {name!r}; there are {len(images)}, from {called[0]!r} to "
                f"{called[-1]!r} (names without suffix; others are held out for evaluation)"
            )
        if len(found) > 1:
            raise InputError(
                f"--render-views: {len(found)} training images are called {name!r}; say which one: "
                f"{', '.join(called[i] for i in found)}"
            )
        chosen[called[found[0]]] = cameras[found[0]]
    return chosen


def write_masks(
    scene: Scene,
    selected: Bool[Tensor, " n"],
    folder: Path,
    *,
    rest: bool = False,
    settings: RasterSettings | None = None,
    overwrite: bool = False,
) -> list[Path]:
    """Writes one PNG per training photograph, of its size, all or none: 255 where it shows the selection, else 0.

    What stands before the selection hides it. Lens distortion is taken out of the photographs, as the scene was trained
    on them.

    Args:
        rest: 255 where the photograph shows anything else, or nothing.
        settings: constants of the rasterizer; those of gsplat 1.4 by default.
        overwrite: replace files of these names.
    Raises:
        FileExistsError: there is one, and `overwrite` is False.
        OSError: it cannot be written.
    """
    files = mask_files(scene, folder)
    with new_files(*files, overwrite=overwrite) as drafts:
        for camera, draft in zip(scene.train.cameras, drafts):
            shown = view_mask(scene, camera, selected, settings=settings) != rest
            Image.fromarray((shown.to(torch.uint8) * 255).cpu().numpy()).save(draft, "PNG")
    return files


def mask_files(scene: Scene, folder: Path) -> list[Path]:
    """The files of the masks of a scene's training photographs."""
    return [folder / f"{name}.png" for name in picture_names(list(scene.train.names))]


def view_mask(
    scene: Scene, camera: Camera, selected: Bool[Tensor, " n"], *, settings: RasterSettings | None = None
) -> Bool[Tensor, "h w"]:
    """Pixels that are made of the selection for more than half."""
    values = selected.to(scene.gaussians.means)[:, None]
    image, alpha = render(scene.gaussians, camera, values, rasterize_mode=scene.rasterize_mode, settings=settings)
    return pixel_relevancy(image, alpha)[:, :, 0] > 0.5


def picture_names(images: Sequence[str]) -> list[str]:
    """A different name of a file for every image: its stem, or, where several have the same, its path in the dataset.

    >>> picture_names(["a/0.png", "b/0.png", "b/1.png", "c/2.png", "c/2.jpg"])
    ['a_0', 'b_0', '1', 'c_2.png', 'c_2.jpg']
    """
    names = [PurePosixPath(image).stem for image in images]
    for longer in (_without_suffix, str):
        counts = Counter(map(str.casefold, names))
        again = [counts[name.casefold()] > 1 for name in names]
        names = [longer(image).replace("/", "_") if x else name for image, name, x in zip(images, names, again)]
    taken: set[str] = set()
    return [_new(name, taken) for name in names]


def _new(name: str, taken: set[str]) -> str:
    """The first of `numbered` names that is not taken, and is from now on."""
    found = next(path.name for path in numbered(Path(name)) if path.name.casefold() not in taken)
    taken.add(found.casefold())
    return found


def _without_suffix(image: str) -> str:
    return str(PurePosixPath(image).with_suffix(""))
