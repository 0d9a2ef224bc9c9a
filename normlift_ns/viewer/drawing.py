"""Histograms and images as MDX, for the panels of both viewers."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence

import numpy as np
from jaxtyping import UInt8
from PIL import Image
from torch import Tensor

from normlift_ns.insight.histogram import Histogram
from normlift_ns.session.state import State
from normlift_ns.session.verdicts import verdicts
from normlift_ns.viewer.legend import clipped
from normlift_ns.viewer.status import as_text, swatch

_WIDTH, _HEIGHT, _TOP, _BOTTOM = 280, 70, 14, 14
"""Size of a histogram in pixels, and margins above and below its bars."""
_BACKGROUND, _INK, _BAR = "#141414", "#ffffff", "#8c8c8c"
_MAX_SIDE, _QUALITY = 480, 80
"""Longer side of an image in pixels, and its JPEG quality."""


def histogram_svg(histogram: Histogram, color: Sequence[float]) -> str:
    """Draw the histogram of one prompt.

    The heights of the bars are logarithmic. A solid line marks the threshold, and a dashed line the suggested one.

    Args:
        color: color of the bars above the threshold, RGB in 0..1.

    >>> values = np.array([0.1] * 60 + [0.9] * 10)
    >>> from normlift_ns.insight.histogram import histogram
    >>> counts = histogram(values, np.ones(70, bool), threshold=0.5, limit=None)
    >>> histogram_svg(counts, (1, 0, 0)).count("#ff0000")
    1
    """
    low, high = float(histogram.edges[0]), float(histogram.edges[-1])
    step, height_of_bars = _WIDTH / len(histogram.counts), _HEIGHT - _TOP - _BOTTOM
    heights = np.log1p(histogram.counts) / np.log1p(max(1, histogram.counts.max())) * height_of_bars
    selected = "#" + "".join(f"{round(255 * x):02x}" for x in color)
    parts = [f'<rect width="{_WIDTH}" height="{_HEIGHT}" rx="4" fill="{_BACKGROUND}"/>']
    for i, height in enumerate(heights):
        if height > 0:
            middle = (histogram.edges[i] + histogram.edges[i + 1]) / 2
            fill = selected if middle > histogram.threshold else _BAR
            position = f'x="{i * step + 0.5:.1f}" y="{_TOP + height_of_bars - height:.1f}"'
            parts.append(f'<rect {position} width="{step - 1:.1f}" height="{height:.1f}" fill="{fill}"/>')
    for value, dash in ((histogram.suggested, "3 3"), (histogram.threshold, "")):
        x = (value - low) / (high - low) * _WIDTH
        if 0 <= x <= _WIDTH:
            x, dashed = min(max(x, 1), _WIDTH - 1), f' stroke-dasharray="{dash}"' if dash else ""
            parts.append(f'<path d="M{x:.1f} {_TOP}V{_HEIGHT - _BOTTOM}" stroke="{_INK}" stroke-width="1.5"{dashed}/>')
    x = min(max((histogram.threshold - low) / (high - low) * _WIDTH, 30), _WIDTH - 30)
    parts.append(_text(x, _TOP - 3, "middle", f"> {histogram.threshold:.2f}"))
    parts.append(_text(4, _HEIGHT - 3, "start", f"{round(low, 2) + 0.0:.2f}"))
    parts.append(_text(_WIDTH - 4, _HEIGHT - 3, "end", f"{high:.2f}"))
    box = f'width="{_WIDTH}" height="{_HEIGHT}" viewBox="0 0 {_WIDTH} {_HEIGHT}"'
    return f'<svg xmlns="http://www.w3.org/2000/svg" {box}>{"".join(parts)}</svg>'


def _text(x: float, y: float, anchor: str, text: str) -> str:
    font = f'font-family="sans-serif" font-size="10" text-anchor="{anchor}"'
    return f'<text x="{x:.1f}" y="{y}" {font} fill="{_INK}">{text.replace(">", "&gt;")}</text>'


def verdicts_mdx(state: State) -> str:
    """Return histograms and warnings of the prompts that select; empty if no prompt selects."""
    diagnostics, lines = verdicts(state), []
    for one in diagnostics:
        lines += [f"{swatch(one.colour)} {as_text(clipped(one.text, 40))}"] * (len(diagnostics) > 1)
        lines.append(_image("image/svg+xml", histogram_svg(one.histogram, one.colour).encode()))
        lines += [as_text(clipped(one.words, 400))] * (one.words != "")
    count = 0 if state.answer is None or state.shown is not None else len(state.answer.texts)
    if 0 < len(diagnostics) < count:
        lines.append(f"and {count - len(diagnostics)} more; choose one to see its histogram.")
    return "\n\n".join(lines)


def photograph_mdx(image: UInt8[Tensor, "h w 3"]) -> str:
    """Return an image as MDX, scaled down for a panel."""
    thumbnail, buffer = Image.fromarray(image.cpu().numpy()), io.BytesIO()
    thumbnail.thumbnail((_MAX_SIDE, _MAX_SIDE))
    thumbnail.save(buffer, "JPEG", quality=_QUALITY)
    return _image("image/jpeg", buffer.getvalue())


def _image(media_type: str, content: bytes) -> str:
    data = base64.b64encode(content).decode()
    return f'<img src="data:{media_type};base64,{data}" style={{{{width: "100%", borderRadius: "4px"}}}} />'
