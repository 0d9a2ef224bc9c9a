"""What the panel hands out: the selection as a file, and the prompts of a run."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Protocol

from jaxtyping import Bool
from torch import Tensor

from normlift_ns.core.files import file_name
from normlift_ns.core.gaussians import GaussianScene
from normlift_ns.errors import InputError
from normlift_ns.nerfstudio_plugin.said import drawable
from normlift_ns.options import RasterizeMode
from normlift_ns.runs.question import load_question, save_question
from normlift_ns.runs.splats import write_splats
from normlift_ns.session.prompts import merged
from normlift_ns.session.state import State
from normlift_ns.viewer.display import Display


class Host(Protocol):
    """What the panel needs of the model."""

    def show(self, display: Display | None) -> None:
        """Replaces what is drawn besides the colours."""
        ...

    def in_sight(self, origin: Tensor, direction: Tensor) -> Tensor:
        """Weights of the Gaussians on a ray."""
        ...

    def scene(self) -> GaussianScene:
        """All Gaussians."""
        ...

    def splats(self) -> tuple[Mapping[str, Tensor], bool, RasterizeMode]:
        """For `write_splats`: parameters, whether colours are spherical harmonics, and how they were rasterized."""
        ...


def selection_file(host: Host, state: State, mask: Bool[Tensor, " n"], called: str) -> tuple[str, bytes, int]:
    """Name and content of a PLY file of some Gaussians, and how many are in it.

    Args:
        mask: the selection, or an object in it.
        called: what the file is called, without suffix.
    Raises:
        ValueError: nothing is selected, or nothing of it is ever drawn.
    """
    if not bool(mask.any()):
        raise InputError("Nothing is selected; there is nothing to download.")
    parameters, harmonics, mode = host.splats()
    if not bool((mask & drawable(parameters["opacities"])).any()):
        raise InputError("Nothing that is selected is ever drawn (opacity below 1/255); there is nothing to download.")
    name = f"{file_name(called)}.ply"
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / name
        rows = write_splats(
            path,
            parameters,
            state.space.field,
            state.answer,
            keep=mask,
            spherical_harmonics=harmonics,
            rasterize_mode=mode,
        )
        return name, path.read_bytes(), len(rows)


def save_prompts(folder: Path | None, state: State, *, replaces: bool) -> int:
    """Stores the prompts in the folder of the field beside those that it has; returns how many it has now.

    Args:
        replaces: instead of those that it has.
    Raises:
        ValueError: there are none; those that it has go by another rule.
    """
    if state.question is None or folder is None:
        raise InputError("No query yet; there is nothing to save.")
    question = merged(None if replaces else load_question(folder), state.question)
    save_question(folder, question)
    return len(question.texts)
