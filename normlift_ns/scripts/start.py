"""Entry points of the commands, which are loaded here so that Ctrl-C meanwhile ends them without a traceback."""

from __future__ import annotations

import os
import sys
from importlib import import_module


def _start(command: str) -> None:
    try:
        import_module(f"normlift_ns.scripts.{command}").main()
    except KeyboardInterrupt:  # later ones are told by the command itself
        sys.stderr.write("Interrupted.\n")
        sys.stderr.flush()
        os._exit(130)


def lift() -> None:
    """ns-normlift"""
    _start("lift")


def query() -> None:
    """ns-normlift-query"""
    _start("query")


def export() -> None:
    """ns-normlift-export"""
    _start("export")


def evaluate() -> None:
    """ns-normlift-eval"""
    _start("evaluate")


def view() -> None:
    """ns-normlift-view"""
    _start("view")


def batch() -> None:
    """ns-normlift-batch"""
    _start("batch")


def check() -> None:
    """ns-normlift-check"""
    _start("check")
