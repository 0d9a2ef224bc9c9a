"""Undistortion of fisheye images to pinhole images of the same size, which keep most of the pixels."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, Int64, UInt8

from normlift_ns.data.frames import Intrinsics
from normlift_ns.errors import InputError

KEPT_SHARE = 0.9
"""Minimum share of the pixels of a fisheye image that its pinhole camera shows.

The share is smaller only if too many pixels lie beyond `MAX_ANGLE`.
"""
MAX_ANGLE = math.radians(80)
"""Largest angle to the optical axis, in radians, of the pixels that count as kept. A pinhole camera cannot show
directions near 90 degrees. Pixels without an angle in the distortion model count as beyond this angle."""
_MIN_SHARE = 0.1
"""Minimum share of pixels within `MAX_ANGLE`. Below it, the focal length or the distortion is probably wrong."""
_SAMPLES, _SAMPLING_ERROR = 512, 1e-3
"""Number of rows and of columns of the sample grid for estimates of shares, and maximum error of these estimates."""
_ANGLES = np.linspace(0, math.radians(89.9), 8192)


def fisheye_pinhole(lens: Intrinsics) -> Float[np.ndarray, "3 3"]:
    """Return the camera matrix of the undistorted image of a fisheye camera.

    The image keeps its size, its principal point and the ratio of its focal lengths. The focal length is the largest
    one that keeps at least `KEPT_SHARE` of the original pixels inside the image. If too many pixels lie beyond
    `MAX_ANGLE`, it is the largest one that keeps all others inside.

    Raises:
        ValueError: Fewer than a tenth of the pixels lie within `MAX_ANGLE`.
    """
    return np.array(_pinhole(lens).matrix)


def kept_share(lens: Intrinsics) -> float:
    """Return the share of the pixels of a fisheye image that remain in the undistorted image, in 0..1.

    Raises:
        ValueError: As for `fisheye_pinhole`.
    """
    return _pinhole(lens).kept


class _Pinhole(NamedTuple):
    matrix: tuple[tuple[float, float, float], ...]
    kept: float
    """Share of the original pixels that are inside the pinhole image."""


@lru_cache  # the images of a camera share their intrinsics
def _pinhole(lens: Intrinsics) -> _Pinhole:
    limits = _focal_limits(lens)
    is_seen = limits > 0
    if is_seen.mean() < _MIN_SHARE:
        raise InputError(
            f"only {is_seen.mean():.0%} of its pixels (fx {lens.fx:g}, {lens.width} x {lens.height} pixels, k1 to k4 "
            f"{[*lens[6:9], lens.k4]}) lie within {math.degrees(MAX_ANGLE):.0f} degrees of the optical axis, expected "
            f"at least {_MIN_SHARE:.0%}. The focal length or the distortion is probably wrong. Correct them, or "
            "undistort the images to a smaller angle, for example with colmap image_undistorter, and give the new "
            "images and cameras."
        )
    lost = int((1 - KEPT_SHARE - _SAMPLING_ERROR) * len(limits))
    factor = np.partition(limits, lost)[lost] or limits[is_seen].min()
    fx, fy, cx, cy = lens[:4]
    matrix = ((float(fx * factor), 0.0, cx), (0.0, float(fy * factor), cy), (0.0, 0.0, 1.0))
    return _Pinhole(matrix, float((limits >= factor).mean()))


def _focal_limits(lens: Intrinsics) -> Float[np.ndarray, " n"]:
    """Return, for each sampled pixel, the largest factor on the focal lengths that keeps it inside the pinhole image.

    The factor is 0 for pixels beyond `MAX_ANGLE`, and for pixels without an angle in the distortion model.
    """
    size, center = np.array([lens.width, lens.height], float), np.array(lens[2:4], float)
    grid = np.meshgrid(*((np.arange(_SAMPLES) + 0.5) * side / _SAMPLES for side in size))
    offset = np.stack(grid, axis=-1).reshape(-1, 2) - center
    bent = np.linalg.norm(offset / lens[:2], axis=1)
    angles = _ANGLES[: np.searchsorted(_ANGLES, min(MAX_ANGLE, _last_angle(lens)), side="right")]
    angle = np.interp(bent, _bent(angles, lens), angles, right=np.nan)
    moved = np.abs(offset) * (np.tan(angle) / np.maximum(bent, 1e-12))[:, None]
    room = np.where(offset > 0, size - center, center)
    return np.nan_to_num((room / np.maximum(moved, 1e-9)).min(axis=1))


def _bent(angles: Float[np.ndarray, " n"], lens: Intrinsics) -> Float[np.ndarray, " n"]:
    """Return the distances of pixels from the principal point, in focal lengths, given the angles of their rays to the
    optical axis."""
    square = angles**2
    return angles * (1 + square * (lens.k1 + square * (lens.k2 + square * (lens.k3 + square * lens.k4))))


def _last_angle(lens: Intrinsics) -> float:
    """Return the angle to the optical axis, in radians, up to which the distance from the principal point increases
    with the angle."""
    turns = np.diff(_bent(_ANGLES, lens)) <= 0
    return float(_ANGLES[turns.argmax()] if turns.any() else _ANGLES[-1])


class _Sources(NamedTuple):
    """Position in the original image for each pixel of the undistorted image, with pixel centers at integers."""

    x: Float32[np.ndarray, "h w"]
    y: Float32[np.ndarray, "h w"]
    filled: Bool[np.ndarray, "h w"]
    """True at pixels that the original image shows."""


@lru_cache(maxsize=2)  # full size, and that of --lift-downscale
def _sources(lens: Intrinsics) -> _Sources:
    pinhole, size = fisheye_pinhole(lens), (lens.width, lens.height)
    fx, fy, cx, cy = lens[:4]
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    for camera in (matrix, pinhole):
        camera[:2, 2] -= 0.5  # OpenCV puts pixel centers at integers
    coefficients = np.array([*lens[6:9], lens.k4])
    x, y = cv2.fisheye.initUndistortRectifyMap(matrix, coefficients, np.eye(3), pinhole, size, cv2.CV_32FC1)
    column, row = ((np.arange(side) - pinhole[i, 2]) / pinhole[i, i] for i, side in enumerate(size))
    filled = np.hypot(column, row[:, None]) <= math.tan(_last_angle(lens))
    for positions, side in ((x, size[0]), (y, size[1])):
        filled &= (positions >= -0.5) & (positions < side - 0.5)
    return _Sources(x, y, filled)


def filled_pixels(lens: Intrinsics) -> Bool[np.ndarray, "h w"]:
    """Return a mask of the pixels of the undistorted image that the original fisheye image shows."""
    return _sources(lens).filled.copy()


def undistort_fisheye(image: UInt8[np.ndarray, "h w c"], lens: Intrinsics) -> UInt8[np.ndarray, "h w c"]:
    """Undistort a fisheye image with bilinear interpolation. Pixels that the original image does not show become 0."""
    x, y, filled = _sources(lens)
    pixels = cv2.remap(image, x, y, interpolation=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return pixels.reshape(*filled.shape, -1) * filled[:, :, None]


def undistort_labels(maps: Int[np.ndarray, "levels h w"], lens: Intrinsics) -> Int64[np.ndarray, "levels h w"]:
    """Undistort label maps of a fisheye image, at any resolution, with nearest-neighbor sampling.

    Pixels that the original image does not show become -1.
    """
    x, y, filled = _sources(lens.resized(maps.shape[2], maps.shape[1]))
    undistorted = np.full(maps.shape, -1, np.int64)
    undistorted[:, filled] = maps[:, np.rint(y[filled]).astype(int), np.rint(x[filled]).astype(int)]
    return undistorted
