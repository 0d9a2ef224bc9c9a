"""Drawings in a panel: a histogram with its threshold, and photographs, as MDX that both viewers show."""

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

_WIDTH, _HEIGHT, _TOP, _FOOT = 280, 70, 14, 14
"""Of a histogram: its size, and the room above and below its bars."""
_BACKDROP, _INK, _REST = "#141414", "#ffffff", "#8c8c8c"
_SIDE, _QUALITY = 480, 80
"""Longer side of a photograph in pixels, and quality of its JPEG file."""


def histogram_svg(histogram: Histogram, colour: Sequence[float]) -> str:
    """The histogram of one prompt: bars, the higher the more Gaussians (logarithmic), a line at the threshold, a dashed
    one where a threshold is suggested.

    Args:
        colour: of the bars above the threshold, RGB in 0..1.

    >>> values = np.array([0.1] * 60 + [0.9] * 10)
    >>> from normlift_ns.insight.histogram import histogram
    >>> found = histogram(values, np.ones(70, bool), threshold=0.5, limit=None)
    >>> histogram_svg(found, (1, 0, 0)).count("#ff0000")
    1
    """
    low, high = float(histogram.edges[0]), float(histogram.edges[-1])
    step, room = _WIDTH / len(histogram.counts), _HEIGHT - _TOP - _FOOT
    heights = np.log1p(histogram.counts) / np.log1p(max(1, histogram.counts.max())) * room
    chosen = "#" + "".join(f"{round(255 * x):02x}" for x in colour)
    parts = [f'<rect width="{_WIDTH}" height="{_HEIGHT}" rx="4" fill="{_BACKDROP}"/>']
    for i, height in enumerate(heights):
        if height > 0:
            middle = (histogram.edges[i] + histogram.edges[i + 1]) / 2
            fill = chosen if middle > histogram.threshold else _REST
            place = f'x="{i * step + 0.5:.1f}" y="{_TOP + room - height:.1f}"'
            parts.append(f'<rect {place} width="{step - 1:.1f}" height="{height:.1f}" fill="{fill}"/>')
    for value, dash in ((histogram.suggested, "3 3"), (histogram.threshold, "")):
        x = (value - low) / (high - low) * _WIDTH
        if 0 <= x <= _WIDTH:
            x, dashed = min(max(x, 1), _WIDTH - 1), f' stroke-dasharray="{dash}"' if dash else ""
            parts.append(f'<path d="M{x:.1f} {_TOP}V{_HEIGHT - _FOOT}" stroke="{_INK}" stroke-width="1.5"{dashed}/>')
    x = min(max((histogram.threshold - low) / (high - low) * _WIDTH, 30), _WIDTH - 30)
    parts.append(_text(x, _TOP - 3, "middle", f"> {histogram.threshold:.2f}"))
    parts.append(_text(4, _HEIGHT - 3, "start", f"{round(low, 2) + 0.0:.2f}"))
    parts.append(_text(_WIDTH - 4, _HEIGHT - 3, "end", f"{high:.2f}"))
    box = f'width="{_WIDTH}" height="{_HEIGHT}" viewBox="0 0 {_WIDTH} {_HEIGHT}"'
    return f'<svg xmlns="http://www.w3.org/2000/svg" {box}>{"".join(parts)}</svg>'


def _text(x: float, y: float, anchor: str, text: str) -> str:
    shown = text.replace(">", "&gt;")
    font = f'font-family="sans-serif" font-size="10" text-anchor="{anchor}"'
    return f'<text x="{x:.1f}" y="{y}" {font} fill="{_INK}">{shown}</text>'


def verdicts_mdx(state: State) -> str:
    """The histograms of the prompts that select, and which of them are probably not in the scene; empty: of none."""
    found, lines = verdicts(state), []
    for one in found:
        lines += [f"{swatch(one.colour)} {as_text(clipped(one.text, 40))}"] * (len(found) > 1)
        lines.append(_image("image/svg+xml", histogram_svg(one.histogram, one.colour).encode()))
        lines += [as_text(clipped(one.words, 400))] * (one.words != "")
    count = 0 if state.answer is None or state.shown is not None else len(state.answer.texts)
    if 0 < len(found) < count:
        lines.append(f"and {count - len(found)} more; choose one to see its histogram.")
    return "\n\n".join(lines)


def photograph_mdx(image: UInt8[Tensor, "h w 3"]) -> str:
    """A photograph as MDX, small enough for a panel."""
    small, file = Image.fromarray(image.cpu().numpy()), io.BytesIO()
    small.thumbnail((_SIDE, _SIDE))
    small.save(file, "JPEG", quality=_QUALITY)
    return _image("image/jpeg", file.getvalue())


def _image(kind: str, content: bytes) -> str:
    data = base64.b64encode(content).decode()
    return f'<img src="data:{kind};base64,{data}" style={{{{width: "100%", borderRadius: "4px"}}}} />'
