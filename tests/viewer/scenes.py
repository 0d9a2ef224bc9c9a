"""Small scenes for the tests of viewers."""

import socket
import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import torch

from normlift_ns import Camera, GaussianScene


def camera() -> Camera:
    return Camera(torch.tensor([[50.0, 0, 8], [0, 50, 6], [0, 0, 1]]), torch.eye(4), 16, 12)


def spheres(means: torch.Tensor, scale: float = 1.0, opacity: float | torch.Tensor = 0.9) -> GaussianScene:
    n = len(means)
    return GaussianScene(means, torch.eye(4)[:1].expand(n, 4), torch.full((n, 3), scale), torch.ones(n) * opacity)


def scene_of(gaussians: GaussianScene, rgb: torch.Tensor | None = None, cameras: tuple[Camera, ...] = ()) -> Any:
    n = len(gaussians)
    colours = torch.full((n, 3), 0.5) if rgb is None else rgb
    parameters = {
        "means": gaussians.means, "quats": gaussians.quats, "scales": gaussians.scales.log(),
        "opacities": gaussians.opacities.logit()[:, None], "features_dc": (colours - 0.5) / 0.28209479177387814,
        "features_rest": torch.zeros(n, 0, 3),
    }  # fmt: skip
    return SimpleNamespace(
        gaussians=gaussians, parameters=parameters, has_harmonics=True, rasterize_mode="classic",
        train=SimpleNamespace(cameras=cameras),
    )  # fmt: skip


def until(true: Callable[[], Any], said: Callable[[], Any] = str) -> None:
    deadline = time.monotonic() + 120
    while not true():
        assert time.monotonic() < deadline, said()
        time.sleep(0.002)


def free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return free.getsockname()[1]
