"""Results that the panel exports: the selection as a file, and the prompts stored in a run."""

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
    """Interface of the model that the panel uses."""

    def show(self, display: Display | None) -> None:
        """Replace what is rendered in addition to the colors."""
        ...

    def in_sight(self, origin: Tensor, direction: Tensor) -> Tensor:
        """Return the weights of the Gaussians on a ray."""
        ...

    def scene(self) -> GaussianScene:
        """Return all Gaussians."""
        ...

    def splats(self) -> tuple[Mapping[str, Tensor], bool, RasterizeMode]:
        """Return what `write_splats` needs: parameters, whether colors are spherical harmonics, and rasterize mode."""
        ...


def selection_file(host: Host, state: State, mask: Bool[Tensor, " n"], stem: str) -> tuple[str, bytes, int]:
    """Export Gaussians as a PLY file.

    Args:
        mask: the selection, or an object in it.
        stem: name of the file without suffix.
    Returns:
        Name and content of the file, and its number of Gaussians.
    Raises:
        ValueError: nothing is selected, or no selected Gaussian is ever drawn.
    """
    if not bool(mask.any()):
        raise InputError("Nothing is selected; there is nothing to download.")
    parameters, harmonics, mode = host.splats()
    if not bool((mask & drawable(parameters["opacities"])).any()):
        raise InputError("No selected Gaussian is ever drawn (opacity below 1/255); there is nothing to download.")
    name = f"{file_name(stem)}.ply"
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
    """Store the prompts of a state in a run, in addition to the prompts stored there.

    Args:
        folder: folder of the semantic field; None: the run is not stored yet.
        replaces: replace the stored prompts.
    Returns:
        Number of prompts that the run stores now.
    Raises:
        ValueError: there are no prompts to store, or the stored prompts use another rule.
    """
    if state.question is None or folder is None:
        raise InputError("No query yet; there is nothing to save.")
    question = merged(None if replaces else load_question(folder), state.question)
    save_question(folder, question)
    return len(question.texts)
