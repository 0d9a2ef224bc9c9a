"""Escaped text and color swatches as MDX, which the viewer compiles."""

from __future__ import annotations

from collections.abc import Sequence

from normlift_ns.errors import visible


def as_text(text: str) -> str:
    """Escape a text so that MDX shows it literally.

    Possible markup or code becomes character references, and unprintable characters become escape sequences.

    >>> as_text("a {b}")
    'a &#123;b&#125;'
    """
    return "".join(c if c.isalnum() or c == " " else f"&#{ord(c)};" for c in visible(text, keep="\n"))


def swatch(color: Sequence[float]) -> str:
    """Return a colored square as MDX.

    Args:
        color: RGB in 0..1.
    """
    red, green, blue = (round(255 * x) for x in color)
    return f'<span style={{{{color: "rgb({red},{green},{blue})"}}}}>■</span>'
