"""Reader for the `.splat` files of antimatter15's viewer, with 32 bytes per Gaussian and no header."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from normlift_ns.core.gaussians import SH_C0
from normlift_ns.data.compressed_ply import opacity_logits
from normlift_ns.data.splat import SplatFile, SplatParameters, validate_splat
from normlift_ns.errors import InputError
from normlift_ns.io.guard import open_regular

_ROW = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("colors", "u1", 4), ("quats", "u1", 4)])
_MIN_SCALE = 1e-30


def read_antimatter(path: Path) -> SplatFile:
    """Read a .splat file. Its colors do not depend on the view direction.

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: The file is empty, its size is not a multiple of 32 bytes, a scale is negative, or the Gaussians
            cannot be rendered.
    """
    if not path.is_file():
        raise FileNotFoundError(f"The .splat file {path} does not exist. Give an existing file with --load-ply.")
    with open_regular(path) as file:
        data = file.read()
    if len(data) == 0 or len(data) % _ROW.itemsize != 0:
        raise InputError(
            f"{path} is truncated or not a .splat file: it has {len(data):,} bytes, expected a positive "
            f"multiple of {_ROW.itemsize}. Copy it again."
        )
    rows = np.frombuffer(data, _ROW)
    scales, colors = torch.from_numpy(rows["scales"].copy()), torch.from_numpy(rows["colors"].astype(np.float32))
    if bool((scales < 0).any()):
        raise InputError(f"{path} is not a .splat file: it has negative scales. Give a valid .splat file.")
    splat = SplatParameters(
        means=torch.from_numpy(rows["means"].copy()),
        quats=torch.from_numpy(rows["quats"].astype(np.float32)) / 128 - 1,
        scales=scales.clamp(min=_MIN_SCALE).log(),
        opacities=opacity_logits(colors[:, 3:] / 255),
        features_dc=(colors[:, :3] / 255 - 0.5) / SH_C0,
        features_rest=torch.zeros(len(rows), 0, 3),
    )
    validate_splat(splat, path)
    rounding = (
        f"{path.name} contains rounded numbers. Maximum errors: 0.04 radians for rotations, and 0.004 for opacities "
        "and colors."
    )
    return SplatFile(splat, remarks=(rounding,))
