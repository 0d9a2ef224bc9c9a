"""Additional outputs of ns-normlift-export: masks, arrays and labeled point clouds."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Int64
from plyfile import PlyData
from torch import Tensor

from normlift_ns.asking import Answer
from normlift_ns.errors import InputError
from normlift_ns.lifted_run import LiftedRun
from normlift_ns.objects.instances import Instances
from normlift_ns.runs.arrays import write_arrays
from normlift_ns.scripts.shared import say


def masks(run: LiftedRun, selected: Bool[Tensor, " n"], folder: Path, *, rest: bool, overwrite: bool) -> None:
    """Write a mask of every training image; errors are those of `LiftedRun.masks`."""
    say(f"{len(run.masks(folder, selected, rest=rest, overwrite=overwrite))} masks in {folder}")
    with suppress(FileNotFoundError, InputError):  # the first image may be missing
        if run.scene.train[0].original is not None:
            say(
                "The masks fit the undistorted images that the scene was trained with, not the original images of the "
                "capture."
            )


def arrays(
    run: LiftedRun, instances: Instances, rows: Int64[np.ndarray, " m"], folder: Path, *, overwrite: bool
) -> None:
    """Write labels as arrays; errors are those of `write_arrays`."""
    write_arrays(folder, run.scene.gaussians.means, instances, rows, overwrite=overwrite)
    say(f"Labels of {len(rows):,} Gaussians in {folder}")


def transfer(
    run: LiftedRun,
    answer: Answer,
    instances: Instances,
    cloud: PlyData,
    path: Path,
    distance: float,
    coordinates: Literal["capture", "scene"],
    *,
    overwrite: bool,
) -> None:
    """Write a point cloud with the labels of the nearest Gaussians.

    Args:
        run: The lifted run.
        answer: Answer whose relevancies to write.
        instances: Objects of the answer.
        cloud: The point cloud to label.
        path: Path of the labeled cloud.
        distance: Largest distance to a Gaussian, in units of the scene's median spacing.
        coordinates: Coordinates of the cloud.
        overwrite: Replace an existing file.
    Raises:
        FileExistsError, ValueError: Same as in `LiftedRun.transfer`.
    """
    kwargs: dict[str, Any] = {"distance": distance, "coordinates": coordinates, "overwrite": overwrite}
    labeled = run.transfer_to(cloud, path, answer, instances, **kwargs)
    say(f"{labeled.points:,} points in {path}, {labeled.share:.1%} of them within {labeled.limit:.3g} of a Gaussian")
