"""The error that every loader and every check raises, so that a mistake of the user's can be told from ours; and how
text from outside is shown."""

from __future__ import annotations


class InputError(ValueError):
    """A file or an argument is not what it should be.

    The message names it, and says what was found, what was expected and what to do. What is missing is a
    `FileNotFoundError`, and what cannot be written an `OSError`; any other exception is a mistake of the program.

    >>> from normlift_ns import InputError, LiftOptions
    >>> try:
    ...     LiftOptions(max_views=0)
    ... except InputError as error:
    ...     print(error)
    max_views must be at least 1, got 0
    """


class OutputError(Exception):
    """Standard output takes no more. No OSError, which loaders take for one of the file that they read."""


def visible(text: str, keep: str = "") -> str:
    r"""The text with escapes in place of characters that are not printed themselves, so that nothing in it moves the
    cursor, hides or turns around.

    Args:
        keep: such characters that stay, for example a line break.

    >>> print(visible("red\x1b[31m mug\n"))
    red\x1b[31m mug\n
    """
    return "".join(
        c if c.isprintable() or c in keep else c.encode("unicode_escape", "surrogatepass").decode() for c in text
    )


def shortened(text: str, most: int = 40) -> str:
    """The text, cut where it is longer than `most` characters.

    >>> shortened("a red bowl", 8)
    'a red b…'
    """
    return text if len(text) <= most else text[: most - 1] + "…"
