"""ns-normlift-export: what it writes beside the splat, for tools that take masks, arrays or point clouds."""

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
    """Masks of every training photograph; raises as `LiftedRun.masks`."""
    say(f"{len(run.masks(folder, selected, rest=rest, overwrite=overwrite))} masks in {folder}")
    with suppress(FileNotFoundError, InputError):  # a photograph that is gone says nothing
        if run.scene.train[0].original is not None:
            say(
                "The masks fit the photographs without lens distortion, as the scene was trained on them, not those in "
                "the folder of the capture."
            )


def arrays(
    run: LiftedRun, instances: Instances, rows: Int64[np.ndarray, " m"], folder: Path, *, overwrite: bool
) -> None:
    """Labels as arrays; raises as `write_arrays`."""
    write_arrays(folder, run.scene.gaussians.means, instances, rows, overwrite=overwrite)
    say(f"Labels of {len(rows):,} Gaussians in {folder}")


def transfer(
    run: LiftedRun,
    answer: Answer,
    instances: Instances,
    cloud: PlyData,
    path: Path,
    most: float,
    coordinates: Literal["capture", "scene"],
    *,
    overwrite: bool,
) -> None:
    """A cloud with the labels of the nearest Gaussians; raises as `LiftedRun.transfer`."""
    how: dict[str, Any] = {"distance": most, "coordinates": coordinates, "overwrite": overwrite}
    found = run.transfer_to(cloud, path, answer, instances, **how)
    say(f"{found.points:,} points in {path}, {found.share:.1%} of them within {found.limit:.3g} of a Gaussian")
