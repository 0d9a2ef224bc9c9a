"""The error that every loader and every check raises, so that a mistake of the user's can be told from ours."""

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
