"""Interactive queries of a lifted run: at a terminal prompt, or line by line from a pipe."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from rich.table import Table

from normlift_ns.cli.common import CONSOLE, info, plain_text, print_error
from normlift_ns.errors import InputError, user_state_folder
from normlift_ns.query.arrays import QuickRun
from normlift_ns.query.engine import draw_histogram
from normlift_ns.query.question import Query

_HISTORY = "history"


def run_repl(run: QuickRun, rules: Mapping[str, Any], *, keep_history: bool) -> None:
    """Answer prompts that a user types, one per line, until Ctrl-D; invalid prompts print an error message.

    Args:
        run: The lifted run.
        rules: Keyword arguments of `QuickRun.ask`.
        keep_history: Store prompts in the history file.
    """
    from prompt_toolkit import PromptSession  # noqa: PLC0415 (only needed here)
    from prompt_toolkit.history import FileHistory, InMemoryHistory  # noqa: PLC0415

    file = _history_file() if keep_history else None
    session = PromptSession(history=InMemoryHistory() if file is None else FileHistory(str(file)))
    info(f"{len(run.field.arrays['source']):,} Gaussians. Type one prompt per line; Ctrl-D quits.")
    while True:
        try:
            text = session.prompt("> ").strip()
        except KeyboardInterrupt:
            continue
        except EOFError:
            return
        if text == "":
            continue
        try:
            answer = run.ask([text], **rules)
        except (InputError, OSError, MemoryError) as error:
            print_error(str(error))
        else:
            print_answer(answer.to_json(), answer.question)


def _history_file() -> Path | None:
    """Return the history file, which only the user can read; None if it cannot be created."""
    with suppress(OSError):
        folder = user_state_folder()
        if folder is not None:
            folder.mkdir(parents=True, exist_ok=True)
            os.close(os.open(folder / _HISTORY, os.O_RDWR | os.O_CREAT, 0o600))
            (folder / _HISTORY).chmod(0o600)
            return folder / _HISTORY
    return None


def answer_lines(run: QuickRun, rules: Mapping[str, Any], lines: Iterable[bytes] | None = None) -> None:
    """Answer one prompt per line, and print each answer immediately as one line of JSON; skip empty lines.

    Args:
        run: The lifted run.
        rules: Keyword arguments of `QuickRun.ask`.
        lines: The prompts; None: lines of standard input.
    Raises:
        ValueError: Some lines failed; the JSON line of each has an `error`.
    """
    stdin: Any = sys.stdin  # None if it is closed
    source: Iterable[bytes] = (() if stdin is None else stdin.buffer) if lines is None else lines
    if sys.stdout is None:
        raise InputError("standard output is closed; --stdin prints its answers there")
    failed = total = 0
    for line in source:
        text = line.decode("utf8", "replace").lstrip("\ufeff").strip()  # byte order mark of files from Windows
        if text == "":
            continue
        total += 1
        try:
            answer = run.ask([text], **rules)
            (row,) = answer.to_json()
            output = {**row, "rule": answer.question.rule, "threshold": answer.question.threshold}
        except InputError as error:
            failed += 1
            output = {"text": text, "error": str(error)}
        sys.stdout.write(json.dumps(output) + "\n")
        sys.stdout.flush()
    if failed > 0:
        raise InputError(f"{failed} of {total} lines could not be answered; see their `error` for the reasons")


def print_answer(rows: list[dict[str, Any]], question: Query) -> None:
    """Print the table of an answer, and a note for each prompt that is probably not in the scene."""
    rule = f"{question.rule} > {question.threshold:.4g}"
    CONSOLE.print(answer_table(rows, rule, question.threshold, narrow=CONSOLE.width < 100))
    for row in rows:
        if row["stands_out"] is False:
            info(f"{row['text']}: probably not in this scene. {_nearest_match(row)}")


def _nearest_match(row: Mapping[str, Any]) -> str:
    """Describe the position and relevancy of the best match of a prompt."""
    top, limit = row["histogram"]["top"], row["histogram"]["limit"]
    position = "" if row["nearest"] is None else f" at {' '.join(f'{x:.2f}' for x in row['nearest'])}"
    return (
        f"The nearest match{position} has relevancy {top:.3f}; objects in a scene usually reach at least {limit:.3g}."
    )


def _bars(histogram: Mapping[str, Any] | None, threshold: float) -> str:
    return (
        "-"
        if histogram is None
        else draw_histogram(histogram["counts"], histogram["low"], histogram["high"], threshold)
    )


def answer_table(rows: list[dict[str, Any]], rule: str, threshold: float, *, narrow: bool = False) -> Table:
    """Return a table with one row per prompt.

    Args:
        rows: Rows of `Answer.to_json`.
        rule: Selection rule for the title, such as lerf > 0.5.
        threshold: Threshold that each histogram marks with a bar |.
        narrow: Leave out the histograms.
    """
    result = Table(title=f"Selected: {rule}; centroid and extent in scene units", padding=(0, 0 if narrow else 1))
    wrapped = ("text", "centroid", "extent")
    for name in ("text", "Gaussians", "centroid", "extent", "peak", "reliability"):
        justify = "left" if name == "text" else "right"
        result.add_column(name, justify=justify, no_wrap=name not in wrapped, overflow="fold")
    if not narrow:
        result.add_column("histogram", no_wrap=True)
    result.add_column("suggested", justify="right", no_wrap=True)
    for row in rows:
        vectors = (" ".join(f"{x:.2f}" for x in row[name]) if row[name] else "-" for name in ("centroid", "extent"))
        numbers = (f"{row[name]:.3f}" if row[name] is not None else "-" for name in ("peak", "mean_reliability"))
        suggested = "-" if row["suggested_threshold"] is None else f"{row['suggested_threshold']:.3f}"
        histogram = () if narrow else (plain_text(_bars(row["histogram"], threshold)),)
        result.add_row(plain_text(row["text"]), f"{row['fraction']:.2%}", *vectors, *numbers, *histogram, suggested)
    return result
