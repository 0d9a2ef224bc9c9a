"""What the model draws of an answer: which scalars of the Gaussians, and how their pictures are coloured."""

from __future__ import annotations

import colorsys
from dataclasses import dataclass
from typing import Literal, get_args

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from normlift_ns.asking import Answer, pixel_relevancy
from normlift_ns.core.field import SemanticField

Colormap = Literal["turbo", "viridis", "magma", "inferno", "cividis"]
Part = Literal["everything", "without the selection", "the selection alone"]
COLORMAPS: tuple[Colormap, ...] = get_args(Colormap)
PARTS: tuple[Part, ...] = get_args(Part)
_LEAST_SPAN = 0.05
_OPACITY = 0.8


@dataclass(frozen=True)
class Display:
    """What is drawn besides the colours. Never changed, only replaced: the viewer renders in other threads.

    Q is the number of prompts; without any, nothing is selected.
    """

    values: Float[Tensor, "n q_plus_5"]
    """Relevancy of each prompt, relevancy shown in the overlay, selected (0 or 1), selected by any prompt (0 or 1), R,
    N_eff."""
    scale: tuple[float, float]
    """Relevancies at the two ends of the overlay's colours."""
    colors: Float[Tensor, "256 3"]
    """Of the overlay, RGB in 0..1."""
    palette: Float[Tensor, "q 3"]
    """Colours of the prompts in the segmentation, RGB in 0..1."""
    drawn: Bool[Tensor, " n"] | None = None
    """Gaussians that are drawn at all; None: all."""

    @property
    def num_prompts(self) -> int:
        """Q."""
        return len(self.palette)


def make_display(
    field: SemanticField,
    answer: Answer | None = None,
    *,
    shown: int | None = None,
    colormap: Colormap = "turbo",
    part: Part = "everything",
) -> Display:
    """Draws an answer, on the field's device.

    Args:
        shown: the prompt whose relevancy is in the overlay and whose selection counts; None: all of them together.
        part: what of the scene is drawn.
    """
    scalars = field.scalars
    nothing = torch.zeros_like(scalars.reliability)
    relevancy = nothing[:, None][:, :0] if answer is None else answer.relevancy
    chosen = selection(answer, shown)
    chosen = nothing.bool() if chosen is None else chosen
    count, scale, shown_relevancy, any_chosen = relevancy.shape[1], (0.0, 1.0), nothing, nothing
    if answer is not None and count > 0:
        shown_relevancy = relevancy.amax(dim=1) if shown is None else relevancy[:, shown]
        any_chosen = answer.selected.any(dim=1)
        scale = color_scale(shown_relevancy[answer.valid], answer.question.threshold)
    columns = (shown_relevancy, chosen, any_chosen, scalars.reliability, scalars.n_eff)
    values = torch.cat([relevancy.float(), torch.stack([c.float() for c in columns], dim=1)], dim=1)
    drawn = {"everything": None, "without the selection": ~chosen, "the selection alone": chosen}[part]
    return Display(values, scale, colors_of(colormap).to(values), palette(count).to(values), drawn)


def selection(answer: Answer | None, shown: int | None) -> Bool[Tensor, " n"] | None:
    """The Gaussians selected by the prompt shown, or by any where `shown` is None; None without an answer."""
    if answer is None:
        return None
    return answer.selected.any(dim=1) if shown is None else answer.selected[:, shown]


def color_scale(relevancy: Float[Tensor, " m"], threshold: float) -> tuple[float, float]:
    """From the threshold to the largest relevancy in the scene; never narrower than 0.05."""
    peak = float(relevancy.max()) if len(relevancy) > 0 else threshold
    return threshold, max(peak, threshold + _LEAST_SPAN)


def colors_of(colormap: Colormap) -> Float[Tensor, "256 3"]:
    """RGB in 0..1 of matplotlib's colour map."""
    from matplotlib import colormaps  # noqa: PLC0415 (a lift does without)

    return torch.from_numpy(colormaps[colormap](torch.arange(256).numpy())[:, :3]).float()


def palette(count: int) -> Float[Tensor, "count 3"]:
    """Colours that tell prompts apart: hues a golden section of the circle apart, RGB in 0..1."""
    rows = [colorsys.hsv_to_rgb((i * 0.618034) % 1, 0.85 if i % 2 == 0 else 0.65, 0.95) for i in range(count)]
    return torch.tensor(rows).reshape(count, 3)


def draw(
    display: Display, rgb: Float[Tensor, "h w 3"], image: Float[Tensor, "h w c"], alpha: Float[Tensor, "h w"]
) -> dict[str, Tensor]:
    """The semantic outputs of one picture, each [H, W, 1] or [H, W, 3], the overlay last.

    Scalars are sum_j A_ij value_j, 0 where nothing is. Overlay and segmentation are in colours of their own, over the
    scene in grey.

    Args:
        rgb: the picture of the scene, 0..1.
        image: `display.values`, composited.
        alpha: opacity of every pixel.
    """
    count = display.num_prompts
    pixel = pixel_relevancy(image[:, :, : count + 1], alpha)
    _, chosen, any_chosen, reliability, n_eff = image[:, :, count:].split(1, dim=2)
    heat = overlay(rgb, pixel[:, :, count], chosen, display.colors, display.scale)
    classes = segmentation(rgb, pixel[:, :, :count].argmax(dim=2), any_chosen, display.palette) if count > 0 else None
    return {
        **{f"relevancy_{i}": image[:, :, i : i + 1] for i in range(count)},
        "reliability": reliability,
        "n_eff": n_eff,
        "selection": chosen,
        "segmentation": _grey(rgb) if classes is None else classes,
        "overlay": heat,
    }


def overlay(
    rgb: Float[Tensor, "h w 3"],
    relevancy: Float[Tensor, "h w"],
    share: Float[Tensor, "h w 1"],
    colors: Float[Tensor, "256 3"],
    scale: tuple[float, float],
) -> Float[Tensor, "h w 3"]:
    """The scene in grey, coloured by relevancy where it is selected.

    Args:
        share: how much of a pixel is selected, 0..1.
        scale: relevancies of the first and the last colour.
    """
    step = ((relevancy - scale[0]) / (scale[1] - scale[0])).clamp(0, 1)
    return _over_grey(rgb, colors[(step * 255).round().long()], share)


def segmentation(
    rgb: Float[Tensor, "h w 3"],
    labels: Int[Tensor, "h w"],
    share: Float[Tensor, "h w 1"],
    palette: Float[Tensor, "q 3"],
) -> Float[Tensor, "h w 3"]:
    """The scene in grey, with the colour of the most relevant prompt where any prompt selects something."""
    return _over_grey(rgb, palette[labels], share)


def _over_grey(rgb: Tensor, color: Tensor, share: Tensor) -> Tensor:
    opacity = _OPACITY * share.clamp(0, 1)
    return (1 - opacity) * _grey(rgb) + opacity * color


def _grey(rgb: Tensor) -> Tensor:
    return rgb.mean(dim=2, keepdim=True).expand_as(rgb)
