"""Rendered outputs of an answer: which scalars of the Gaussians are rendered, and how their images are colored."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from normlift_ns.asking import Answer, pixel_relevancy
from normlift_ns.colors import COLORMAPS, OPAQUE, RELIABILITY_COLORS, Colormap, colors_of, heat, prompt_colors
from normlift_ns.core.field import SemanticField
from normlift_ns.core.files import file_name, numbered
from normlift_ns.options import RULES
from normlift_ns.viewer.legend import with_bar, with_prompts

_MIN_SPAN = 0.05
"""Smallest difference between the relevancies at the ends of a color scale."""
SEGMENTED = 0.8
"""Opacity of the prompt colors over the scene."""
BY_HAND = prompt_colors([""])[0]
"""RGB of Gaussians selected by clicks without a query."""


@dataclass(frozen=True)
class Display:
    """Scalars that are rendered in addition to the colors, and their color scales.

    Immutable, because the viewer renders in other threads. Q is the number of prompts; without prompts, nothing is
    selected.
    """

    values: Float[Tensor, "n q_plus_5"]
    """Columns: relevancy of each prompt, relevancy shown in the overlay, selected (0 or 1), selected by any prompt
    (0 or 1), R, N_eff."""
    scale: tuple[float, float]
    """Relevancies at the two ends of the overlay's colors."""
    whole: tuple[float, float]
    """Relevancies at the two ends of the colors in maps of the whole scene."""
    colormap: Colormap
    """Colormap of the overlay."""
    texts: tuple[str, ...]
    """The prompts."""
    palette: Float[Tensor, "q 3"]
    """Colors of the prompts in the segmentation, RGB in 0..1."""
    shown: int | None = None
    """Index of the prompt in the overlay; None: the most relevant of all prompts."""
    drawn: Bool[Tensor, " n"] | None = None
    """Gaussians that are drawn at all; None: all."""
    by_hand: bool = False
    """Whether the selection was made by hand, in which case the overlay has a single color."""

    @property
    def num_prompts(self) -> int:
        """Number of prompts, Q."""
        return len(self.palette)

    @property
    def title(self) -> str:
        """Title of the overlay's color bar."""
        index = self.shown if self.num_prompts > 1 else 0
        return "relevancy, all prompts" if index is None else f"relevancy: {self.texts[index]}"


def make_display(
    field: SemanticField,
    answer: Answer | None = None,
    *,
    shown: int | None = None,
    colormap: Colormap = COLORMAPS[0],
    chosen: Bool[Tensor, " n"] | None = None,
    drawn: Bool[Tensor, " n"] | None = None,
    by_hand: bool = False,
) -> Display:
    """Make the display of an answer, on the field's device.

    Args:
        shown: index of the prompt whose relevancy is in the overlay and whose selection counts; None: all prompts.
        chosen: mask of the selection; None: the selection of the answer.
        drawn: mask of the Gaussians that are drawn at all; None: all.
        by_hand: whether `chosen` is independent of the answer.
    """
    scalars = field.scalars
    zeros = torch.zeros_like(scalars.reliability)
    relevancy = zeros[:, None][:, :0] if answer is None else answer.relevancy
    explicit, selected = chosen is not None, selection(answer, shown) if chosen is None else chosen
    selected = zeros.bool() if selected is None else selected
    count, shown_relevancy, selected_by_any = relevancy.shape[1], zeros, zeros
    scale = whole = (0.0, 1.0)
    if answer is not None and count > 0:
        shown_relevancy = relevancy.amax(dim=1) if shown is None else relevancy[:, shown]
        selected_by_any = selected if explicit else answer.selected.any(dim=1)
        scale, whole = color_scale(shown_relevancy[answer.valid], answer.question.threshold), whole_scale(answer)
    columns = (shown_relevancy, selected, selected_by_any, scalars.reliability, scalars.n_eff)
    values = torch.cat([relevancy.float(), torch.stack([c.float() for c in columns], dim=1)], dim=1)
    texts = () if answer is None else answer.texts
    return Display(values, scale, whole, colormap, texts, prompt_colors(texts).to(values), shown, drawn, by_hand)


def selection(answer: Answer | None, shown: int | None) -> Bool[Tensor, " n"] | None:
    """Return the mask of Gaussians selected by prompt `shown` (None: by any prompt); None without an answer."""
    if answer is None:
        return None
    return answer.selected.any(dim=1) if shown is None else answer.selected[:, shown]


def color_scale(relevancy: Float[Tensor, " m"], threshold: float) -> tuple[float, float]:
    """Return a scale from the threshold to the largest relevancy in the scene, at least 0.05 wide."""
    peak = float(relevancy.max()) if len(relevancy) > 0 else threshold
    return threshold, max(peak, threshold + _MIN_SPAN)


def whole_scale(answer: Answer) -> tuple[float, float]:
    """Return the scale of all maps: from the rule's faintest colored relevancy to the largest of any prompt."""
    peak = color_scale(answer.relevancy[answer.valid].flatten(), answer.question.threshold)[1]
    low = RULES[answer.question.rule].faintest
    return low, max(peak, low + _MIN_SPAN)


def output_names(texts: tuple[str, ...]) -> list[str]:
    """Return the name of each prompt's output in a viewer. They are valid file names, since ns-render writes files.

    >>> output_names(("sky blue", "sky/blue", "fox"))
    ['relevancy_sky_blue', 'relevancy_sky_blue_2', 'relevancy_fox']
    """
    names: list[str] = []
    for text in texts:
        name = f"relevancy_{file_name(text)}"
        names.append(next(path.name for path in numbered(Path(name)) if path.name not in names))
    return names


def draw(
    display: Display,
    rgb: Float[Tensor, "h w 3"],
    image: Float[Tensor, "h w c"],
    alpha: Float[Tensor, "h w"],
    *,
    by_text: bool = False,
) -> dict[str, Tensor]:
    """Return the semantic outputs of one image, each [H, W, 1] or [H, W, 3], the overlay last.

    Overlay, segmentation and reliability are finished images with legends: the scene in gray under colors of fixed
    scales. The other outputs are scalars sum_j A_ij value_j, 0 for empty pixels.

    Args:
        rgb: rendered scene, 0..1.
        image: composited `display.values`.
        alpha: opacity of every pixel.
        by_text: return relevancies as finished images with the names of `output_names`, for a viewer. Otherwise they
            are scalars named relevancy_0, relevancy_1, …
    """
    count, colors = display.num_prompts, colors_of(display.colormap).to(rgb)
    pixel = pixel_relevancy(image[:, :, : count + 1], alpha)
    _, selected, selected_by_any, reliability, n_eff = image[:, :, count:].split(1, dim=2)
    opacity = SEGMENTED * selected.clamp(0, 1).sqrt()  # makes faint selections visible, such as floaters
    overlaid, segmented = _over_gray(rgb, BY_HAND.to(rgb), opacity), _gray(rgb)
    outputs = {f"relevancy_{i}": image[:, :, i : i + 1] for i in range(count)}
    if count > 0:
        segmented = segmentation(rgb, pixel[:, :, :count].argmax(dim=2), selected_by_any, display.palette)
        segmented = with_prompts(segmented, display.texts, display.palette)
    if count > 0 and not display.by_hand:
        overlaid = overlay(rgb, pixel[:, :, count], selected, colors, display.scale)
        overlaid = with_bar(overlaid, display.colormap, display.scale, display.title)
    if by_text:
        outputs = {
            name: with_bar(whole_map(display, rgb, pixel[:, :, i], alpha), display.colormap, display.whole, text)
            for i, (name, text) in enumerate(zip(output_names(display.texts), display.texts))
        }
    return {
        **outputs,
        "reliability": reliability_picture(rgb, reliability, alpha),
        "reliability_value": reliability,
        "n_eff": n_eff,
        "selection": selected,
        "segmentation": segmented,
        "overlay": overlaid,
    }


def overlay(
    rgb: Float[Tensor, "h w 3"],
    relevancy: Float[Tensor, "h w"],
    share: Float[Tensor, "h w 1"],
    colors: Float[Tensor, "256 3"],
    scale: tuple[float, float],
) -> Float[Tensor, "h w 3"]:
    """Return the scene in gray, with the selection colored by relevancy and more opaque for higher relevancies.

    Args:
        share: selected fraction of each pixel, 0..1.
        scale: relevancies of the first and the last color.
    """
    color, opacity = heat(relevancy, scale, colors)
    return _over_gray(rgb, color, share.clamp(0, 1) * opacity[:, :, None])


def whole_map(
    display: Display, rgb: Float[Tensor, "h w 3"], relevancy: Float[Tensor, "h w"], alpha: Float[Tensor, "h w"]
) -> Float[Tensor, "h w 3"]:
    """Return the scene in gray, colored by relevancy everywhere, from transparent to opaque."""
    color, opacity = heat(relevancy, display.whole, colors_of(display.colormap).to(rgb), faint=0.0)
    return _over_gray(rgb, color, (alpha.clamp(0, 1) * opacity)[:, :, None])


def segmentation(
    rgb: Float[Tensor, "h w 3"],
    labels: Int[Tensor, "h w"],
    share: Float[Tensor, "h w 1"],
    palette: Float[Tensor, "q 3"],
) -> Float[Tensor, "h w 3"]:
    """Return the scene in gray, with the selection in the color of the most relevant prompt.

    Args:
        labels: index of the most relevant prompt of each pixel.
        share: selected fraction of each pixel, 0..1.
        palette: colors of the prompts, RGB in 0..1.
    """
    return _over_gray(rgb, palette[labels], SEGMENTED * share.clamp(0, 1))


def reliability_picture(
    rgb: Float[Tensor, "h w 3"], reliability: Float[Tensor, "h w 1"], alpha: Float[Tensor, "h w"]
) -> Float[Tensor, "h w 3"]:
    """Return a map of R on a fixed scale from 0 to 1, with its legend.

    Args:
        reliability: composited R.
    """
    pixel = pixel_relevancy(reliability, alpha)[:, :, 0]
    color = colors_of(RELIABILITY_COLORS).to(rgb)[(pixel.clamp(0, 1) * 255).round().long()]
    image = _over_gray(rgb, color, OPAQUE * alpha.clamp(0, 1)[:, :, None])
    return with_bar(image, RELIABILITY_COLORS, (0.0, 1.0), "reliability R (high is good)")


def _over_gray(rgb: Tensor, color: Tensor, opacity: Tensor) -> Tensor:
    return (1 - opacity) * _gray(rgb) + opacity * color


def _gray(rgb: Tensor) -> Tensor:
    return rgb.mean(dim=2, keepdim=True).expand_as(rgb)
