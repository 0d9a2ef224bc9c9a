"""What the commands have in common: flags with their help, and errors that users can act on."""

from __future__ import annotations

import sys
from dataclasses import fields, is_dataclass
from typing import Annotated, Any, Protocol, get_type_hints

import docstring_parser
import tyro
from rich.console import Console

import normlift_ns

CONSOLE = Console(width=120)


class Command(Protocol):
    """A command: a dataclass of its flags."""

    def main(self) -> object:
        """Does it."""
        ...


def run_command(command: type[Command]) -> None:
    """Reads the flags in the form of nerfstudio's commands (--flag True) and runs the command.

    Errors of flags, input, files, disks and memory become a message and exit code 1, Ctrl-C exit code 130.
    """
    if "--version" in sys.argv[1:]:
        print(f"normlift_ns {normlift_ns.__version__}")
        return
    tyro.extras.set_accent_color("bright_yellow")
    try:
        flags: Any = tyro.conf.OmitArgPrefixes[tyro.conf.FlagConversionOff[with_help(command)]]
        tyro.cli(flags, description=summary(command)).main()
    except SystemExit as stop:  # tyro's own, 2 for flags that it cannot read
        sys.exit(1 if stop.code == 2 else stop.code)
    except (ValueError, OSError, MemoryError) as error:
        CONSOLE.rule("Error", style="red")
        CONSOLE.print(str(error), justify="center", markup=False, highlight=False)
        sys.exit(1)
    except KeyboardInterrupt:
        CONSOLE.print("Interrupted. No partial files remain; rerun the command to resume.")
        sys.exit(130)


def with_help(options: Any, *, nested: bool = False) -> Any:
    """The dataclass, with the docstring under each field as the help of its flag, and the first paragraph of its own as
    the help of all of them.

    tyro reads docstrings itself, but keeps the line breaks that are there because lines of code are short. Options in
    the options of a command join their group.
    """
    hints = get_type_hints(options, include_extras=True)
    texts = {found.arg_name: found.description or "" for found in docstring_parser.parse_from_object(options).params}
    for field in fields(options):
        hint, text, name = hints[field.name], texts.get(field.name, ""), None
        if is_dataclass(hint):
            with_help(hint, nested=True)
            text, name = summary(hint), "" if nested else None
        options.__annotations__[field.name] = Annotated[hint, tyro.conf.arg(name=name, help=" ".join(text.split()))]
    return options


def summary(options: Any) -> str:
    """The first paragraph of a docstring, in one line."""
    return " ".join((options.__doc__ or "").split("\n\n")[0].split())
