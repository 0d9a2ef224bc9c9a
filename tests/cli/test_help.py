"""The commands have the options of the reference page, each with a text; and they start."""

import os
import re
import sys
import warnings
from importlib import import_module
from typing import Any
from unittest.mock import Mock

import pytest
import tyro

import normlift_ns
from normlift_ns.cli import common, start
from research.reference import COMMANDS, section
from tests.cli.conftest import run_entry
from tests.conftest import project

SCRIPTS = project()["scripts"]


@pytest.mark.parametrize("name", COMMANDS)
def test_the_options_are_those_of_the_reference(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
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
    for action in shown:
        (flag,), text = action.option_strings, re.sub(r"\x1b\[\d*m", "", action.help or "")
        told = re.search(r" ?\((?:default: (.*)|(required))\)$", text, re.DOTALL)
        assert told is not None and len(text) > len(told[0]) + 10, f"{flag} has no text: {text}"
        assert "\n" not in text and ">>>" not in text, f"{flag} breaks lines: {text}"
    assert sorted(action.option_strings[0] for action in shown) == sorted(documented)


def test_every_command_starts_its_module_and_ends_when_it_is_interrupted_meanwhile(monkeypatch, capsys):
    assert SCRIPTS.keys() == COMMANDS.keys()
    monkeypatch.setattr(os, "_exit", sys.exit)
    for name, place in SCRIPTS.items():
        function = place.removeprefix("normlift_ns.cli.start:")
        command, begun = import_module(f"normlift_ns.cli.{function}"), []
        with monkeypatch.context() as patch:
            patch.setattr(common, "run_command_process", begun.append)
            getattr(start, function)()
            for holder in (common, command):
                patch.setattr(holder, "run_command", begun.append, raising=False)
            command.entrypoint()
        assert begun == [COMMANDS[name]] * 2, name
        assert run_entry(monkeypatch, command.entrypoint, "--version") == 0
        assert capsys.readouterr() == (f"normlift_ns {normlift_ns.__version__}\n", "")
        with monkeypatch.context() as patch, pytest.raises(SystemExit) as stop:
            patch.setattr(start, "import_module", Mock(side_effect=KeyboardInterrupt))
            getattr(start, function)()
        assert (stop.value.code, capsys.readouterr()) == (130, ("", "Interrupted.\n"))
