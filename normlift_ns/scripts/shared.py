"""What the commands have in common: errors that users can act on, and the device."""

from __future__ import annotations

import sys
from typing import Protocol

import torch
import tyro
from rich.console import Console

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
    tyro.extras.set_accent_color("bright_yellow")
    try:
        tyro.cli(tyro.conf.OmitArgPrefixes[tyro.conf.FlagConversionOff[command]]).main()  # pyright: ignore[reportAttributeAccessIssue]
    except SystemExit as stop:  # tyro's own, 2 for flags that it cannot read
        sys.exit(1 if stop.code == 2 else stop.code)
    except (ValueError, OSError, MemoryError) as error:
        CONSOLE.rule("Error", style="red")
        CONSOLE.print(str(error), justify="center", markup=False, highlight=False)
        sys.exit(1)
    except KeyboardInterrupt:
        CONSOLE.print("Interrupted. Nothing half-written is left; the same command goes on where it stopped.")
        sys.exit(130)


def choose_device(device: str) -> str:
    """The device to work on; auto: cuda if there is one.

    Raises:
        ValueError: an unknown device, or one that this machine lacks.
    """
    if device not in ("auto", "cpu") and not device.startswith("cuda"):
        raise ValueError(f"--device must be auto, cpu or cuda, got {device!r}")
    if device.startswith("cuda") and not torch.cuda.is_available():
        raise ValueError(f"--device {device}: this machine has no CUDA device; use --device cpu")
    if device != "auto":
        return device
    return "cuda" if torch.cuda.is_available() else "cpu"
