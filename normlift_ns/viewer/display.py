"""What the model draws of an answer: which scalars of the Gaussians, and how their pictures are coloured."""

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

_LEAST_SPAN = 0.05
SEGMENTED = 0.8
"""Opacity over the scene of the colours of prompts."""
BY_HAND = prompt_colors([""])[0]
"""RGB of what is selected by clicks, where nothing is asked."""


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
    whole: tuple[float, float]
    """The same where what is not selected has a colour too."""
    colormap: Colormap
    """Of the overlay."""
    texts: tuple[str, ...]
    """The prompts."""
    palette: Float[Tensor, "q 3"]
    """Colours of the prompts in the segmentation, RGB in 0..1."""
    shown: int | None = None
    """The prompt in the overlay; None: the best of all of them."""
    drawn: Bool[Tensor, " n"] | None = None
    """Gaussians that are drawn at all; None: all."""
    by_hand: bool = False
    """Whether the selection is not of the prompts, so that the overlay has one colour."""

    @property
    def num_prompts(self) -> int:
        """Q."""
        return len(self.palette)

    @property
    def title(self) -> str:
        """What the colours of the overlay say."""
        one = self.shown if self.num_prompts > 1 else 0
        return "relevancy, all prompts" if one is None else f"relevancy: {self.texts[one]}"


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
    """Draws an answer, on the field's device.

    Args:
        shown: the prompt whose relevancy is in the overlay and whose selection counts; None: all of them together.
        chosen: what is selected; None: what the answer selects.
        drawn: Gaussians that are drawn at all; None: all.
        by_hand: whether `chosen` is not of the answer.
    """
    scalars = field.scalars
    nothing = torch.zeros_like(scalars.reliability)
    relevancy = nothing[:, None][:, :0] if answer is None else answer.relevancy
    given, chosen = chosen is not None, selection(answer, shown) if chosen is None else chosen
    chosen = nothing.bool() if chosen is None else chosen
    count, shown_relevancy, any_chosen = relevancy.shape[1], nothing, nothing
    scale = whole = (0.0, 1.0)
    if answer is not None and count > 0:
        shown_relevancy = relevancy.amax(dim=1) if shown is None else relevancy[:, shown]
        any_chosen = chosen if given else answer.selected.any(dim=1)
        scale, whole = color_scale(shown_relevancy[answer.valid], answer.question.threshold), whole_scale(answer)
    columns = (shown_relevancy, chosen, any_chosen, scalars.reliability, scalars.n_eff)
    values = torch.cat([relevancy.float(), torch.stack([c.float() for c in columns], dim=1)], dim=1)
    texts = () if answer is None else answer.texts
    return Display(values, scale, whole, colormap, texts, prompt_colors(texts).to(values), shown, drawn, by_hand)


def selection(answer: Answer | None, shown: int | None) -> Bool[Tensor, " n"] | None:
    """The Gaussians selected by the prompt shown, or by any where `shown` is None; None without an answer."""
    if answer is None:
        return None
    return answer.selected.any(dim=1) if shown is None else answer.selected[:, shown]


def color_scale(relevancy: Float[Tensor, " m"], threshold: float) -> tuple[float, float]:
    """From the threshold to the largest relevancy in the scene; never narrower than 0.05."""
    peak = float(relevancy.max()) if len(relevancy) > 0 else threshold
    return threshold, max(peak, threshold + _LEAST_SPAN)


def whole_scale(answer: Answer) -> tuple[float, float]:
    """From the least relevancy worth a colour to the largest of any prompt in the scene, the same for all pictures."""
    peak = color_scale(answer.relevancy[answer.valid].flatten(), answer.question.threshold)[1]
    low = RULES[answer.question.rule].faintest
    return low, max(peak, low + _LEAST_SPAN)


def output_names(texts: tuple[str, ...]) -> list[str]:
    """What the picture of each prompt is called in a viewer; names of files, as ns-render makes some of them.

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
    """The semantic outputs of one picture, each [H, W, 1] or [H, W, 3], the overlay last.

    Overlay, segmentation and reliability are finished pictures with their legends: the scene in grey, and what there is
    to see in colours of fixed scales. The others are scalars sum_j A_ij value_j, 0 where nothing is.

    Args:
        rgb: the picture of the scene, 0..1.
        image: `display.values`, composited.
        alpha: opacity of every pixel.
        by_text: relevancies too are finished pictures, called by `output_names`, as a viewer shows them; otherwise
            they are scalars and called relevancy_0, relevancy_1, …
    """
    count, colors = display.num_prompts, colors_of(display.colormap).to(rgb)
    pixel = pixel_relevancy(image[:, :, : count + 1], alpha)
    _, chosen, any_chosen, reliability, n_eff = image[:, :, count:].split(1, dim=2)
    by_hand = SEGMENTED * chosen.clamp(0, 1).sqrt()  # so that what is faint is seen, as floaters are
    heated, labelled = _over_grey(rgb, BY_HAND.to(rgb), by_hand), _grey(rgb)
    outputs = {f"relevancy_{i}": image[:, :, i : i + 1] for i in range(count)}
    if count > 0:
        labelled = segmentation(rgb, pixel[:, :, :count].argmax(dim=2), any_chosen, display.palette)
        labelled = with_prompts(labelled, display.texts, display.palette)
    if count > 0 and not display.by_hand:
        heated = overlay(rgb, pixel[:, :, count], chosen, colors, display.scale)
        heated = with_bar(heated, display.colormap, display.scale, display.title)
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
        "selection": chosen,
        "segmentation": labelled,
        "overlay": heated,
    }


def overlay(
    rgb: Float[Tensor, "h w 3"],
    relevancy: Float[Tensor, "h w"],
    share: Float[Tensor, "h w 1"],
    colors: Float[Tensor, "256 3"],
    scale: tuple[float, float],
) -> Float[Tensor, "h w 3"]:
    """The scene in grey, coloured by relevancy where it is selected, the more opaque the more relevant.

    Args:
        share: how much of a pixel is selected, 0..1.
        scale: relevancies of the first and the last colour.
    """
    color, opacity = heat(relevancy, scale, colors)
    return _over_grey(rgb, color, share.clamp(0, 1) * opacity[:, :, None])


def whole_map(
    display: Display, rgb: Float[Tensor, "h w 3"], relevancy: Float[Tensor, "h w"], alpha: Float[Tensor, "h w"]
) -> Float[Tensor, "h w 3"]:
    """The scene in grey, coloured by relevancy everywhere, from nothing to opaque."""
    color, opacity = heat(relevancy, display.whole, colors_of(display.colormap).to(rgb), faint=0.0)
    return _over_grey(rgb, color, (alpha.clamp(0, 1) * opacity)[:, :, None])


def segmentation(
    rgb: Float[Tensor, "h w 3"],
    labels: Int[Tensor, "h w"],
    share: Float[Tensor, "h w 1"],
    palette: Float[Tensor, "q 3"],
) -> Float[Tensor, "h w 3"]:
    """The scene in grey, with the colour of the most relevant prompt where any prompt selects something."""
    return _over_grey(rgb, palette[labels], SEGMENTED * share.clamp(0, 1))


def reliability_picture(
    rgb: Float[Tensor, "h w 3"], reliability: Float[Tensor, "h w 1"], alpha: Float[Tensor, "h w"]
) -> Float[Tensor, "h w 3"]:
    """R of what is seen, on a scale from 0 to 1 whatever the picture shows, with its legend.

    Args:
        reliability: composited.
    """
    seen = pixel_relevancy(reliability, alpha)[:, :, 0]
    color = colors_of(RELIABILITY_COLORS).to(rgb)[(seen.clamp(0, 1) * 255).round().long()]
    picture = _over_grey(rgb, color, OPAQUE * alpha.clamp(0, 1)[:, :, None])
    return with_bar(picture, RELIABILITY_COLORS, (0.0, 1.0), "reliability R (high is good)")


def _over_grey(rgb: Tensor, color: Tensor, opacity: Tensor) -> Tensor:
    return (1 - opacity) * _grey(rgb) + opacity * color


def _grey(rgb: Tensor) -> Tensor:
    return rgb.mean(dim=2, keepdim=True).expand_as(rgb)
