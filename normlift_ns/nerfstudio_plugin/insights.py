"""Details of an answer in the panel: objects, histograms, and the training images behind it."""

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

_DELAY = 0.1
"""Seconds without a change before the details are computed."""


def reasons_of(folder: Path | None, field: SemanticField) -> Reasons:
    """Return the explanations of a lifted run.

    The run is opened a second time at the first explanation, without nerfstudio and with its images.

    Args:
        folder: folder of the semantic field; None: the run is not stored yet.
    """

    @cache
    def votes() -> Votes:
        if folder is None:
            raise InputError("The run is not stored yet, so the images behind the selection are unknown.")
        run = folder.parent
        scene = open_saved_splat(run) if is_saved_splat(run) else load_scene(run / "config.yml", by_nerfstudio=_no_aria)
        return Votes(scene, field.to("cpu"), cache_folder(run))

    return Reasons(votes)


def _no_aria(*_: Any) -> Any:
    raise InputError(
        "Images of Aria cameras (FISHEYE624) cannot be shown here. Use ns-normlift-view or ns-normlift-query --why."
    )


class Rest:
    """Background computation of objects and histograms, after a moment without changes. Stale results are dropped.

    Args:
        show: called in a separate thread with a function that returns False for stale results, the objects and the
            histograms.
        failed: called with any exception raised.
    """

    def __init__(self, show: Callable[[Callable[[], bool], Found, str], None], failed: Callable[[Exception], None]):
        self._show, self._failed, self._turns = show, failed, Turns()

    def follow(self, state: State) -> None:
        """Compute the details of the state that is shown now."""
        token = self._turns.start("Looking for objects.")
        Thread(target=self._compute, args=(token, state), daemon=True).start()

    def cancel(self) -> None:
        """Drop the results of the running computation."""
        self._turns.cancel()

    def _compute(self, token: Turn, state: State) -> None:
        time.sleep(_DELAY)
        if not self._turns.wanted(token):
            return
        try:
            objects, histograms = found_objects(state, most=MOST_OBJECTS), verdicts_mdx(state)
            self._show(lambda: self._turns.finish(token), objects, histograms)
        except Exception as error:  # no error may stop the viewer
            if self._turns.finish(token):
                self._failed(error)


def go_to(client: Any, target: FoundObject, scene: GaussianScene, drawn: Bool[Tensor, " n"]) -> None:
    """Move the camera of one browser to face an object, from the current side unless something blocks the view."""
    camera = client.camera
    view = (np.asarray(camera.position) / UNITS, camera.up_direction, float(camera.fov))
    position = clear_viewpoint(target, scene, drawn, *view)
    with client.atomic():
        camera.position = np.array(position) * UNITS
        camera.look_at = np.array(target.centre) * UNITS
