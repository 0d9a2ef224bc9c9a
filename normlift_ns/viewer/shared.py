"""What all pages of a run share, and what is kept of one person."""

from __future__ import annotations

import dataclasses
import tempfile
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float

from normlift_ns.asking import Answer
from normlift_ns.core.files import file_name
from normlift_ns.core.scene import Scene
from normlift_ns.errors import InputError
from normlift_ns.insight.floaters import find_floaters
from normlift_ns.question import Question
from normlift_ns.raster.picking import ray_weights
from normlift_ns.runs.files import FIELD_FOLDER
from normlift_ns.runs.question import load_question, save_question
from normlift_ns.runs.splats import write_splats
from normlift_ns.runs.votes import Votes
from normlift_ns.session.history import History
from normlift_ns.session.prompts import merged, prompts_of
from normlift_ns.session.space import Space
from normlift_ns.session.state import State
from normlift_ns.viewer.links import View
from normlift_ns.viewer.records import Records


@dataclass(frozen=True, eq=False)
class Run:
    """What all persons share."""

    folder: Path
    scene: Scene
    space: Space
    records: Records
    texts: Callable[[], Any]
    """The encoder of texts, loaded when it is first called."""
    readonly: bool = False
    votes: Callable[[], Votes] | None = None
    """What photographs said in the lift, opened when they are first wanted; None: nobody knows."""
    reading: threading.Lock = dataclasses.field(default_factory=threading.Lock)

    def weights(self, origin: Sequence[float], direction: Sequence[float]) -> Float[torch.Tensor, " n"]:
        """Of the Gaussians on a ray of the browser."""
        start = torch.from_numpy(self.records.units.to_scene(origin))
        return ray_weights(self.scene.gaussians, start, torch.tensor(direction, dtype=torch.float64))

    @cached_property
    def floaters(self) -> Bool[torch.Tensor, " n"]:
        """Gaussians that likely belong to no surface; takes seconds."""
        return find_floaters(self.scene.gaussians, self.space.field.scalars).mask

    def opened_votes(self) -> Votes:
        """What photographs said in the lift.

        Raises:
            ValueError: nobody knows.
        """
        if self.votes is None:
            raise InputError("This viewer was opened without the photographs of the run.")
        return self.votes()

    def read(self, texts: Sequence[str]) -> Any:
        """Texts to vectors, one at a time: an encoder must not be loaded twice."""
        with self.reading:
            return self.texts().rows(texts)

    def stored(self) -> dict[str, Any]:
        """Vectors of the prompts that the run stores."""
        return {row.text: row.vector for row in prompts_of(load_question(self.folder / FIELD_FOLDER))}

    def known(self, clicks: Mapping[str, int]) -> dict[str, Any]:
        """Vectors that need no encoder: of stored prompts, and of clicks.

        Raises:
            ValueError: a click on a Gaussian that this scene does not have.
        """
        for name, gaussian in clicks.items():
            if gaussian >= len(self.space):
                raise InputError(f"{name}: this scene has no Gaussian {gaussian:,}; the link is of another one")
        rows = self.space.field.directions(torch.tensor(list(clicks.values()), dtype=torch.long)).cpu().numpy()
        return {**self.stored(), **{name: row for name, row in zip(clicks, rows) if np.any(row)}}

    def save(self, question: Question | None) -> str:
        """Stores prompts beside those that the run stores; a message.

        Raises:
            ValueError: nothing is asked, or this may not be done; as `merged`.
        """
        if self.readonly:
            raise InputError("This page may only look; nothing is stored in the run.")
        if question is None:
            raise InputError("No query yet; there is nothing to save.")
        whole = merged(load_question(self.folder / FIELD_FOLDER), question)
        save_question(self.folder / FIELD_FOLDER, whole)
        stored = "one prompt" if len(whole.texts) == 1 else f"{len(whole.texts)} prompts"
        return f"The run stores {stored} now, for ns-render and ns-viewer to draw."

    def exported(self, mask: Bool[torch.Tensor, " n"], name: str, answer: Answer | None) -> tuple[str, bytes, str]:
        """Some Gaussians as a PLY file: its name, its content, and a message.

        Raises:
            ValueError: there are none, or none is ever drawn.
        """
        if not bool(mask.any()):
            raise InputError("Nothing is selected; there is nothing to export.")
        how: dict[str, Any] = {
            "spherical_harmonics": self.scene.has_harmonics,
            "rasterize_mode": self.scene.rasterize_mode,
        }
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / f"{file_name(name)}.ply"
            rows = write_splats(path, self.scene.parameters, self.space.field, answer, keep=mask, **how)
            content = path.read_bytes()
        faint = int(mask.sum()) - len(rows)
        why = f" {faint:,} more are too faint to be drawn (opacity below 1/255)." if faint > 0 else ""
        return path.name, content, f"{path.name} with {len(rows):,} Gaussians goes to your downloads.{why}"


@dataclass(eq=False)
class Memory:
    """What is kept of a person when the connection is lost."""

    history: History[State]
    line: str = ""
    """What stands in the box of prompts."""
    clicks: dict[str, int] = dataclasses.field(default_factory=dict)
    """Gaussians that were clicked, by the names of the prompts."""
    view: View | None = None
    link: str = ""
    """The last link that was followed or made here; it says nothing new."""
    page: int | None = None
    """Connection that shows it now."""
