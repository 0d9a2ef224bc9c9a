"""InputError for the user's mistakes as opposed to internal errors, and safe display of foreign text."""

from __future__ import annotations


class InputError(ValueError):
    """Error for an invalid file or argument.

    The message names the file or argument, what was found, what was expected and what to do. Missing files raise
    `FileNotFoundError`, and files that cannot be written `OSError`; any other exception is an internal error.

    >>> from normlift_ns import InputError, LiftOptions
    >>> try:
    ...     LiftOptions(max_views=0)
    ... except InputError as error:
    ...     print(error)
    max_views must be at least 1, got 0
    """


class OutputError(Exception):
    """Failed write to standard output. Not an OSError, which loaders would attribute to the file that they read."""


def visible(text: str, keep: str = "") -> str:
    r"""Escape unprintable characters, which could move the cursor, hide text or reverse it.

    Args:
        text: Text from outside, such as a prompt or a path.
        keep: Unprintable characters to keep, for example a line break.

    >>> print(visible("red\x1b[31m mug\n"))
    red\x1b[31m mug\n
    """
    return "".join(
        c if c.isprintable() or c in keep else c.encode("unicode_escape", "surrogatepass").decode() for c in text
    )


def shortened(text: str, most: int = 40) -> str:
    """Cut a text to at most `most` characters.

    >>> shortened("a red bowl", 8)
    'a red b…'
    """
    return text if len(text) <= most else text[: most - 1] + "…"
