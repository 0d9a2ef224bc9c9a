"""Pictures of answers: the relevancy of a text as a heat map over the rendered scene."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from jaxtyping import Float, UInt8
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from torch import Tensor

from normlift_ns.asking import Answer, pixel_relevancy
from normlift_ns.core.files import file_name, new_file
from normlift_ns.core.gaussians import Camera
from normlift_ns.core.scene import Scene
from normlift_ns.errors import InputError
from normlift_ns.observing import spread
from normlift_ns.raster.rasterize import render, render_picture

_INCHES, _DPI = 6.0, 120


def save_overlays(
    scene: Scene, answer: Answer, cameras: dict[str, Camera], folder: Path, *, overwrite: bool = False
) -> list[Path]:
    """Writes one PNG per camera and text: the rendered scene, and where the text is found on it.

    Args:
        cameras: by the name that the files get.
        overwrite: replace files of these names.
    Raises:
        FileExistsError: there is one, and `overwrite` is False.
        OSError: it cannot be written.
    """
    paths = []
    for name, camera in cameras.items():
        values, alpha = render(scene.gaussians, camera, answer.relevancy, rasterize_mode=scene.rasterize_mode)
        relevancy = pixel_relevancy(values, alpha)
        image = render_picture(scene, camera)
        for q, text in enumerate(answer.texts):
            paths.append(folder / f"{name}_{q}_{file_name(text)}.png")
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
    axes.set_title(text if len(text) < 60 else text[:57] + "…")
    axes.set_axis_off()
    figure.savefig(path)


def training_cameras(scene: Scene, names: Sequence[str] = ()) -> dict[str, Camera]:
    """Training cameras by the stems of their images: those named, or three of them, evenly spread.

    Raises:
        ValueError: no training image of that name.
    """
    cameras = {Path(name).stem: camera for name, camera in zip(scene.train.names, scene.train.cameras)}
    stems = list(cameras)
    unknown = [name for name in names if name not in cameras]
    if len(unknown) > 0:
        raise InputError(
            f"--render-views: there is no training image {unknown[0]!r}; there are {len(stems)}, from {stems[0]!r} to "
            f"{stems[-1]!r} (names without suffix; others are held out for evaluation)"
        )
    return {name: cameras[name] for name in names or (stems[i] for i in spread(len(stems), 3))}
