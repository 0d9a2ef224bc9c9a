"""Images of a scene: which were lifted, and why others were not."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal, NamedTuple

import msgspec

from normlift_ns.core.gaussians import Camera
from normlift_ns.core.scene import Scene
from normlift_ns.errors import InputError
from normlift_ns.observing import spread

Why = Literal["max_views", "no features", "held out"]
MOST_VIEWS = 256
"""Maximum number of lifted images, and of other images, that are examined."""


class _Counts(msgspec.Struct):
    views: int | None = None
    left_out: int | None = None


class _Options(msgspec.Struct):
    max_views: Annotated[int, msgspec.Meta(ge=1)] | None = None


class _LiftRecord(msgspec.Struct):
    """Record of the images of a lift in a manifest."""

    views_lifted: list[str] | None = None
    views_without_features: list[str] = []
    statistics: _Counts = msgspec.field(default_factory=_Counts)
    options: _Options = msgspec.field(default_factory=_Options)


class Photographs(NamedTuple):
    """Images to examine, the lifted ones first."""

    lifted: int
    names: list[str]
    cameras: list[Camera]
    why: list[Why]
    """Reasons for the images that were not lifted."""
    left_out: dict[Why, int]


def lifted_names(scene: Scene, manifest: Mapping[str, Any]) -> tuple[set[str], set[str]]:
    """Return the names of the images that were lifted, and of those without features.

    Raises:
        ValueError: the manifest does not record them, or the scene no longer has some of them.
    """
    names = list(scene.train.names)
    try:
        record = msgspec.convert(
            {key: manifest[key] for key in _LiftRecord.__struct_fields__ if key in manifest}, _LiftRecord
        )
    except msgspec.ValidationError as error:
        raise InputError(f"the run's record of its images is damaged ({error}); lift again") from None
    used, counts = record.views_lifted, record.statistics
    if used is None and counts.left_out == 0:  # version 0.1 has only counts
        indices = spread(len(names), record.options.max_views)
        used = [names[i] for i in indices] if len(indices) == counts.views else None
    if used is None:
        raise InputError(
            "the run does not record which images were lifted: it is from an older version, and some images had no "
            "features; lift again with: ns-normlift --load-config ..."
        )
    if not set(used) <= set(names):
        raise InputError(
            f"the run was lifted from images that {scene.name} no longer has; restore the dataset, give its path with "
            "--data, or lift again"
        )
    return set(used), set(record.views_without_features)


def photographs_of(scene: Scene, manifest: Mapping[str, Any]) -> Photographs:
    """Return the images of a scene according to the manifest of the lift; of very many, an evenly spaced selection.

    Raises:
        ValueError: as `lifted_names`.
    """
    used, unusable = lifted_names(scene, manifest)
    lifted: list[tuple[str, Camera]] = []
    others: list[tuple[str, Camera, Why]] = []
    for name, camera in zip(scene.train.names, scene.train.cameras):
        if name in used:
            lifted.append((name, camera))
        else:
            why: Why = "no features" if name in unusable else "max_views"
            others.append((name, camera, why))
    for name, camera in zip(scene.held_out.names, scene.held_out.cameras):
        others.append((name, camera, "held out"))
    reasons: list[Why] = [why for *_, why in others]
    lifted = [lifted[i] for i in spread(len(lifted), MOST_VIEWS)]
    others = [others[i] for i in spread(len(others), MOST_VIEWS)]
    return Photographs(
        len(lifted),
        [name for name, *_ in (*lifted, *others)],
        [camera for _, camera, *_ in (*lifted, *others)],
        [why for *_, why in others],
        {why: reasons.count(why) for why in dict.fromkeys(reasons)},
    )
