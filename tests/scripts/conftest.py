"""Commands, as the tests give them."""

from __future__ import annotations

import sys

import pytest

SMALL = ("--encoder", "colour", "--k", "12")
"""Flags that lift the small demo room in a moment."""
QUICK = (*SMALL, "--check", "False")
"""The same without comparing the photographs first."""


def said(capsys: pytest.CaptureFixture[str]) -> str:
    """What was printed, results and then errors, without line breaks."""
    shown = capsys.readouterr()
    return " ".join((shown.out + shown.err).split())


def run_entry(monkeypatch: pytest.MonkeyPatch, entrypoint, *flags: object) -> int:
    """Exit code of a command."""
    monkeypatch.setattr(sys, "argv", ["command", *map(str, flags)])
    try:
        entrypoint()
    except SystemExit as stop:
        return int(stop.code or 0)
    return 0
