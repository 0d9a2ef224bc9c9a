"""Pictures of answers: the relevancy of a text as a heat map over the rendered scene."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

from jaxtyping import Float, UInt8
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from torch import Tensor

from normlift_ns.asking import Answer, pixel_relevancy
from normlift_ns.core.files import file_name, new_file, numbered
from normlift_ns.core.gaussians import Camera
from normlift_ns.core.scene import Scene
from normlift_ns.errors import InputError
from normlift_ns.observing import spread
from normlift_ns.raster.rasterize import render, render_picture
from normlift_ns.raster.settings import RasterSettings

_INCHES, _DPI = 6.0, 120


def save_overlays(
    scene: Scene,
    answer: Answer,
    cameras: dict[str, Camera],
    folder: Path,
    *,
    settings: RasterSettings | None = None,
    overwrite: bool = False,
) -> list[Path]:
    """Writes one PNG per camera and text: the rendered scene, and where the text is found on it.

    Args:
        cameras: by the name that the files get.
        settings: constants of the rasterizer; those of gsplat 1.4 by default.
        overwrite: replace files of these names.
    Raises:
        FileExistsError: there is one, and `overwrite` is False.
        OSError: it cannot be written.
        ValueError: two pictures would have the same name.
    """
    names = [[f"{name}_{q}_{file_name(text)}.png" for q, text in enumerate(answer.texts)] for name in cameras]
    twice = [name for name, count in Counter(x for some in names for x in some).items() if count > 1]
    if len(twice) > 0:
        raise InputError(f"two pictures would be called {folder / twice[0]}; render one of their views at a time")
    paths = []
    for camera, files in zip(cameras.values(), names):
        mode = scene.rasterize_mode
        values, alpha = render(scene.gaussians, camera, answer.relevancy, rasterize_mode=mode, settings=settings)
        relevancy = pixel_relevancy(values, alpha)
        image = render_picture(scene, camera, settings=settings)
        for q, text in enumerate(answer.texts):
            paths.append(folder / files[q])
            with new_file(paths[-1], overwrite=overwrite) as draft:
                save_overlay(draft, image, relevancy[:, :, q], text, answer)
    return paths


def save_overlay(
    path: Path, image: UInt8[Tensor, "h w 3"], relevancy: Float[Tensor, "h w"], text: str, answer: Answer
) -> None:
    """A heat map over the image in grey, the more opaque the more relevant, with the text and a colour scale."""
    height, width = relevancy.shape
    question = answer.question
    low = {"cosine": 0.0, "lerf": 0.0, "margin": -0.1}[question.rule]
    high = max(float(relevancy.max()), question.threshold + 0.05)
    figure = Figure(figsize=(_INCHES * 1.15, _INCHES * height / width + 0.5), dpi=_DPI, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    grey = image.float().mean(dim=2) / 255
    axes.imshow(grey.numpy(), cmap="gray", vmin=0, vmax=1)
    opacity = 0.85 * ((relevancy - low) / (high - low)).clamp(0, 1) ** 0.5
    heat = axes.imshow(relevancy.numpy(), cmap="inferno", vmin=low, vmax=high, alpha=opacity.numpy())
    scale = figure.colorbar(heat, ax=axes, fraction=0.05)
    scale.solids.set_alpha(1.0)  # pyright: ignore[reportOptionalMemberAccess]
    scale.ax.axhline(question.threshold, color="white", linewidth=1.5)
    scale.set_label(f"relevancy ({question.rule}); selected above {question.threshold:g}")
    line = " ".join(text.encode("utf8", "replace").decode().split())
    axes.set_title(line if len(line) < 60 else line[:57] + "…", parse_math=False)  # TeX in a text is text
    axes.set_axis_off()
    figure.savefig(path)


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
