"""The commands have the options of the reference page, each with a text; and they start."""

import os
import re
import sys
import warnings
from importlib import import_module
from typing import Any

import pytest
import tyro

import normlift_ns
from normlift_ns.cli import common, start
from research.reference import COMMANDS, section
from tests.cli.conftest import run_entry
from tests.conftest import project

SCRIPTS = project()["scripts"]


def check_options(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    made: dict[str, Any] = {}
    monkeypatch.setattr(tyro, "cli", lambda flags, **how: made.update(flags=flags, **how))
    common.parse_flags(COMMANDS[name], ["--help"], name)
    assert made["prog"] == name and "--quiet" in made["description"] and "--log-file" in made["description"]
    summary = " ".join((COMMANDS[name].__doc__ or "").split("\n\n")[0].split())
    assert made["description"].startswith(summary) and "Raises" not in made["description"]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        parser = tyro.extras.get_parser(made["flags"], prog=name)
    shown = [action for action in parser._actions if action.option_strings[:1] and action.dest != "help"]
    classes = {COMMANDS[name], *COMMANDS[name].__mro__} & set(COMMANDS.values())  # ns-normlift-check is an ns-normlift
    documented = set(re.findall(r"^\| `(--[\w-]+)`", "".join(section("", c) for c in classes), re.MULTILINE))
    documented -= {"--dry-run"} if name == "ns-normlift-check" else set()
    found = []
    for action in shown:
        (flag,), text = action.option_strings, re.sub(r"\x1b\[\d*m", "", action.help or "")
        told = re.search(r" ?\((?:default: (.*)|(required))\)$", text, re.DOTALL)
        assert told is not None and len(text) > len(told[0]) + 10, f"{flag} has no text: {text}"
        assert "\n" not in text and ">>>" not in text, f"{flag} breaks lines: {text}"
        found.append(flag)
    assert len(shown) == len(found) and set(found) == documented
    titles = [group.title or "" for group in parser._action_groups]
    assert not [title for title in titles if "." in title or "options options" in title]


def test_the_options_are_those_of_the_reference(monkeypatch):
    for name in COMMANDS:
        check_options(name, monkeypatch)


def test_every_command_starts_its_module_and_ends_when_it_is_interrupted_meanwhile(monkeypatch, capsys):
    assert SCRIPTS.keys() == COMMANDS.keys()
    monkeypatch.setattr(os, "_exit", sys.exit)
    for name, place in SCRIPTS.items():
        module, function = place.split(":")
        assert module == "normlift_ns.cli.start"
        begun: list[Any] = []
        with monkeypatch.context() as patch:
            command = import_module(f"normlift_ns.cli.{function}")
            patch.setattr(common, "run_command_process", begun.append)
            getattr(start, function)()
            assert begun == [COMMANDS[name]], name
            for holder in (common, command):
                patch.setattr(holder, "run_command", begun.append, raising=False)
            command.entrypoint()
            assert begun == [COMMANDS[name]] * 2, name
        assert run_entry(monkeypatch, command.entrypoint, "--version") == 0
        assert capsys.readouterr() == (f"normlift_ns {normlift_ns.__version__}\n", "")
        with monkeypatch.context() as patch:

            def interrupted(module: str, begun: list[Any] = begun) -> None:
                begun.append(module)
                raise KeyboardInterrupt

            patch.setattr(start, "import_module", interrupted)
            with pytest.raises(SystemExit) as stop:
                getattr(start, function)()
        assert (stop.value.code, begun[2:]) == (130, [f"normlift_ns.cli.{function}"])
        assert capsys.readouterr() == ("", "Interrupted.\n")
