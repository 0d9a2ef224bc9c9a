"""Check that label maps match the undistorted images that the scene was trained on."""

from __future__ import annotations

import warnings

from normlift_ns.core.scene import View
from normlift_ns.encoders.cache import CachedRegions
from normlift_ns.encoders.langsplat.source import LangSplat
from normlift_ns.encoders.regions import LabelFiles
from normlift_ns.encoders.source import FeatureSource, RegionFeatures
from normlift_ns.errors import InputError


def check_undistorted(source: FeatureSource, *views: View) -> None:
    """Check that the label map of an undistorted image was not made from the original, distorted image.

    Undistortion crops an image by a few pixels, but may move its content by many. A map of another size may therefore
    show the distorted image, so only maps of exactly the undistorted size are accepted.

    Args:
        views: The same view at every size at which the source may have processed it.
    Raises:
        ValueError: If a map has another size, unless the source resamples maps; then the function warns.
    """
    original_size, name = views[0].original, views[0].name
    maps = source.regions if isinstance(source, RegionFeatures) else source
    maps = maps.regions if isinstance(maps, CachedRegions) else maps
    if original_size is None or not isinstance(maps, LabelFiles | LangSplat):
        return
    file, width, height = maps.size(name)
    sizes = [(view.camera.width, view.camera.height) for view in views]
    reason = "training undistorted the image, which moves and crops its content"
    if (width, height) not in sizes:
        kind = "the size of the original image" if (width, height) == original_size else "another size"
        mismatch = f"is {width}x{height} (width x height), {kind}; {reason}, to {sizes[0][0]}x{sizes[0][1]}"
        if not maps.resample:
            raise InputError(
                f"label map {file} of {name} {mismatch}. Make the maps from the undistorted images, or accept an error "
                "of some pixels: --regions-resample True"
            )
        warnings.warn(f"label map {file} {mismatch}; it is stretched, and may be some pixels off", stacklevel=2)
    elif (width, height) == original_size:
        warnings.warn(
            f"{reason} without changing its size: make sure that the label maps in {file.parent} were made from the "
            "undistorted images",
            stacklevel=2,
        )
