"""One-line messages for command-line errors, in place of the boxes that tyro draws on standard error."""

from __future__ import annotations

import io
import os
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr
from pathlib import Path

from normlift_ns.errors import InputError

_CORNERS = ("╭", "┏")
_REWRITES = (
    (r"Error parsing (--\S+): no type matching \S+ could be instantiated from \[(.*)\]\.", r"\1 cannot be \2."),
    (r"Error parsing (--\S+): (?:invalid literal|could not convert).*?: ('.*')$", r"\1 cannot be \2."),
    (r"Error parsing \S+: (?=--)", r""),
    (r"invalid choice ('.*?') for argument '(--\S+)'\.", r"\2 cannot be \1."),
    (r"Expected one of \((.*?),?\)\.", r"Expected one of \1."),
    (r"Missing value for argument '(--\S+)'\. Expected 1 values\.", r"\1 needs a value."),
    (r"Missing from (\S+):", r"\1 needs:"),
    (r"Unrecognized options:", r"Unknown options:"),
    (r"\n+ *Got errors:(?:\n *- .*)*", r""),
    (r" *Argument helptext:\n", r""),
    (r"^ {3,}(--\S+ \S.*)\n +", r"\1: "),
    (r"For full helptext, (?:run|see):?\s+(\S.*?) --help", r"\n\nAll options: \1 --help"),
)
"""tyro's phrases and their replacements; the phrases of other tyro versions stay as they are."""


@contextmanager
def plain_errors(program: str) -> Iterator[None]:
    """Raise InputError where tyro would draw a box on standard error and exit; print warnings afterwards.

    Args:
        program: Program name that tyro prints; messages show it without its folder.
    """
    stderr, columns = io.StringIO(), os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = "1000"  # keeps tyro from wrapping lines
    try:
        with redirect_stderr(stderr):
            yield
        sys.stderr.write(stderr.getvalue())
    except SystemExit as stop:
        if stop.code in (None, 0):
            raise
        raise InputError(_unboxed(stderr.getvalue(), program)) from None
    finally:
        os.environ.pop("COLUMNS")
        if columns is not None:
            os.environ["COLUMNS"] = columns


def _unboxed(stderr: str, program: str) -> str:
    r"""Return the text inside tyro's box, or below its dashed line if the terminal has no box characters.

    >>> print(_unboxed("╭─ Missing ─╮\n│ Missing value for argument '--k'. Expected 1 values. │\n╰─────╯", "/bin/x"))
    --k needs a value.
    >>> print(_unboxed(" Missing\n -----\n  Missing value for argument '--k'. Expected 1 values.\n", "/bin/x"))
    --k needs a value.
    """
    stderr = re.sub(r"\x1b\[[\d;]*m", "", stderr)  # terminal colors
    lines = stderr.splitlines()
    lines = lines[1:-1] if stderr.startswith(_CORNERS) else lines[2:]
    lines = [line.strip("│┃").removeprefix(" ").rstrip(" ─━") for line in lines]
    text = "\n".join("" if set(line) <= set(" -") else line for line in lines)
    text = text.replace(program, Path(program).name)
    for pattern, replacement in _REWRITES:
        text = re.sub(pattern, replacement, text, flags=re.MULTILINE)
    parts = [" ".join(part.split()) for part in text.split("\n\n")]
    return " ".join(part if part.endswith((".", ":", "--help")) else f"{part}." for part in parts if part)
