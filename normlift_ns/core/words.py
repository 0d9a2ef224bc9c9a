"""Text of the user's, or of a file, as it is safe to show: nothing in it moves the cursor, hides or turns around."""

from __future__ import annotations


def visible(text: str) -> str:
    r"""The text on one line, with escapes in place of characters that are not printed themselves.

    >>> print(visible("red\x1b[31m mug\n"))
    red\x1b[31m mug\n
    """
    return "".join(c if c.isprintable() else c.encode("unicode_escape", "surrogatepass").decode() for c in text)
