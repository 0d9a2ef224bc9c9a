"""Label maps are of the undistorted photographs, as the scene was trained on them, or they are refused."""

from __future__ import annotations

import warnings

from normlift_ns.core.scene import View
from normlift_ns.encoders.cache import CachedRegions
from normlift_ns.encoders.langsplat.source import LangSplat
from normlift_ns.encoders.regions import LabelFiles
from normlift_ns.encoders.source import FeatureSource, RegionFeatures
from normlift_ns.errors import InputError


def check_undistorted(source: FeatureSource, *views: View) -> None:
    """Makes sure that the label map of an undistorted photograph was not made of the photograph as it was taken.

    Undistortion crops by few pixels and moves others by many, so a map of another size cannot be told from one of the
    distorted photograph: only maps of exactly the undistorted size are taken.

    Args:
        views: the same one, at all sizes at which the source may have looked at it.
    Raises:
        ValueError: a map of another size, unless the source is told to resample: that is warned of.
    """
    before, name = views[0].original, views[0].name
    found = source.regions if isinstance(source, RegionFeatures) else source
    found = found.regions if isinstance(found, CachedRegions) else found
    if before is None or not isinstance(found, LabelFiles | LangSplat):
        return
    file, width, height = found.size(name)
    sizes = [(view.camera.width, view.camera.height) for view in views]
    why = "the training undistorted the photograph, which moves and crops what is in it"
    if (width, height) not in sizes:
        kind = "the size of the photograph as it was taken" if (width, height) == before else "another size"
        what = f"is {width}x{height} (width x height), {kind}; {why}, to {sizes[0][0]}x{sizes[0][1]}"
        if not found.resample:
            raise InputError(
                f"label map {file} of {name} {what}. Make the maps from the undistorted images, or accept that they "
                "are some pixels off: --regions-resample True"
            )
        warnings.warn(f"label map {file} {what}; it is stretched, and may be some pixels off", stacklevel=2)
    elif (width, height) == before:
        warnings.warn(
            f"{why} without changing its size: make sure that the label maps in {file.parent} were made from the "
            "undistorted images",
            stacklevel=2,
        )
