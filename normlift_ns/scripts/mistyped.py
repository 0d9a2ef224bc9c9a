"""Flags that tyro cannot read: its box on standard error becomes one line, like every other error."""

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
_WORDS = (
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
"""What it says, and how it is said here; a version that says it otherwise is quoted."""


@contextmanager
def plain_errors(program: str) -> Iterator[None]:
    """Raises InputError where tyro draws a box on standard error and ends the process. Warnings are printed afterwards.

    Args:
        program: as tyro calls the command; it is named without its folder.
    """
    told, columns = io.StringIO(), os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = "1000"  # so that no line is broken
    try:
        with redirect_stderr(told):
            yield
        sys.stderr.write(told.getvalue())
    except SystemExit as stop:
        if stop.code in (None, 0):
            raise
        raise InputError(_plain(told.getvalue(), program)) from None
    finally:
        os.environ.pop("COLUMNS")
        if columns is not None:
            os.environ["COLUMNS"] = columns


def _plain(told: str, program: str) -> str:
    r"""The text in the box; where the output knows no such lines, below a dashed one.

    >>> print(_plain("╭─ Missing ─╮\n│ Missing value for argument '--k'. Expected 1 values. │\n╰─────╯", "/bin/x"))
    --k needs a value.
    >>> print(_plain(" Missing\n -----\n  Missing value for argument '--k'. Expected 1 values.\n", "/bin/x"))
    --k needs a value.
    """
    told = re.sub(r"\x1b\[[\d;]*m", "", told)  # colours of a terminal
    lines = told.splitlines()
    lines = lines[1:-1] if told.startswith(_CORNERS) else lines[2:]
    lines = [line.strip("│┃").removeprefix(" ").rstrip(" ─━") for line in lines]
    text = "\n".join("" if set(line) <= set(" -") else line for line in lines)
    text = text.replace(program, Path(program).name)
    for said, plain in _WORDS:
        text = re.sub(said, plain, text, flags=re.MULTILINE)
    parts = [" ".join(part.split()) for part in text.split("\n\n")]
    return " ".join(part if part.endswith((".", ":", "--help")) else f"{part}." for part in parts if part)
