"""The commands have the options, types and defaults of their dataclasses, each with a text; and they start."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import types
import warnings
from dataclasses import MISSING, fields, is_dataclass
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import pytest
import tyro

import normlift_ns
from normlift_ns.cli import common, start
from research.reference import COMMANDS
from tests.scripts.conftest import run_entry

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

SCRIPTS = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text("utf8"))["project"]["scripts"]
KINDS = {int: "INT", float: "FLOAT", Path: "PATH", str: "STR", bool: "True False", type(None): "None"}


def values(hint: Any) -> set[str]:
    """What an option may be: words, and kinds as the help calls them; [ for a list."""
    if get_origin(hint) is Literal:
        return set(map(str, get_args(hint)))
    if get_origin(hint) is tuple:
        return {"[", *values(get_args(hint)[0])}
    if get_origin(hint) in (Union, types.UnionType):
        return set().union(*map(values, get_args(hint)))
    return set(KINDS[hint].split())


def options(command: Any) -> dict[str, tuple[set[str], str]]:
    """Values and default, as a text, by flag, of a command and of the options within it."""
    found: dict[str, tuple[set[str], str]] = {}
    hints = get_type_hints(command, include_extras=True)
    for field in fields(command):
        hint, more = hints[field.name], ()
        while get_origin(hint) is Annotated:
            hint, *more = get_args(hint)
        if is_dataclass(hint):
            within = options(hint)
            assert not found.keys() & within.keys()
            found |= within
        elif tyro.conf.Suppress not in more and not any(getattr(part, "metavar", None) for part in more):
            default = "required" if field.default is MISSING else field.default
            default = " ".join(map(str, default)) if isinstance(default, tuple) else str(default)
            found[f"--{field.name.replace('_', '-')}"] = (values(hint), default)
    return found


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
    found = {}
    for action in shown:
        (flag,), text = action.option_strings, re.sub(r"\x1b\[\d*m", "", action.help or "")
        told = re.search(r" ?\((?:default: (.*)|(required))\)$", text, re.DOTALL)
        assert told is not None and len(text) > len(told[0]) + 10, f"{flag} has no text: {text}"
        assert "\n" not in text and ">>>" not in text, f"{flag} breaks lines: {text}"
        found[flag] = (
            set(re.findall(r"[\w-]+(?:\.\d+)?|\[", str(action.metavar))),
            told[2] or re.sub(r"^'(.*)'$", r"\1", told[1]),
        )
    wanted = options(COMMANDS[name])
    assert len(shown) == len(found) and found.keys() == wanted.keys()
    for flag, facts in wanted.items():
        assert found[flag] == facts, (name, flag)
    titles = [group.title or "" for group in parser._action_groups]
    assert not [title for title in titles if "." in title or "options options" in title]


def test_the_options_are_those_of_the_dataclasses(monkeypatch):
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
            patch.setattr(command, "run_command", begun.append)
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


def test_a_process_prints_help_of_80_columns_and_its_version():
    environment = os.environ | {"COLUMNS": "80", "TERM": "dumb", "NO_COLOR": "1"}
    program = "import sys; sys.argv[0] = 'ns-normlift-query'; from normlift_ns.cli.start import query; query()"
    printed = []
    for flag in ("--help", "--version"):
        words = [sys.executable, "-c", program, flag]
        done = subprocess.run(words, env=environment, capture_output=True, text=True, check=False)
        assert (done.returncode, done.stderr) == (0, "")
        printed.append(done.stdout)
    boxes = [line for line in printed[0].splitlines() if line.startswith(("│", "╭", "╰"))]
    assert "usage: ns-normlift-query" in printed[0] and {len(line) for line in boxes} == {80}
    assert set(options(COMMANDS["ns-normlift-query"])) <= set(re.findall(r"--[a-z][a-z0-9-]*", printed[0]))
    assert printed[1] == f"normlift_ns {normlift_ns.__version__}\n"
