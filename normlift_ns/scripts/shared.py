"""What the commands have in common: errors that users can act on, and the device."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Protocol

import torch
import tyro
from rich.console import Console

from normlift_ns.core.query import RelevancyForm

CONSOLE = Console(width=120)


@dataclass(frozen=True)
class AskOptions:
    """How texts are judged."""

    negatives: tuple[str, ...] | None = None
    """What to compare with; by default LERF's words for open_clip, none for colour."""
    relevancy: RelevancyForm | Literal["auto"] = "auto"
    """cosine; lerf: against each negative; margin: above the best negative. auto: lerf with negatives, else cosine."""
    threshold: float | None = None
    """Relevancy above which a Gaussian is selected; by default 0.5 (cosine), 0.5 (lerf) or 0.02 (margin)."""
    min_reliability: float = 0.0
    """Least reliability of a selected Gaussian, in 0..1."""
    refined: bool = True
    """Ask the refined directions."""
    text_vectors: Path | None = None
    """NPZ file, text -> vector, to look texts up in instead of the encoder that the run was lifted with."""
    text_template: str | None = None
    """What open_clip reads for a text, which takes the place of {}, such as "a photo of a {}"; ensemble: the mean of
    seven. By default as the run was lifted."""

    def keywords(self) -> dict[str, Any]:
        """As `plugin.asking.pose` takes them."""
        rule = {"threshold": self.threshold, "min_reliability": self.min_reliability, "refined": self.refined}
        return {"negatives": self.negatives, "form": self.relevancy, **rule}


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
