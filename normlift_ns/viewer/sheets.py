"""Layout of figures of answers: titles, panels, outlines and the color bar."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, UInt8
from PIL import Image, ImageDraw, ImageFilter
from torch import Tensor

from normlift_ns.asking import Finding
from normlift_ns.colors import Colormap, colors_of
from normlift_ns.session.state import POOR
from normlift_ns.viewer.legend import clipped, font

_PANEL_WIDTH, _THUMBNAIL_WIDTH, _MAX_WIDTH = 640, 420, 4096
"""Width in pixels of the panels of a figure, of those of a contact sheet, and largest width of a contact sheet."""
_MAX_SINGLE_ROW = 3
"""Largest number of panels for which a contact sheet has a single row."""
_MAX_ASPECT = 1.5
"""Largest height of a panel, as a multiple of its width."""
_MARGIN, _FONT_SIZE = 16, 17
_BACKGROUND, _TEXT_COLOR, _CAPTION_COLOR = (255, 255, 255), (20, 20, 20), (95, 95, 95)


@dataclass(frozen=True)
class Sheet:
    """Settings that all figures of an answer share."""

    colormap: Colormap
    scale: tuple[float, float]
    """Relevancies at the ends of the color bar."""
    threshold: float
    """Relevancy above which Gaussians are selected."""


@dataclass(frozen=True)
class Found:
    """Title and summary above a figure."""

    text: str
    """The prompt."""
    summary: str
    """Size of the selection and strength of its evidence."""
    absent: bool = False
    """Whether the prompt is probably not in the scene."""

    @property
    def title(self) -> str:
        """The prompt, and a note if it is probably not in the scene."""
        return clipped(self.text, 60) + self.absent * "   ·   probably not in this scene"

    @staticmethod
    def of(finding: Finding) -> Found:
        """Summarize the answer to one prompt."""
        mask, scalars = finding.mask, finding.answer.field.scalars
        threshold, absent = finding.answer.question.threshold, finding.stands_out is False
        if not bool(mask.any()):
            peak = "" if finding.peak is None else f"; the best match reaches {finding.peak:.2f}"
            return Found(finding.text, f"nothing is above {threshold:g}{peak}", absent)
        weight = scalars.weight[mask].double() + 1e-12
        views = float((weight * scalars.n_eff[mask].double()).sum() / weight.sum())
        weak = float((scalars.reliability[mask] < POOR).double().mean())
        evidence = f"evidence: R {finding.mean_reliability:.2f}, {views:.1f} views, {100 * weak:.0f} % weak"
        below = f" (R < {POOR:g})"
        return Found(finding.text, f"{100 * finding.fraction:.1f} % of the Gaussians; {evidence}{below}", absent)


def picture_of(
    sheet: Sheet,
    header: Found,
    view: str,
    image: UInt8[Tensor, "h w 3"] | None,
    overlay: UInt8[Tensor, "h w 3"],
    selected: Bool[Tensor, "h w"],
) -> Image.Image:
    """Draw a figure of one view: the training image next to the overlay.

    Args:
        header: title and summary above the figure.
        view: name of the view.
        image: training image; None: it is not available, and the figure shows the overlay alone.
        overlay: rendered overlay of the same view.
        selected: mask of the selected pixels, which are outlined.
    """
    panel = _outlined(overlay, selected, _PANEL_WIDTH)
    panels = [panel] if image is None else [Image.fromarray(image.cpu().numpy()).resize(panel.size), panel]
    captions = ["answer"] if image is None else ["training image", "answer"]
    summary = f"{100 * float(selected.float().mean()):.1f} % of this view, {header.summary}"
    if not bool(selected.any()):
        summary = header.summary
    return _page(sheet, [f"{header.title}   ·   {clipped(view, 40)}", summary], panels, captions, 2)


def contact_sheet(sheet: Sheet, header: Found, overlays: Sequence[tuple[str, Tensor, Tensor]]) -> Image.Image:
    """Draw a figure of all views for one prompt.

    Args:
        header: title and summary above the figure.
        overlays: name, overlay [H, W, 3] and mask of selected pixels [H, W] of each view.
    """
    columns = len(overlays) if len(overlays) <= _MAX_SINGLE_ROW else math.ceil(math.sqrt(len(overlays)))
    width = min(_THUMBNAIL_WIDTH, _MAX_WIDTH // columns)
    panels = [_outlined(overlay, selected, width) for _, overlay, selected in overlays]
    return _page(sheet, [header.title, header.summary], panels, [view for view, _, _ in overlays], columns)


def _outlined(overlay: Tensor, selected: Tensor, width: int) -> Image.Image:
    """Return the overlay, at most `width` wide, with a white line on a black one around the selection."""
    scale = min(width / overlay.shape[1], _MAX_ASPECT * width / overlay.shape[0])
    size = (max(1, round(scale * overlay.shape[1])), max(1, round(scale * overlay.shape[0])))
    image = Image.fromarray(overlay.cpu().numpy()).resize(size, Image.Resampling.BICUBIC)
    mask = Image.fromarray(selected.cpu().numpy() * np.uint8(255)).resize(size, Image.Resampling.BILINEAR)
    mask = mask.point(lambda value: 255 * (value > 127))  # pyright: ignore[reportOperatorIssue]
    for color, thickness in (((0, 0, 0), 5), ((255, 255, 255), 3)):
        dilated, eroded = mask.filter(ImageFilter.MaxFilter(thickness)), mask.filter(ImageFilter.MinFilter(thickness))
        image.paste(color, mask=Image.fromarray(np.asarray(dilated) != np.asarray(eroded)))
    return image


def _page(
    sheet: Sheet, titles: Sequence[str], panels: Sequence[Image.Image], captions: Sequence[str], columns: int
) -> Image.Image:
    """Lay out panels in rows of `columns`, with titles above and the color bar below."""
    columns, line = min(columns, len(panels)), round(1.5 * _FONT_SIZE)
    width, height = (max(panel.size[i] for panel in panels) for i in (0, 1))
    rows = math.ceil(len(panels) / columns)
    inner = max(columns * (width + _MARGIN) - _MARGIN, 560)
    top = _MARGIN + line * len(titles)
    bottom = top + rows * (height + line + _MARGIN)
    page = Image.new("RGB", (inner + 2 * _MARGIN, bottom + 3 * line), _BACKGROUND)
    draw = ImageDraw.Draw(page)
    for i, title in enumerate(titles):
        typeface, color = font(_FONT_SIZE if i == 0 else _FONT_SIZE - 2), _TEXT_COLOR if i == 0 else _CAPTION_COLOR
        fitting = next(n for n in range(len(title), -1, -1) if typeface.getlength(title[:n]) <= inner)
        draw.text((_MARGIN, _MARGIN // 2 + i * line), title[:fitting], fill=color, font=typeface)
    for i, (panel, caption) in enumerate(zip(panels, captions)):
        x, y = _MARGIN + (i % columns) * (width + _MARGIN), top + (i // columns) * (height + line + _MARGIN)
        page.paste(panel, (x, y + line))
        most = max(4, int(width / (0.6 * (_FONT_SIZE - 4))))
        draw.text((x, y + 4), clipped(caption, most), fill=_CAPTION_COLOR, font=font(_FONT_SIZE - 4))
    _draw_color_bar(draw, page, sheet, (_MARGIN, bottom, inner))
    return page


def _draw_color_bar(draw: ImageDraw.ImageDraw, page: Image.Image, sheet: Sheet, position: tuple[int, int, int]) -> None:
    """Draw the color bar with the values at its ends and a mark at the threshold.

    Args:
        position: x, y and width in pixels.
    """
    (x, y, width), typeface = position, font(_FONT_SIZE - 4)
    (low, high), height = sheet.scale, _FONT_SIZE
    ramp = (colors_of(sheet.colormap).numpy() * 255).round().astype(np.uint8)[None]
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
