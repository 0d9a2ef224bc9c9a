"""Clicks on the scene in nerfstudio's viewer. At most one browser at a time waits for a click."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import suppress
from typing import Any

import numpy as np
import torch
from torch import Tensor

from normlift_ns.session.prompts import click_name

UNITS = 10.0
"""Units of the viser scene per scene unit: nerfstudio's VISER_NERFSTUDIO_SCALE_RATIO."""
MODES = {"More like this": "like", "Select": "select", "Add": "add", "Drop": "take away"}
"""What a click does, by the caption of its button."""


class Clicks:
    """Listener for clicks on the scene, in at most one browser of a viewer.

    Args:
        hit: called with the mode of the click, and with the origin and direction of its ray in scene units.
    """

    def __init__(self, hit: Callable[[str, Tensor, Tensor], None]) -> None:
        self._hit = hit
        self._armed: tuple[str, Any] | None = None
        self.known: dict[str, np.ndarray] = {}
        """Directions of the clicked Gaussians, by the names of their prompts."""

    @property
    def armed(self) -> bool:
        """Whether a browser waits for a click."""
        return self._armed is not None

    def arm(self, button: str, client: Any) -> None:
        """Wait for a click in one browser.

        Args:
            button: caption of the button, a key of `MODES`.
        """
        self.disarm()
        client.scene.on_pointer_event("click")(self._clicked)
        self._armed = (MODES[button], client)

    def disarm(self) -> None:
        """Stop waiting for a click."""
        armed, self._armed = self._armed, None
        if armed is not None and armed[1].scene._scene_pointer_cb is not None:
            with suppress(Exception):  # raised by viser if the browser has just disconnected
                armed[1].scene.remove_pointer_callback()

    def forget(self, client: Any) -> bool:
        """Handle a disconnected browser; return whether it waited for a click."""
        waited = self._armed is not None and self._armed[1].client_id == client.client_id
        if waited:
            self._armed = None
        return waited

    def keep(self, vector: np.ndarray, taken: Iterable[str]) -> str:
        """Keep the direction of a clicked Gaussian.

        Args:
            taken: prompt names that must not be used again, in addition to those of `known`.
        Returns:
            Name of the new prompt.
        """
        names = {*self.known, *taken}
        name = next(name for n in range(1, len(names) + 2) if (name := click_name(n)) not in names)
        self.known[name] = vector
        return name

    def _clicked(self, event: Any) -> None:
        armed = self._armed
        if armed is None or event.ray_origin is None:
            return
        self.disarm()
        self._hit(armed[0], torch.tensor(event.ray_origin) / UNITS, torch.tensor(event.ray_direction))
