"""Export of Gaussian labels as NPY arrays, in the layout of Pointcept and of SceneSplat's benchmark."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int64
from torch import Tensor

from normlift_ns.core.files import new_files
from normlift_ns.objects.instances import Instances
from normlift_ns.options import ARRAY_FILES


def write_arrays(
    folder: Path,
    means: Float[Tensor, "n 3"],
    instances: Instances,
    rows: Int64[np.ndarray, " m"],
    *,
    overwrite: bool = False,
) -> tuple[Path, ...]:
    """Write coord.npy [M, 3] float32, segment.npy and instance.npy [M] int32, and names.json, all or none.

    Classes and objects are numbered from 0 here, as class_id - 1 and instance_id - 1; evaluations ignore -1.

    Args:
        rows: indices of the Gaussians to write.
        overwrite: replace existing files.
    Returns:
        Paths of the four files.
    Raises:
        FileExistsError: a file exists, and `overwrite` is False.
        OSError: a file cannot be written.
    """
    files = tuple(folder / name for name in ARRAY_FILES)
    names = {
        "ignored": -1,
        "segment": {str(i): text for i, text in enumerate(instances.texts)},
        "instance": {str(i): {"segment": class_id - 1} for i, class_id in enumerate(instances.classes)},
    }
    with new_files(*files, overwrite=overwrite) as drafts:
        np.save(drafts[0], means.detach().cpu().numpy()[rows].astype(np.float32))
        for draft, ids in zip(drafts[1:3], (instances.class_id, instances.instance_id)):
            np.save(draft, ids.cpu().numpy()[rows].astype(np.int32) - 1)
        drafts[3].write_text(json.dumps(names, indent=2) + "\n", "utf8")
    return files
