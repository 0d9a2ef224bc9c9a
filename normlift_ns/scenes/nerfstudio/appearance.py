"""Background color and spherical harmonics degree of splatfacto renders."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from normlift_ns.scenes.nerfstudio.classes import SplatfactoModelConfig

COLORS = {
    "white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0), "red": (1.0, 0.0, 0.0), "green": (0.0, 1.0, 0.0),
    "blue": (0.0, 0.0, 1.0),
}  # fmt: skip
"""nerfstudio's named colors, RGB in 0..1."""
LOADED_STEP = 30000
"""Step that splatfacto assumes for a loaded checkpoint, whatever its actual step."""
_VIEWER_BACKGROUND = (0.1490, 0.1647, 0.2157)


def background(config: SplatfactoModelConfig) -> Float[Tensor, " 3"]:
    """Return splatfacto's background color outside training, RGB in 0..1; for "random", the viewer's."""
    name = config.background_color
    return torch.tensor(_VIEWER_BACKGROUND) if name == "random" else torch.tensor(COLORS[name])


def shading_degree(config: Any, step: int) -> int | None:
    """Return the degree of the spherical harmonics at a training step; None: colors do not depend on the view.

    Args:
        config: splatfacto's model config, nerfstudio's own or its mirror.
        step: training step.
    """
    return min(step // config.sh_degree_interval, config.sh_degree) if config.sh_degree > 0 else None
