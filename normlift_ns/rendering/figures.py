"""Semantic outputs of a render, figures of answers next to training images, and masks."""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from PIL import Image, ImageDraw
from torch import Tensor

from normlift_ns.analysis.inventory import Inventory
from normlift_ns.analysis.objects import MIN_VIEW_SHARE, evidence_weights, object_color
from normlift_ns.core.device import prefetch_map
from normlift_ns.core.field import SemanticField
from normlift_ns.core.gaussians import Camera
from normlift_ns.core.relevancy import RELEVANCY_RULES
from normlift_ns.core.scene import Scene
from normlift_ns.errors import InputError
from normlift_ns.evidence_collection import sample_evenly
from normlift_ns.io.atomic import atomic_file, atomic_files, numbered_paths, safe_file_name
from normlift_ns.options import WEAK_RELIABILITY
from normlift_ns.query.engine import Answer, Finding
from normlift_ns.query.threshold import Verdict
from normlift_ns.rasterization.rasterize import render, render_image, render_with_image
from normlift_ns.rasterization.settings import RasterSettings
from normlift_ns.rendering import colors

_MIN_SPAN = 0.05
"""Minimum difference between the relevancies at the ends of a color scale."""
SEGMENTATION_OPACITY = 0.8
"""Opacity of the prompt colors over the scene."""


@dataclass(frozen=True)
class Display:
    """Scalars to render in addition to the colors, and their color scales.

    The class is immutable because the viewer renders in other threads. Q is the number of prompts, or 0 without an
    answer.
    """

    values: Float[Tensor, "n q_plus_5"]
    """Columns: relevancy of each prompt, relevancy shown in the overlay, selection in the overlay (0 or 1), selection
    in the segmentation (0 or 1), reliability R, and effective number of views N_eff."""
    scale: tuple[float, float]
    """Relevancies of the first and the last color of the overlay."""
    map_scale: tuple[float, float]
    """Relevancies of the first and the last color of relevancy maps."""
    colormap: colors.Colormap
    """Colormap of the overlay."""
    texts: tuple[str, ...]
    """The prompts."""
    palette: Float[Tensor, "q 3"]
    """Colors of the prompts in the segmentation, RGB in 0..1."""
    shown: int | None = None
    """Index of the prompt in the overlay; None for the most relevant prompt at each Gaussian."""
    drawn: Bool[Tensor, " n"] | None = None
    """Mask of the Gaussians to draw; None for all."""
    by_hand: bool = False
    """True if the selection was made by hand; the overlay then has a single color."""

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
    colormap: colors.Colormap = colors.COLORMAPS[0],
    selection: Bool[Tensor, " n"] | None = None,
    drawn: Bool[Tensor, " n"] | None = None,
    by_hand: bool = False,
) -> Display:
    """Make the display of an answer, if there is one, on the device of the field.

    Args:
        shown: Index of the only prompt to show (default: all prompts).
        selection: Mask of the selected Gaussians (default: those that the answer selects).
        drawn: Mask of the Gaussians to draw (default: all).
        by_hand: True if `selection` is independent of the answer.
    """
    scalars = field.scalars
    zeros = torch.zeros_like(scalars.reliability)
    relevancy = zeros[:, None][:, :0] if answer is None else answer.relevancy
    explicit, selected = selection is not None, zeros.bool() if selection is None else selection
    if answer is not None and not explicit:
        selected = answer.selected.any(dim=1) if shown is None else answer.selected[:, shown]
    count, shown_relevancy, selected_by_any = relevancy.shape[1], zeros, zeros
    scale = whole = (0.0, 1.0)
    if answer is not None and count > 0:
        shown_relevancy = relevancy.amax(dim=1) if shown is None else relevancy[:, shown]
        selected_by_any = selected if explicit else answer.selected.any(dim=1)
        scale, whole = color_scale(shown_relevancy[answer.valid], answer.question.threshold), map_scale(answer)
    columns = (shown_relevancy, selected, selected_by_any, scalars.reliability, scalars.n_eff)
    values = torch.cat([relevancy.float(), torch.stack([c.float() for c in columns], dim=1)], dim=1)
    texts = () if answer is None else answer.texts
    return Display(values, scale, whole, colormap, texts, colors.prompt_colors(texts).to(values), shown, drawn, by_hand)


def color_scale(relevancy: Float[Tensor, " m"], threshold: float) -> tuple[float, float]:
    """Return a scale from the threshold to the largest of the given relevancies, at least 0.05 wide."""
    peak = float(relevancy.max()) if len(relevancy) > 0 else threshold
    return threshold, max(peak, threshold + _MIN_SPAN)


def pixel_relevancy(values: Float[Tensor, "h w q"], alpha: Float[Tensor, "h w"]) -> Float[Tensor, "h w q"]:
    """Divide rendered relevancies by opacity; return 0 for pixels with an opacity of at most 0.05."""
    return torch.where(alpha[:, :, None] > 0.05, values / alpha[:, :, None].clamp(min=1e-6), 0.0)


def map_scale(answer: Answer) -> tuple[float, float]:
    """Return the scale of relevancy maps, from the rule's `display_min` to the largest relevancy of any prompt."""
    peak = color_scale(answer.relevancy[answer.valid].flatten(), answer.question.threshold)[1]
    low = RELEVANCY_RULES[answer.question.rule].display_min
    return low, max(peak, low + _MIN_SPAN)


def output_names(texts: tuple[str, ...]) -> list[str]:
    """Return unique output names for prompts. They are valid file names, because ns-render uses them as such.

    >>> output_names(("sky blue", "sky/blue", "fox"))
    ['relevancy_sky_blue', 'relevancy_sky_blue_2', 'relevancy_fox']
    """
    names: list[str] = []
    for text in texts:
        name = f"relevancy_{safe_file_name(text)}"
        names.append(next(path.name for path in numbered_paths(Path(name)) if path.name not in names))
    return names


def render_outputs(
    display: Display,
    rgb: Float[Tensor, "h w 3"],
    image: Float[Tensor, "h w c"],
    alpha: Float[Tensor, "h w"],
    *,
    named_by_text: bool = False,
) -> dict[str, Tensor]:
    """Return the semantic outputs of one image by name, each [H, W, 1] or [H, W, 3], the overlay last.

    The outputs overlay, segmentation and reliability, and the relevancies if `named_by_text` is True, are color images
    on a gray render of the scene. The other outputs are scalars sum_j A_ij value_j, which are 0 for empty pixels.

    Args:
        rgb: Rendered scene, RGB in 0..1.
        image: Composited `display.values`.
        alpha: Opacity of every pixel.
        named_by_text: Return relevancies as color images with the names of `output_names`, for a viewer. Otherwise,
            return them as scalars with the names relevancy_0, relevancy_1, …
    """
    count = display.num_prompts
    pixel = pixel_relevancy(image[:, :, : count + 1], alpha)
    _, selected, selected_by_any, reliability, n_eff = image[:, :, count:].split(1, dim=2)
    opacity = SEGMENTATION_OPACITY * selected.clamp(0, 1).sqrt()  # makes faint selections such as floaters visible
    overlaid, segmented = _over_gray(rgb, colors.prompt_colors([""])[0].to(rgb), opacity), _gray(rgb)
    outputs = {f"relevancy_{i}": image[:, :, i : i + 1] for i in range(count)}
    if count > 0:
        segmented = segmentation(rgb, pixel[:, :, :count].argmax(dim=2), selected_by_any, display.palette)
        segmented = colors.add_prompt_legend(segmented, display.texts, display.palette)
    if count > 0 and not display.by_hand:
        overlaid = overlay(display, rgb, pixel[:, :, count], selected)
        overlaid = colors.add_color_bar(overlaid, display.colormap, display.scale, display.title)
    if named_by_text:
        maps = (relevancy_map(display, rgb, pixel[:, :, i], alpha) for i in range(count))
        named = zip(output_names(display.texts), display.texts, maps)
        outputs = {name: colors.add_color_bar(x, display.colormap, display.map_scale, text) for name, text, x in named}
    return {
        **outputs,
        "reliability": reliability_map(rgb, reliability, alpha),
        "reliability_value": reliability,
        "n_eff": n_eff,
        "selection": selected,
        "segmentation": segmented,
        "overlay": overlaid,
    }


def overlay(
    display: Display, rgb: Float[Tensor, "h w 3"], relevancy: Float[Tensor, "h w"], share: Float[Tensor, "h w 1"]
) -> Float[Tensor, "h w 3"]:
    """Color the selection by relevancy over the scene in gray; opacity increases with relevancy.

    Args:
        share: Selected fraction of each pixel, in 0..1.
    """
    color, opacity = colors.apply_colormap(relevancy, display.scale, colors.colormap_rgb(display.colormap).to(rgb))
    return _over_gray(rgb, color, share.clamp(0, 1) * opacity[:, :, None])


def relevancy_map(
    display: Display, rgb: Float[Tensor, "h w 3"], relevancy: Float[Tensor, "h w"], alpha: Float[Tensor, "h w"]
) -> Float[Tensor, "h w 3"]:
    """Color all pixels by relevancy over the scene in gray; opacity increases with relevancy."""
    ramp = colors.colormap_rgb(display.colormap).to(rgb)
    color, opacity = colors.apply_colormap(relevancy, display.map_scale, ramp, min_opacity=0.0)
    return _over_gray(rgb, color, (alpha.clamp(0, 1) * opacity)[:, :, None])


def segmentation(
    rgb: Float[Tensor, "h w 3"],
    labels: Int[Tensor, "h w"],
    share: Float[Tensor, "h w 1"],
    palette: Float[Tensor, "q 3"],
) -> Float[Tensor, "h w 3"]:
    """Draw the selection in the color of the most relevant prompt over the scene in gray.

    Args:
        labels: Index of the most relevant prompt of each pixel.
        share: Selected fraction of each pixel, in 0..1.
        palette: Colors of the prompts, RGB in 0..1.
    """
    return _over_gray(rgb, palette[labels], SEGMENTATION_OPACITY * share.clamp(0, 1))


def reliability_map(
    rgb: Float[Tensor, "h w 3"], reliability: Float[Tensor, "h w 1"], alpha: Float[Tensor, "h w"]
) -> Float[Tensor, "h w 3"]:
    """Return a map of the reliability R on a fixed scale from 0 to 1, with a color bar if there is enough space.

    Args:
        reliability: Composited reliability, not divided by `alpha`.
    """
    pixel = pixel_relevancy(reliability, alpha)[:, :, 0]
    color = colors.colormap_rgb(colors.RELIABILITY_COLORMAP).to(rgb)[(pixel.clamp(0, 1) * 255).round().long()]
    image = _over_gray(rgb, color, colors.MAX_OVERLAY_OPACITY * alpha.clamp(0, 1)[:, :, None])
    return colors.add_color_bar(image, colors.RELIABILITY_COLORMAP, (0.0, 1.0), "reliability R (high is good)")


def _over_gray(rgb: Tensor, color: Tensor, opacity: Tensor) -> Tensor:
    return (1 - opacity) * _gray(rgb) + opacity * color


def _gray(rgb: Tensor) -> Tensor:
    return rgb.mean(dim=2, keepdim=True).expand_as(rgb)


# Layout of figures of answers: titles, panels, outlines and the color bar.


_PANEL_WIDTH, _THUMBNAIL_WIDTH, _MAX_WIDTH = 640, 420, 4096
"""Width in pixels of a panel in a figure and of a panel in a contact sheet, and maximum width of a contact sheet."""
_MAX_SINGLE_ROW = 3
"""Maximum number of panels in a contact sheet with a single row."""
_MAX_ASPECT = 1.5
"""Maximum height of a panel, as a multiple of its width."""
_MARGIN, _FONT_SIZE = 16, 17
_BACKGROUND, _TEXT_COLOR, _CAPTION_COLOR = (255, 255, 255), (20, 20, 20), (95, 95, 95)


@dataclass(frozen=True)
class FigureStyle:
    """Settings shared by all figures of an answer."""

    colormap: colors.Colormap
    scale: tuple[float, float]
    """Relevancies at the two ends of the color bar."""
    threshold: float
    """Relevancy above which Gaussians are selected."""


@dataclass(frozen=True)
class FigureHeader:
    """Title and summary above a figure."""

    text: str
    """The prompt."""
    summary: str
    """Size of the selection and strength of its evidence, or the statement that nothing is selected."""
    verdict: Verdict | None = None
    """Verdict on the presence of the prompt in the scene."""

    @property
    def title(self) -> str:
        """The prompt, followed by the verdict if there is one."""
        return colors.clip_text(self.text, 60) + ("" if self.verdict is None else f"   ·   {self.verdict}")

    @staticmethod
    def of(finding: Finding) -> FigureHeader:
        """Make the header for the result of one prompt."""
        mask, scalars = finding.mask, finding.answer.field.scalars
        threshold, verdict = finding.answer.question.threshold, finding.verdict
        if not bool(mask.any()):
            peak = "" if finding.peak is None else f", largest relevancy {finding.peak:.2f}"
            return FigureHeader(finding.text, f"no Gaussian is selected (threshold {threshold:g}{peak})", verdict)
        views = float((evidence_weights(scalars, mask) * scalars.n_eff[mask].double()).sum())
        weak = float((scalars.reliability[mask] < WEAK_RELIABILITY).double().mean())
        evidence = f"evidence: R {finding.mean_reliability:.2f}, {views:.1f} views, {100 * weak:.0f} % weak"
        below = f" (R < {WEAK_RELIABILITY:g})"
        return FigureHeader(
            finding.text, f"{100 * finding.fraction:.1f} % of the Gaussians; {evidence}{below}", verdict
        )


def view_figure(
    sheet: FigureStyle,
    header: FigureHeader,
    view: str,
    image: UInt8[Tensor, "h w 3"] | None,
    overlay: UInt8[Tensor, "h w 3"],
    selected: Bool[Tensor, "h w"],
) -> Image.Image:
    """Draw a figure of one view, with the training image next to the overlay.

    Args:
        header: Title and summary above the figure.
        view: Name of the view.
        image: Training image; None to show only the overlay.
        overlay: Rendered overlay of the same view.
        selected: Mask of the selected pixels, which the figure outlines.
    """
    panel = _outlined(overlay, selected, _PANEL_WIDTH)
    panels = {} if image is None else {"training image": Image.fromarray(image.cpu().numpy()).resize(panel.size)}
    panels["answer"] = panel
    share = np.count_nonzero(selected.cpu().numpy()) / max(1, selected.numel())
    summary = f"{100 * share:.1f} % of this view, {header.summary}" if share > 0 else header.summary
    titles = [f"{header.title}   ·   {colors.clip_text(view, 40)}", summary]
    return _page(sheet, titles, list(panels.values()), list(panels), 2)


def contact_sheet(
    sheet: FigureStyle, header: FigureHeader, panels: Sequence[Image.Image], views: Sequence[str]
) -> Image.Image:
    """Draw a figure of all views for one prompt.

    Args:
        header: Title and summary above the figure.
        panels: Overlay of each view with an outline of the selection, no wider than `_panel_width`.
        views: Names of the views.
    """
    return _page(sheet, [header.title, header.summary], panels, views, _columns(len(panels)))


def _columns(panels: int) -> int:
    """Return the number of columns of a contact sheet with the given number of panels."""
    return panels if panels <= _MAX_SINGLE_ROW else math.ceil(math.sqrt(panels))


def _panel_width(panels: int) -> int:
    """Return the maximum width in pixels of a panel in a contact sheet with the given number of panels."""
    return min(_THUMBNAIL_WIDTH, _MAX_WIDTH // _columns(panels))


def _outlined(overlay: Tensor, selected: Tensor, width: int) -> Image.Image:
    """Scale the overlay to a width of at most `width` pixels, and outline the selection in white with a black edge."""
    scale = min(width / overlay.shape[1], _MAX_ASPECT * width / overlay.shape[0])
    size = (max(1, round(scale * overlay.shape[1])), max(1, round(scale * overlay.shape[0])))
    image = Image.fromarray(overlay.cpu().numpy()).resize(size, Image.Resampling.BICUBIC)
    mask = Image.fromarray(selected.cpu().numpy() * np.uint8(255)).resize(size, Image.Resampling.BILINEAR)
    inside = (np.asarray(mask) > 127).astype(np.uint8)
    for color, thickness in (((0, 0, 0), 5), ((255, 255, 255), 3)):
        window = np.ones((thickness, thickness), np.uint8)
        image.paste(color, mask=Image.fromarray(cv2.dilate(inside, window) != cv2.erode(inside, window)))
    return image


def _page(
    sheet: FigureStyle, titles: Sequence[str], panels: Sequence[Image.Image], captions: Sequence[str], columns: int
) -> Image.Image:
    """Lay out panels in rows of `columns` panels, with titles above and the color bar below."""
    columns, line, small = min(columns, len(panels)), round(1.5 * _FONT_SIZE), colors.load_font(_FONT_SIZE - 4)
    width, height = (max(panel.size[i] for panel in panels) for i in (0, 1))
    rows = math.ceil(len(panels) / columns)
    inner = max(columns * (width + _MARGIN) - _MARGIN, 560)
    top = _MARGIN + line * len(titles)
    bottom = top + rows * (height + line + _MARGIN)
    page = Image.new("RGB", (inner + 2 * _MARGIN, bottom + 3 * line), _BACKGROUND)
    draw = ImageDraw.Draw(page)
    for i, title in enumerate(titles):
        size, color = (_FONT_SIZE, _TEXT_COLOR) if i == 0 else (_FONT_SIZE - 2, _CAPTION_COLOR)
        typeface = colors.load_font(size)
        fitting = next(n for n in range(len(title), -1, -1) if typeface.getlength(title[:n]) <= inner)
        draw.text((_MARGIN, _MARGIN // 2 + i * line), title[:fitting], fill=color, font=typeface)
    for i, (panel, caption) in enumerate(zip(panels, captions)):
        x, y = _MARGIN + (i % columns) * (width + _MARGIN), top + (i // columns) * (height + line + _MARGIN)
        page.paste(panel, (x, y + line))
        most = max(4, int(width / (0.6 * (_FONT_SIZE - 4))))
        draw.text((x, y + 4), colors.clip_text(caption, most), fill=_CAPTION_COLOR, font=small)
    _draw_color_bar(draw, page, sheet, (_MARGIN, bottom, inner))
    return page


def _draw_color_bar(
    draw: ImageDraw.ImageDraw, page: Image.Image, sheet: FigureStyle, position: tuple[int, int, int]
) -> None:
    """Draw the color bar with its end values and a mark at the threshold.

    Args:
        position: x, y and width in pixels.
    """
    (x, y, width), typeface = position, colors.load_font(_FONT_SIZE - 4)
    (low, high), height = sheet.scale, _FONT_SIZE
    ramp = (colors.colormap_rgb(sheet.colormap).numpy() * 255).round().astype(np.uint8)[None]
    page.paste(Image.fromarray(ramp).resize((width, height)), (x, y))
    mark = x + round(width * min(max((sheet.threshold - low) / (high - low), 0.0), 1.0))
    for color, thickness in (((0, 0, 0), 3), ((255, 255, 255), 1)):
        draw.line((mark, y - 3, mark, y + height + 3), fill=color, width=thickness)
    label = f"selected above {sheet.threshold:.3g}"
    length = typeface.getlength(label)
    ends = [f"{low:g}", f"{high:.2f}"]
    left, right = x + typeface.getlength(ends[0]) + 10, x + width - typeface.getlength(ends[1]) - 10 - length
    draw.text((x, y + height + 5), ends[0], fill=_TEXT_COLOR, font=typeface)
    draw.text((x + width - typeface.getlength(ends[1]), y + height + 5), ends[1], fill=_TEXT_COLOR, font=typeface)
    draw.text((min(max(mark - length / 2, left), right), y + height + 5), label, fill=_TEXT_COLOR, font=typeface)
    draw.text((x, y + height + 5 + round(1.2 * _FONT_SIZE)), "relevancy", fill=_CAPTION_COLOR, font=typeface)


# Files of figures and masks.


CONTACT_SHEET_PREFIX = "contact_sheet"
"""Prefix of the file names of contact sheets; the prefix of other figures is the name of their view."""
_THREADS = min(16, os.cpu_count() or 1)
"""Number of views whose figures are drawn and saved concurrently."""
_ZLIB_LEVEL = 1
"""Compression level of PNG files. A level of 4 takes 1.4 times as long for files that are 4 % smaller."""


def save_overlays(
    scene: Scene,
    answer: Answer,
    cameras: dict[str, Camera],
    folder: Path,
    *,
    settings: RasterSettings | None = None,
    device: str = "cpu",
    overwrite: bool = False,
) -> list[Path]:
    """Write one PNG figure per camera and prompt and, for several cameras, one contact sheet per prompt.

    The figure of a camera shows a render with the relevancy and an outline of the selection. If the training image can
    be read, it is shown next to the render. All figures share one color scale.

    Args:
        cameras: Training cameras by file name prefix, as `training_cameras` returns them.
        settings: Rasterizer settings (default: those of gsplat 1.4).
        device: torch device to render on.
        overwrite: Replace existing files.
    Returns:
        Paths of the files.
    Raises:
        FileExistsError: A file exists, and `overwrite` is False.
        OSError: A file cannot be written.
        ValueError: Two figures would have the same name.
    """
    ends = [f"{q}_{safe_file_name(text)}.png" for q, text in enumerate(answer.texts)]
    _check_figure_names(folder, [*([CONTACT_SHEET_PREFIX] if len(cameras) > 1 else []), *cameras], ends)
    headers = [FigureHeader.of(finding) for finding in answer]
    display = make_display(answer.field, answer)
    sheet = FigureStyle(colors.COLORMAPS[0], display.map_scale, answer.question.threshold)

    def save(prefix: str, q: int, picture: Image.Image) -> Path:
        path = folder / f"{prefix}_{ends[q]}"
        pixels = cv2.cvtColor(np.asarray(picture), cv2.COLOR_RGB2BGR)
        _, content = cv2.imencode(
            ".png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, _ZLIB_LEVEL]
        )  # PIL blocks other threads
        with atomic_file(path, overwrite=overwrite) as draft:
            draft.write_bytes(content.tobytes())
        return path

    def draw(rendered: tuple[str, list[_Overlay]]) -> tuple[list[Path], list[Image.Image]]:
        view, overlays = rendered
        image = _training_image(scene, view)
        figures = (view_figure(sheet, header, view, image, *x) for header, x in zip(headers, overlays))
        paths = [save(view, q, figure) for q, figure in enumerate(figures)]
        return paths, [_outlined(*overlay, _panel_width(len(cameras))) for overlay in overlays]

    drawn = list(prefetch_map(draw, _render_overlays(scene, answer, display, cameras, settings, device), _THREADS))
    paths = [path for saved, _ in drawn for path in saved]
    if len(cameras) > 1:

        def save_sheet(q: int) -> Path:
            panels = [panel[q] for _, panel in drawn]
            return save(CONTACT_SHEET_PREFIX, q, contact_sheet(sheet, headers[q], panels, list(cameras)))

        paths += prefetch_map(save_sheet, range(len(ends)), _THREADS)
    return paths


def _check_figure_names(folder: Path, prefixes: Sequence[str], ends: Sequence[str]) -> None:
    counts = Counter(f"{prefix}_{end}" for prefix in prefixes for end in ends)
    duplicates = [name for name, count in counts.items() if count > 1]
    if len(duplicates) > 0:
        raise InputError(f"two figures would have the name {folder / duplicates[0]}. Render the views one at a time.")


class _Overlay(NamedTuple):
    """Overlay of one prompt, on the CPU."""

    image: UInt8[Tensor, "h w 3"]
    selected: Bool[Tensor, "h w"]
    """Mask of the selected pixels."""


def _render_overlays(
    scene: Scene,
    answer: Answer,
    display: Display,
    cameras: Mapping[str, Camera],
    settings: RasterSettings | None,
    device: str,
) -> Iterator[tuple[str, list[_Overlay]]]:
    """Yield the name of every view with its overlays, one per prompt. All overlays of a view are rendered together."""
    count, gaussians = len(answer.texts), scene.gaussians.to(device)
    values = torch.cat([answer.relevancy.float(), answer.selected.float()], dim=1).to(device)
    for name, camera in cameras.items():
        rgb, image, alpha = render_with_image(scene, camera, values, settings=settings, gaussians=gaussians)
        rgb, pixel = rgb.to(device).float() / 255, pixel_relevancy(image, alpha)
        maps = [relevancy_map(display, rgb, pixel[:, :, q], alpha) for q in range(count)]
        images = ((x * 255).round().to(torch.uint8).cpu() for x in maps)
        yield name, list(map(_Overlay, images, (pixel[:, :, count:] > 0.5).cpu().unbind(2)))


def _training_image(scene: Scene, view: str) -> UInt8[Tensor, "h w 3"] | None:
    """Return the training image of a view; None if the file is missing or damaged."""
    names = unique_file_names(list(scene.train.names))
    try:
        return scene.train[names.index(view)].image
    except (FileNotFoundError, InputError):
        return None


def training_cameras(scene: Scene, names: Sequence[str] = ()) -> dict[str, Camera]:
    """Return training cameras by unique file name.

    Args:
        names: Names from `unique_file_names`, image paths with or without suffix, or their stems (default: up to three
            evenly spaced views).
    Raises:
        ValueError: A name matches no training image, or several.
    """
    images, cameras = list(scene.train.names), scene.train.cameras
    unique = unique_file_names(images)
    if len(names) == 0:
        return {unique[i]: cameras[i] for i in sample_evenly(len(images), 3)}
    selected = {}
    for name in names:
        matches = [i for i, image in enumerate(images) if name in (unique[i], image, _without_suffix(image))]
        matches = matches or [i for i, image in enumerate(images) if PurePosixPath(image).stem == name]
        if len(matches) == 0:
            raise InputError(
                f"the scene has no training image {name!r}. Its training images ({len(images)}) are named "
                f"{unique[0]!r} to {unique[-1]!r}. Images held out for evaluation are not available."
            )
        if len(matches) > 1:
            raise InputError(
                f"{len(matches)} training images match {name!r}. Choose one of: {', '.join(unique[i] for i in matches)}"
            )
        selected[unique[matches[0]]] = cameras[matches[0]]
    return selected


_OUTLINE_FRACTION = 1 / 320
"""Width of the outlines of an inventory, relative to the longer side of the image."""


def save_inventory(
    scene: Scene, inventory: Inventory, path: Path, *, manifest: Mapping[str, Any], overwrite: bool = False
) -> str:
    """Write a PNG render of the scene with outlines, numbers and names of the objects of an inventory.

    The camera is that of the training image that shows the most objects. In a tie, it is the one with the largest mean
    size of the objects. Here, the size of an object is a fraction of its largest size in any training image.

    Args:
        path: File to write.
        manifest: Manifest of the field, with the settings of the rasterizer.
        overwrite: Replace an existing file.
    Returns:
        Name of the training image.
    Raises:
        FileExistsError: The file exists, and `overwrite` is False.
        OSError: The file cannot be written.
    """
    settings, count = RasterSettings.recorded(manifest), len(inventory)
    shares = inventory.catalog.view_shares
    shares = shares / shares.amax(dim=1, keepdim=True).clamp(min=1e-12)
    shown = (shares >= MIN_VIEW_SHARE).sum(dim=0) + shares.sum(dim=0) / max(count, 1)  # the second term is below 1
    view = int(shown.argmax())
    camera, mode = scene.train.cameras[view], scene.rasterize_mode
    image = render_image(scene, camera, settings=settings)
    values = torch.nn.functional.one_hot(inventory.instance_id.long(), count + 1)[:, 1:].to(scene.gaussians.means)
    weights, alpha = render(scene.gaussians, camera, values, rasterize_mode=mode, settings=settings)
    masks = (pixel_relevancy(weights, alpha) > 0.5).permute(2, 0, 1)
    masks &= (shares[:, view] >= MIN_VIEW_SHARE).to(masks.device)[:, None, None]  # hide objects that are too small here
    drawn = _numbered(image, masks, [item.text for item in inventory.catalog.objects])
    with atomic_file(path, overwrite=overwrite) as draft:
        drawn.save(draft, format="PNG")
    return scene.train.names[view]


def _numbered(image: UInt8[Tensor, "h w 3"], masks: Bool[Tensor, "m h w"], names: Sequence[str]) -> Image.Image:
    """Draw the outline of every mask, and its number and name at the mask pixel with the most mask pixels around it."""
    height, width = image.shape[:2]
    line = max(1, round(max(height, width) * _OUTLINE_FRACTION))
    canvas, size = image.clone().cpu(), max(12, max(height, width) // 40)
    outside = torch.nn.functional.pad((~masks).float(), (line,) * 4, value=1.0)
    border = masks & (torch.nn.functional.max_pool2d(outside, 2 * line + 1, stride=1) > 0)
    for number, edge in enumerate(border.cpu(), 1):
        canvas[edge] = torch.tensor(object_color(number), dtype=torch.uint8)
    picture = Image.fromarray(canvas.numpy())
    draw, font, reach = ImageDraw.Draw(picture), colors.load_font(size), max(1, min(height, width) // 16)
    for number, (mask, name) in enumerate(zip(masks, names), 1):
        if not bool(mask.any()):
            continue
        inside = mask.cpu().numpy().astype(np.float32)
        count = cv2.boxFilter(inside, -1, (2 * reach + 1,) * 2, normalize=False, borderType=cv2.BORDER_CONSTANT)
        y, x = divmod(int(np.where(inside > 0, count, -1).argmax()), width)
        text = str(number) if name == f"object {number}" else f"{number} {colors.clip_text(name, 24)}"
        place = {"text": text, "font": font, "anchor": "mm"}
        left, top, right, bottom = draw.textbbox((x, y), **place)
        draw.rectangle((left - line, top - line, right + line, bottom + line), fill=(0, 0, 0))
        draw.text((x, y), fill=object_color(number), **place)
    return picture


def write_masks(
    scene: Scene,
    selected: Bool[Tensor, " n"],
    folder: Path,
    *,
    invert: bool = False,
    settings: RasterSettings | None = None,
    overwrite: bool = False,
) -> list[Path]:
    """Write one PNG mask per training image, of the same size, with 255 for the pixels of `view_mask` and 0 for others.

    If an error occurs, no file is written. Objects in front of the selection occlude it. The masks match the
    undistorted images that the training used.

    Args:
        invert: Write 0 for the pixels of `view_mask`, and 255 for others.
        settings: Rasterizer settings (default: those of gsplat 1.4).
        overwrite: Replace existing files.
    Returns:
        Paths of the files.
    Raises:
        FileExistsError: A file exists, and `overwrite` is False.
        OSError: A file cannot be written.
    """
    files = mask_files(scene, folder)
    with atomic_files(*files, overwrite=overwrite) as drafts:
        for camera, draft in zip(scene.train.cameras, drafts):
            mask = view_mask(scene, camera, selected, settings=settings) != invert
            Image.fromarray((mask.to(torch.uint8) * 255).cpu().numpy()).save(draft, "PNG")
    return files


def mask_files(scene: Scene, folder: Path) -> list[Path]:
    """Return the path of the mask of each training image."""
    return [folder / f"{name}.png" for name in unique_file_names(list(scene.train.names))]


def view_mask(
    scene: Scene, camera: Camera, selected: Bool[Tensor, " n"], *, settings: RasterSettings | None = None
) -> Bool[Tensor, "h w"]:
    """Return the mask of the pixels in which the selection contributes more than half of the opacity.

    Pixels with an opacity of at most 0.05 are not in the mask.
    """
    values = selected.to(scene.gaussians.means)[:, None]
    image, alpha = render(scene.gaussians, camera, values, rasterize_mode=scene.rasterize_mode, settings=settings)
    return pixel_relevancy(image, alpha)[:, :, 0] > 0.5


def unique_file_names(images: Sequence[str]) -> list[str]:
    """Return a unique file name for each image: its stem, or its path with "_" for "/" if several share the stem.

    >>> unique_file_names(["a/0.png", "b/0.png", "b/1.png", "c/2.png", "c/2.jpg"])
    ['a_0', 'b_0', '1', 'c_2.png', 'c_2.jpg']
    """
    names = [PurePosixPath(image).stem for image in images]
    for longer in (_without_suffix, str):
        counts = Counter(map(str.casefold, names))
        duplicate = [counts[name.casefold()] > 1 for name in names]
        names = [longer(image).replace("/", "_") if x else name for image, name, x in zip(images, names, duplicate)]
    taken: dict[str, str] = {}
    for name in names:
        unique = next(path.name for path in numbered_paths(Path(name)) if path.name.casefold() not in taken)
        taken[unique.casefold()] = unique
    return list(taken.values())


def _without_suffix(image: str) -> str:
    return str(PurePosixPath(image).with_suffix(""))
