"""The next click on the scene, which one browser waits for, and what was clicked before."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import suppress
from typing import Any

import numpy as np
import torch
from torch import Tensor

from normlift_ns.session.prompts import click_name

UNITS = 10.0
"""Of the browser per unit of the scene: nerfstudio's VISER_NERFSTUDIO_SCALE_RATIO."""
MODES = {"More like this": "like", "Select": "select", "Add": "add", "Drop": "take away"}
"""What a click does, by its button."""


class Clicks:
    """Of all browsers of a viewer, at most one waits.

    Args:
        hit: called with what the click does, and with origin and direction of its ray in the scene's own units.
    """

    def __init__(self, hit: Callable[[str, Tensor, Tensor], None]) -> None:
        self._hit = hit
        self._armed: tuple[str, Any] | None = None
        self.known: dict[str, np.ndarray] = {}
        """Directions that were clicked, by the names of their prompts."""

    @property
    def armed(self) -> bool:
        """Whether a browser waits for a click."""
        return self._armed is not None

    def arm(self, button: str, client: Any) -> None:
        """The next click in this browser does something."""
        self.disarm()
        client.scene.on_pointer_event("click")(self._clicked)
        self._armed = (MODES[button], client)

    def disarm(self) -> None:
        """No click does anything."""
        armed, self._armed = self._armed, None
        if armed is not None and armed[1].scene._scene_pointer_cb is not None:
            with suppress(Exception):  # viser's, of a browser that has just gone
                armed[1].scene.remove_pointer_callback()

    def forget(self, client: Any) -> bool:
        """A browser is gone; whether it waited."""
        waited = self._armed is not None and self._armed[1].client_id == client.client_id
        if waited:
            self._armed = None
        return waited

    def keep(self, vector: np.ndarray, taken: Iterable[str]) -> str:
        """Keeps a direction; the name of its prompt, which is none of those that are taken."""
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
