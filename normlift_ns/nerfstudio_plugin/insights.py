"""What an answer rests on, in the panel: found objects, histograms, and the photographs that voted."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np
from jaxtyping import Bool
from torch import Tensor

from normlift_ns.core.field import SemanticField
from normlift_ns.core.gaussians import GaussianScene
from normlift_ns.errors import InputError
from normlift_ns.nerfstudio_plugin.clicks import UNITS
from normlift_ns.runs.files import cache_folder
from normlift_ns.runs.votes import Votes
from normlift_ns.scenes.nerfstudio.load import load_scene
from normlift_ns.scenes.saved import is_saved_splat, open_saved_splat
from normlift_ns.session.found import Found, FoundObject, found_objects
from normlift_ns.session.state import State
from normlift_ns.session.turns import Turn, Turns
from normlift_ns.session.viewpoint import clear_viewpoint
from normlift_ns.viewer.drawing import verdicts_mdx
from normlift_ns.viewer.reasons import Reasons
from normlift_ns.viewer.rows import MOST_OBJECTS

_CALM = 0.1
"""Seconds without a change before objects are looked for."""


def reasons_of(folder: Path | None, field: SemanticField) -> Reasons:
    """Reasons of a lifted run, which is opened a second time when they are first wanted: without nerfstudio, and with
    its photographs.

    Args:
        folder: of the field; None: there is none yet.
    """

    @cache
    def votes() -> Votes:
        if folder is None:
            raise InputError("The run is not stored yet; nobody knows which photographs voted.")
        run = folder.parent
        scene = open_saved_splat(run) if is_saved_splat(run) else load_scene(run / "config.yml", by_nerfstudio=_refuse)
        return Votes(scene, field.to("cpu"), cache_folder(run))

    return Reasons(votes)


def _refuse(*_: Any) -> Any:
    raise InputError(
        "The photographs of Aria's cameras (FISHEYE624) cannot be shown here; ns-normlift-view and ns-normlift-query "
        "--why show them."
    )


class Rest:
    """Looks for what takes longer than a frame, once nothing has changed for a moment; late results are dropped.

    Args:
        show: called with the objects and the histograms of a state, in a thread of its own.
        failed: called with whatever was raised.
    """

    def __init__(self, show: Callable[[Callable[[], bool], Found, str], None], failed: Callable[[Exception], None]):
        self._show, self._failed, self._turns = show, failed, Turns()

    def follow(self, state: State) -> None:
        """A state is shown."""
        turn = self._turns.start("Looking for objects.")
        Thread(target=self._look, args=(turn, state), daemon=True).start()

    def cancel(self) -> None:
        """Nothing is wanted any more."""
        self._turns.cancel()

    def _look(self, turn: Turn, state: State) -> None:
        time.sleep(_CALM)
        if not self._turns.wanted(turn):
            return
        try:
            found, histograms = found_objects(state, most=MOST_OBJECTS), verdicts_mdx(state)
            self._show(lambda: self._turns.finish(turn), found, histograms)
        except Exception as error:  # whatever it is: nothing may stop the viewer
            if self._turns.finish(turn):
                self._failed(error)


def go_to(client: Any, found: FoundObject, scene: GaussianScene, drawn: Bool[Tensor, " n"]) -> None:
    """Moves the camera of one browser before an object, from the side where it is if nothing stands in the way."""
    camera = client.camera
    eye = (np.asarray(camera.position) / UNITS, camera.up_direction, float(camera.fov))
    place = clear_viewpoint(found, scene, drawn, *eye)
    with client.atomic():
        camera.position = np.array(place) * UNITS
        camera.look_at = np.array(found.centre) * UNITS
