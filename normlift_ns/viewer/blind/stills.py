"""Pictures from the server for a browser without WebGL, which cannot draw Gaussians itself."""

from __future__ import annotations

import io
import threading
from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import UInt8
from PIL import Image

from normlift_ns.core.gaussians import Camera, GaussianScene
from normlift_ns.crash import explain
from normlift_ns.raster.rasterize import render
from normlift_ns.session.state import State
from normlift_ns.viewer.adapter import Page
from normlift_ns.viewer.eye import Eye
from normlift_ns.viewer.paint import opacities, painted
from normlift_ns.viewer.shared import Run

_COARSE, _FINE = 160 * 120, 800 * 600
"""Pixels of a picture while the camera moves, and once it rests."""
_REST = 0.25
"""Seconds without a change after which the fine picture is drawn."""
_QUALITY = 85
"""Of the JPEG."""
_DRAWING = threading.Lock()
"""One picture at a time: each takes all cores, and some of numba's threads bear no second one."""


class Stills:
    """Draws what one page shows whenever it has changed: coarsely at once, and finely when it rests.

    Args:
        state: what is shown now.
        tell: shows a message in the panel.
    """

    def __init__(self, run: Run, page: Page, eye: Eye, state: Callable[[], State], tell: Callable[[str], None]) -> None:
        self._run, self._page, self._eye, self._state, self._tell = run, page, eye, state, tell
        self._changed, self._gone = threading.Event(), False
        page.on_camera(self.change)
        threading.Thread(target=self._draw_on, daemon=True).start()

    def change(self) -> None:
        """The camera or the state is another one."""
        self._changed.set()

    def stop(self) -> None:
        """The page is gone."""
        self._gone = True
        self._changed.set()

    def _draw_on(self) -> None:
        while not self._gone:
            self._changed.wait()
            self._changed.clear()
            try:
                self._draw(_COARSE)
                if not self._changed.wait(_REST):
                    self._draw(_FINE)
            except Exception as error:  # whatever it is: the next picture may come out well
                if not self._gone:
                    self._tell(explain(error)[0])

    def _draw(self, pixels: int) -> None:
        if self._gone:
            return
        with io.BytesIO() as file:
            Image.fromarray(still(self._run, self._state(), self._eye.camera(pixels))).save(
                file, "JPEG", quality=_QUALITY
            )
            self._page.show_picture(file.getvalue())


def still(run: Run, state: State, camera: Camera) -> UInt8[np.ndarray, "h w 3"]:
    """The same Gaussians in the same colours as a browser with WebGL draws, on white."""
    colours, drawn = painted(run.records, state)
    device = run.scene.gaussians.means.device
    rows = torch.from_numpy(run.records.rows[drawn]).to(device)
    whole = run.scene.gaussians
    alpha = opacities(run.records, state)[drawn]
    opaque = whole.opacities[rows]
    if (alpha != run.records.alpha[drawn]).any():  # what is faint is to be seen
        opaque = torch.from_numpy(alpha).to(opaque) / 255
    part = GaussianScene(whole.means[rows], whole.quats[rows], whole.scales[rows], opaque)
    values = torch.from_numpy(colours[drawn]).to(device, part.means.dtype) / 255
    with _DRAWING:
        image, alpha = render(part, camera, values, rasterize_mode=run.scene.rasterize_mode)
    shown = image + (1 - alpha)[:, :, None]
    return (shown.clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()
