"""Entry points that import their command late, so that Ctrl-C during the import prints no traceback."""

from __future__ import annotations

import os
import sys
from importlib import import_module


def _start(command: str) -> None:
    try:
        import_module(f"normlift_ns.cli.{command}").main()
    except KeyboardInterrupt:  # the command itself handles later ones
        sys.stderr.write("Interrupted.\n")
        sys.stderr.flush()
        os._exit(130)


def lift() -> None:
    """Run ns-normlift."""
    _start("lift")


def query() -> None:
    """Run ns-normlift-query."""
    _start("query")


def export() -> None:
    """Run ns-normlift-export."""
    _start("export")


def evaluate() -> None:
    """Run ns-normlift-eval."""
    _start("evaluate")


def view() -> None:
    """Run ns-normlift-view."""
    _start("view")


def batch() -> None:
    """Run ns-normlift-batch."""
    _start("batch")


def check() -> None:
    """Run ns-normlift-check."""
    _start("check")
