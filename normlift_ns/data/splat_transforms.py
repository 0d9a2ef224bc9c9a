"""Similarity transforms of splats."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from normlift_ns.data.frames import WorldTransform
from normlift_ns.data.splat import SplatParameters
from normlift_ns.rasterization.rasterize import rotate_harmonics


def transform_splat(splat: SplatParameters, world: WorldTransform) -> SplatParameters:
    """Return a splat that is rotated, translated and scaled together with its colors, computed in float64."""
    rotation, translation = (torch.from_numpy(part) for part in np.split(world.transform, [3], axis=1))
    from scipy.spatial.transform import Rotation  # noqa: PLC0415 (slow import)

    x, y, z, w = Rotation.from_matrix(rotation.numpy()).as_quat()
    product = torch.tensor([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]], dtype=torch.float64)
    return replace(
        splat,
        means=((splat.means.double() @ rotation.T + translation.T) * world.scale).float(),
        quats=(splat.quats.double() @ product.T).float(),
        scales=(splat.scales.double() + np.log(world.scale)).float(),
        features_rest=rotate_harmonics(splat.features_rest, rotation),
    )
