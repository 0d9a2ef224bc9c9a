"""How pictures of answers are laid out: titles, panels, outlines and the colour bar."""

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

_PANEL, _THUMB, _MOST_WIDTH = 640, 420, 4096
"""Width of a picture's panels, of the pictures in a contact sheet, and of the sheet at most, in pixels."""
_ONE_ROW = 3
"""Pictures in a contact sheet that stand in one row, at most."""
_TALLEST = 1.5
"""Height of a panel at most, as a multiple of its width."""
_MARGIN, _LETTERS = 16, 17
_PAPER, _INK, _QUIET = (255, 255, 255), (20, 20, 20), (95, 95, 95)


@dataclass(frozen=True)
class Sheet:
    """What all pictures of an answer have in common."""

    colormap: Colormap
    scale: tuple[float, float]
    """Relevancies at the ends of the colours."""
    threshold: float


@dataclass(frozen=True)
class Found:
    """What the title of a picture says."""

    text: str
    summary: str
    """How much is selected, and on what evidence."""
    absent: bool = False
    """Whether it is probably not in the scene."""

    @property
    def title(self) -> str:
        """The text, and whether it is probably not there."""
        return clipped(self.text, 60) + self.absent * "   ·   probably not in this scene"

    @staticmethod
    def of(finding: Finding) -> Found:
        """The numbers of a finding in words."""
        mask, scalars = finding.mask, finding.answer.field.scalars
        threshold, absent = finding.answer.question.threshold, finding.stands_out is False
        if not bool(mask.any()):
            peak = "" if finding.peak is None else f"; the best match reaches {finding.peak:.2f}"
            return Found(finding.text, f"nothing is above {threshold:g}{peak}", absent)
        share = scalars.weight[mask].double() + 1e-12
        views = float((share * scalars.n_eff[mask].double()).sum() / share.sum())
        poor = float((scalars.reliability[mask] < POOR).double().mean())
        evidence = f"evidence: R {finding.mean_reliability:.2f}, {views:.1f} views, {100 * poor:.0f} % of it poor"
        below = f" (R < {POOR:g})"
        return Found(finding.text, f"{100 * finding.fraction:.1f} % of the Gaussians; {evidence}{below}", absent)


def picture_of(
    sheet: Sheet,
    found: Found,
    view: str,
    photograph: UInt8[Tensor, "h w 3"] | None,
    overlay: UInt8[Tensor, "h w 3"],
    selected: Bool[Tensor, "h w"],
) -> Image.Image:
    """The photograph, and beside it what is found.

    Args:
        photograph: None: it is not there any more, and the overlay stands alone.
        overlay: of the same view.
        selected: pixels within the outline.
    """
    shown = _outlined(overlay, selected, _PANEL)
    panels = [shown] if photograph is None else [Image.fromarray(photograph.cpu().numpy()).resize(shown.size), shown]
    captions = ["found"] if photograph is None else ["photograph", "found"]
    covered = f"{100 * float(selected.float().mean()):.1f} % of this view, {found.summary}"
    if not bool(selected.any()):
        covered = found.summary
    return _page(sheet, [f"{found.title}   ·   {clipped(view, 40)}", covered], panels, captions, 2)


def contact_sheet(sheet: Sheet, found: Found, overlays: Sequence[tuple[str, Tensor, Tensor]]) -> Image.Image:
    """All views of one text.

    Args:
        overlays: name, overlay [H, W, 3] and selected pixels [H, W] of each view.
    """
    columns = len(overlays) if len(overlays) <= _ONE_ROW else math.ceil(math.sqrt(len(overlays)))
    width = min(_THUMB, _MOST_WIDTH // columns)
    panels = [_outlined(overlay, selected, width) for _, overlay, selected in overlays]
    return _page(sheet, [found.title, found.summary], panels, [view for view, _, _ in overlays], columns)


def _outlined(overlay: Tensor, selected: Tensor, width: int) -> Image.Image:
    """The overlay in the given width at most, with a white line on a black one around what is selected."""
    scale = min(width / overlay.shape[1], _TALLEST * width / overlay.shape[0])
    size = (max(1, round(scale * overlay.shape[1])), max(1, round(scale * overlay.shape[0])))
    picture = Image.fromarray(overlay.cpu().numpy()).resize(size, Image.Resampling.BICUBIC)
    within = Image.fromarray(selected.cpu().numpy() * np.uint8(255)).resize(size, Image.Resampling.BILINEAR)
    within = within.point(lambda value: 255 * (value > 127))  # pyright: ignore[reportOperatorIssue]
    for ink, reach in (((0, 0, 0), 5), ((255, 255, 255), 3)):
        edge = np.asarray(within.filter(ImageFilter.MaxFilter(reach))) != np.asarray(
            within.filter(ImageFilter.MinFilter(reach))
        )
        picture.paste(ink, mask=Image.fromarray(edge))
    return picture


def _page(
    sheet: Sheet, titles: Sequence[str], panels: Sequence[Image.Image], captions: Sequence[str], columns: int
) -> Image.Image:
    """Panels in rows of `columns`, titles above, the colour bar below."""
    columns, line = min(columns, len(panels)), round(1.5 * _LETTERS)
    wide, high = (max(panel.size[i] for panel in panels) for i in (0, 1))
    rows = math.ceil(len(panels) / columns)
    inner = max(columns * (wide + _MARGIN) - _MARGIN, 560)
    top = _MARGIN + line * len(titles)
    below = top + rows * (high + line + _MARGIN)
    page = Image.new("RGB", (inner + 2 * _MARGIN, below + 3 * line), _PAPER)
    draw = ImageDraw.Draw(page)
    for i, title in enumerate(titles):
        letters = font(_LETTERS if i == 0 else _LETTERS - 2)
        fitting = next(n for n in range(len(title), -1, -1) if letters.getlength(title[:n]) <= inner)
        draw.text((_MARGIN, _MARGIN // 2 + i * line), title[:fitting], fill=_INK if i == 0 else _QUIET, font=letters)
    for i, (panel, caption) in enumerate(zip(panels, captions)):
        x, y = _MARGIN + (i % columns) * (wide + _MARGIN), top + (i // columns) * (high + line + _MARGIN)
        page.paste(panel, (x, y + line))
        most = max(4, int(wide / (0.6 * (_LETTERS - 4))))
        draw.text((x, y + 4), clipped(caption, most), fill=_QUIET, font=font(_LETTERS - 4))
    _draw_bar(draw, page, sheet, (_MARGIN, below, inner))
    return page


def _draw_bar(draw: ImageDraw.ImageDraw, page: Image.Image, sheet: Sheet, place: tuple[int, int, int]) -> None:
    """The colour bar with its ends, and a mark where the selection begins."""
    (x, y, width), letters = place, font(_LETTERS - 4)
    (low, high), high_bar = sheet.scale, _LETTERS
    ramp = (colors_of(sheet.colormap).numpy() * 255).round().astype(np.uint8)[None]
    page.paste(Image.fromarray(ramp).resize((width, high_bar)), (x, y))
    at = x + round(width * min(max((sheet.threshold - low) / (high - low), 0.0), 1.0))
    for ink, reach in (((0, 0, 0), 3), ((255, 255, 255), 1)):
        draw.line((at, y - 3, at, y + high_bar + 3), fill=ink, width=reach)
    words = f"selected above {sheet.threshold:.3g}"
    long = letters.getlength(words)
    ends = [f"{low:g}", f"{high:.2f}"]
    room = (x + letters.getlength(ends[0]) + 10, x + width - letters.getlength(ends[1]) - 10 - long)
    draw.text((x, y + high_bar + 5), ends[0], fill=_INK, font=letters)
    draw.text((x + width - letters.getlength(ends[1]), y + high_bar + 5), ends[1], fill=_INK, font=letters)
    draw.text((min(max(at - long / 2, room[0]), room[1]), y + high_bar + 5), words, fill=_INK, font=letters)
    draw.text((x, y + high_bar + 5 + round(1.2 * _LETTERS)), "relevancy", fill=_QUIET, font=letters)
