"""The reference of the commands is that of the code, and the site has a page for every public name."""

import re
from pathlib import Path

import pytest

import normlift_ns
from benchmarks.reference import COMMANDS, PAGE, page

HELP = Path(__file__).parent / "scripts" / "help"
"""Snapshots of what the commands print; tests/scripts/test_help.py holds the commands against them."""
ROW = re.compile(r"^(--[a-z][a-z0-9-]*) (?:\{[^}]*\}|STR|INT|FLOAT|PATH|\[)", re.MULTILINE)


def test_the_page_is_made_of_the_code():
    assert PAGE.read_text("utf8") == page(), "refresh it: python -m benchmarks.reference"


@pytest.mark.parametrize("name", COMMANDS)
def test_the_page_has_the_options_that_the_command_has(name):
    parts = re.split(r"^## (.+)$", PAGE.read_text("utf8"), flags=re.MULTILINE)
    sections = dict(zip(parts[1::2], parts[2::2], strict=True))
    listed = {
        title: set(re.findall(r"^\| `(--[a-z0-9-]+)` \|", text, re.MULTILINE)) for title, text in sections.items()
    }
    text = (HELP / f"{name.removeprefix('ns-normlift').strip('-') or 'lift'}.txt").read_text("utf8")
    inherited = listed["ns-normlift"] - {"--dry-run"} if name == "ns-normlift-check" else set()
    assert listed[name] | inherited == set(ROW.findall(text))


def test_every_public_name_is_in_the_reference():
    shown = re.findall(r"^::: normlift_ns\.[\w.]*?(\w+)$", (PAGE.parent / "api.md").read_text("utf8"), re.MULTILINE)
    assert sorted(shown) == sorted(normlift_ns.__all__)
