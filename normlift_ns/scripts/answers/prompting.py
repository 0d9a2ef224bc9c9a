"""Asking a lifted run text after text: at a prompt, or line by line from a pipe."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from rich.table import Table

from normlift_ns.crash import state_folder
from normlift_ns.errors import InputError
from normlift_ns.insight.histogram import bars
from normlift_ns.question import Question
from normlift_ns.quick import QuickRun
from normlift_ns.scripts.shared import CONSOLE, plain, say, say_error

_HISTORY = "history"


def converse(run: QuickRun, rules: Mapping[str, Any], *, keep_history: bool) -> None:
    """Asks what a person types, one text a line, until Ctrl-D. A mistake costs a message.

    Args:
        rules: as `QuickRun.ask` takes them.
    """
    from prompt_toolkit import PromptSession  # noqa: PLC0415 (only needed here)
    from prompt_toolkit.history import FileHistory, InMemoryHistory  # noqa: PLC0415

    file = _history_file() if keep_history else None
    session = PromptSession(history=InMemoryHistory() if file is None else FileHistory(str(file)))
    say(f"{len(run.field.arrays['source']):,} Gaussians. One text a line; Ctrl-D ends.")
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
            found = run.ask([text], **rules)
        except (InputError, OSError, MemoryError) as error:
            say_error(str(error))
        else:
            show(found.summarize(), found.question)


def _history_file() -> Path | None:
    """The file of texts asked before, which only the user can read; None where there is no place for one."""
    with suppress(OSError):
        folder = state_folder()
        if folder is not None:
            folder.mkdir(parents=True, exist_ok=True)
            os.close(os.open(folder / _HISTORY, os.O_RDWR | os.O_CREAT, 0o600))
            (folder / _HISTORY).chmod(0o600)
            return folder / _HISTORY
    return None


def answer_lines(run: QuickRun, rules: Mapping[str, Any], lines: Iterable[bytes] | None = None) -> None:
    """Asks every line, and prints one line of JSON for each as soon as it is answered; empty lines are passed over.

    Args:
        rules: as `QuickRun.ask` takes them.
        lines: None: of the standard input.
    Raises:
        ValueError: some lines could not be answered; each of them was printed with its `error`.
    """
    stdin: Any = sys.stdin  # None where it is closed
    given: Iterable[bytes] = (() if stdin is None else stdin.buffer) if lines is None else lines
    if sys.stdout is None:
        raise InputError("the standard output is closed; --stdin prints its answers there")
    failed = asked = 0
    for line in given:
        text = line.decode("utf8", "replace").lstrip("\ufeff").strip()  # Windows begins files with that character
        if text == "":
            continue
        asked += 1
        try:
            found = run.ask([text], **rules)
            (row,) = found.summarize()
            answered = {**row, "rule": found.question.rule, "threshold": found.question.threshold}
        except InputError as error:
            failed += 1
            answered = {"text": text, "error": str(error)}
        sys.stdout.write(json.dumps(answered) + "\n")
        sys.stdout.flush()
    if failed > 0:
        raise InputError(f"{failed} of {asked} lines could not be answered; their `error` says why")


def show(rows: list[dict[str, Any]], question: Question) -> None:
    """Prints the table of an answer, and what to know of texts that do not stand out."""
    shown = table(rows, f"{question.rule} > {question.threshold:.4g}", question.threshold, narrow=CONSOLE.width < 100)
    CONSOLE.print(shown)
    for row in rows:
        if row["stands_out"] is False:
            say(f"{row['text']}: probably not in this scene. {_nearest(row)}")


def _nearest(row: Mapping[str, Any]) -> str:
    """Where the scene is most like a text."""
    top, limit = row["histogram"]["top"], row["histogram"]["limit"]
    place = "" if row["nearest"] is None else f" at {' '.join(f'{x:.2f}' for x in row['nearest'])}"
    return f"The nearest match{place} has relevancy {top:.3f}; things that are in a scene reach {limit:.3g} or more."


def _bars(spread: Mapping[str, Any] | None, threshold: float) -> str:
    return "-" if spread is None else bars(spread["counts"], spread["low"], spread["high"], threshold)


def table(rows: list[dict[str, Any]], rule: str, threshold: float, *, narrow: bool = False) -> Table:
    """The numbers of every text; its histogram has a bar | at the threshold, and is left out of a narrow table."""
    made = Table(title=f"Selected: {rule}; centroid and extent in scene units", padding=(0, 0 if narrow else 1))
    wrapped = ("text", "centroid", "extent")
    for name in ("text", "Gaussians", "centroid", "extent", "peak", "reliability"):
        justify = "left" if name == "text" else "right"
        made.add_column(name, justify=justify, no_wrap=name not in wrapped, overflow="fold")
    if not narrow:
        made.add_column("histogram", no_wrap=True)
    made.add_column("suggested", justify="right", no_wrap=True)
    for row in rows:
        vectors = (" ".join(f"{x:.2f}" for x in row[name]) if row[name] else "-" for name in ("centroid", "extent"))
        numbers = (f"{row[name]:.3f}" if row[name] is not None else "-" for name in ("peak", "mean_reliability"))
        suggested = "-" if row["suggested_threshold"] is None else f"{row['suggested_threshold']:.3f}"
        line = () if narrow else (plain(_bars(row["histogram"], threshold)),)
        made.add_row(plain(row["text"]), f"{row['fraction']:.2%}", *vectors, *numbers, *line, suggested)
    return made
