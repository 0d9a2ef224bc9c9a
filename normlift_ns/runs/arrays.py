"""Labels of Gaussians as arrays, as point cloud networks (Pointcept) and SceneSplat's benchmark read them."""

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
    """Writes coord.npy [M, 3] float32, segment.npy and instance.npy [M] int32, and names.json, all or none.

    Here classes and objects are counted from 0, class_id - 1 and instance_id - 1, and -1 is what evaluations ignore.

    Args:
        rows: the Gaussians to write.
        overwrite: replace files of these names.
    Raises:
        FileExistsError: there is one, and `overwrite` is False.
        OSError: it cannot be written.
    """
    files = tuple(folder / name for name in ARRAY_FILES)
    names = {
        "ignored": -1,
        "segment": {str(i): text for i, text in enumerate(instances.texts)},
        "instance": {str(i): {"segment": of - 1} for i, of in enumerate(instances.classes)},
    }
    with new_files(*files, overwrite=overwrite) as drafts:
        np.save(drafts[0], means.detach().cpu().numpy()[rows].astype(np.float32))
        for draft, ids in zip(drafts[1:3], (instances.class_id, instances.instance_id)):
            np.save(draft, ids.cpu().numpy()[rows].astype(np.int32) - 1)
        drafts[3].write_text(json.dumps(names, indent=2) + "\n", "utf8")
    return files
