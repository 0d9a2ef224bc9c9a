"""The camera of a page, in the scene's own units."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from normlift_ns.core.gaussians import Camera
from normlift_ns.viewer.adapter import Page
from normlift_ns.viewer.links import View
from normlift_ns.viewer.records import Records

_FIELDS_OF_VIEW = (0.3, 1.9)


class Eye:
    """Where a page looks from."""

    def __init__(self, page: Page, records: Records) -> None:
        self._page, self._records, self._units = page, records, records.units

    @property
    def view(self) -> View:
        """Where it is now."""
        camera = self._page.camera
        places = (self.position, self._units.to_scene(camera.look_at), np.asarray(camera.up_direction, float))
        position, look_at, up = (tuple(map(float, place)) for place in places)
        return View(position, look_at, up, float(camera.fov))  # pyright: ignore[reportArgumentType]

    @property
    def position(self) -> np.ndarray:
        """Its place."""
        return self._units.to_scene(self._page.camera.position)

    @property
    def fov(self) -> float:
        """Its vertical field of view, in radians."""
        return float(self._page.camera.fov)

    def camera(self, pixels: int) -> Camera:
        """A camera that sees what the page does, in a picture of about so many pixels."""
        seen = self._page.camera
        aspect = float(np.clip(seen.aspect, 0.1, 10.0))
        height = max(1, round((pixels / aspect) ** 0.5))
        width = max(1, round(aspect * height))
        focal = height / 2 / np.tan(float(np.clip(seen.fov, 1e-3, 3.1)) / 2)
        K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], dtype=torch.float64)
        w, x, y, z = np.asarray(seen.wxyz, float) / np.linalg.norm(seen.wxyz)
        turn = np.array([
            [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
            [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
            [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)],
        ])  # fmt: skip
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = turn, -turn @ self.position
        return Camera(K.float(), torch.from_numpy(pose).float(), width, height)

    def go(self, view: View) -> None:
        """Goes where a link or a lost connection says."""
        with self._page.together():
            self._page.camera.fov = view.fov
            self._page.camera.up_direction = np.array(view.up)
            self.look(view.position, view.look_at)

    def look(self, place: Sequence[float] | np.ndarray, target: Sequence[float] | np.ndarray) -> None:
        """Goes to a place, and looks at another one."""
        with self._page.together():
            self._page.camera.position = self._units.to_browser(place)
            self._page.camera.look_at = self._units.to_browser(target)

    def begin(self, cameras: Sequence[Camera]) -> None:
        """Starts at the first photograph of the training, looking as far as the scene is away."""
        if len(cameras) == 0:
            return
        poses: list[Any] = [camera.world_to_camera.double().cpu().numpy() for camera in cameras]
        up = -np.mean([pose[1, :3] for pose in poses], axis=0)
        length = np.linalg.norm(up)
        up = up / length if length > 1e-6 else np.array([0.0, 0.0, 1.0])
        first = np.linalg.inv(poses[0])
        place, ahead = first[:3, 3], first[:3, 2]
        means = self._units.to_scene(self._records.table[::50, :3].copy().view(np.float32))
        depth = (means - place) @ ahead
        distance = float(np.median(depth[depth > 0])) if (depth > 0).any() else 1 / self._units.factor
        fov = 2 * np.arctan(cameras[0].height / 2 / float(cameras[0].K[1, 1]))
        self._page.up(up)
        view = (tuple(place), tuple(place + distance * ahead), tuple(up))
        self.go(View(*view, float(np.clip(fov, *_FIELDS_OF_VIEW))))  # pyright: ignore[reportArgumentType]
