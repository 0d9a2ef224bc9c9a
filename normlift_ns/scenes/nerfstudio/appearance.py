"""What splatfacto draws with: its background, and the degree of its spherical harmonics."""

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
"""nerfstudio's, by their names."""
LOADED_STEP = 30000
"""The step that splatfacto takes a loaded checkpoint for, whatever its own."""
_VIEWER_BACKGROUND = (0.1490, 0.1647, 0.2157)


def background(config: SplatfactoModelConfig) -> Float[Tensor, " 3"]:
    """RGB in 0..1 behind the Gaussians, as splatfacto has it outside training; for "random", that of the viewer."""
    name = config.background_color
    return torch.tensor(_VIEWER_BACKGROUND) if name == "random" else torch.tensor(COLORS[name])


def shading_degree(config: Any, step: int) -> int | None:
    """Degree of the spherical harmonics in use at a training step; None: colours do not depend on the view.

    Args:
        config: of splatfacto, nerfstudio's own or its mirror.
    """
    return min(step // config.sh_degree_interval, config.sh_degree) if config.sh_degree > 0 else None
