"""Agreement of answers after single attributes of a capture are rounded to the precision of SPZ.

python -m research.spz_attributes tabletop
"""

from __future__ import annotations

import shutil
import sys
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

import normlift_ns as nl
from normlift_ns.data.gltf import encode_glb
from normlift_ns.data.splat import GAUSSIAN_PARAMETERS, SplatParameters
from normlift_ns.data.spz import decode_spz, encode_spz
from normlift_ns.exports import TrainedSplat, exportable_rows
from tests.captures import SHARED
from tests.data.scene_files import rows_of

SOURCE = nl.SourceOptions(encoder="color", regions="grid")
LIFT = nl.LiftOptions(storage="evidence", max_views=6, lift_downscale=4)
FOLDER = Path("outputs/spz_attributes")
TEXTS = {
    "fox": ("orange", "crimson", "gray"),
    "tabletop": ("dusty red", "black", "white"),
    "castle": ("sky blue", "dark green", "beige"),
}


def selected(splat: SplatParameters, name: str, options: nl.SplatOptions) -> Tensor:
    """Return the Gaussians that the prompts select after a lift; GLB files are exact."""
    path = FOLDER / "splat.glb"
    path.write_bytes(encode_glb(splat, {}, {}))
    scene = nl.open_splat(path, options)
    where = {"output_dir": FOLDER / "run", "timestamp": "t"}
    run = nl.lift_run(scene, source=SOURCE, lift=LIFT, check_alignment=False, **where)  # type: ignore[arg-type]
    chosen = run.ask(*TEXTS[name], threshold=0.5).selected.clone()
    shutil.rmtree(FOLDER / "run")
    return chosen


def main(name: str) -> None:
    """Print the intersection over union of each prompt, with the attributes that are rounded."""
    config = SHARED / "captures" / "outputs" / name / "splatfacto" / "run" / "config.yml"
    trained = TrainedSplat.of(nl.open_scene(config))
    rows = exportable_rows(trained.columns(), torch.ones(len(trained.parameters["means"]), dtype=torch.bool))
    splat = rows_of(trained.with_harmonics(), torch.from_numpy(rows))  # type: ignore[arg-type]
    options = nl.SplatOptions(
        transforms=SHARED / "captures" / name, world_transform=config.parent / "dataparser_transforms.json"
    )
    FOLDER.mkdir(parents=True, exist_ok=True)
    rounded = decode_spz(encode_spz(splat), Path("splat.spz")).splat.parameters
    cases = {"all": rounded} | {key: {key: rounded[key]} for key in GAUSSIAN_PARAMETERS}
    cases["all except scales"] = {key: value for key, value in rounded.items() if key != "scales"}
    cases |= {f"scales, steps of 1/{n}": {"scales": (splat.scales * n).round() / n} for n in (32, 64)}
    before = selected(splat, name, options)
    for case, change in cases.items():
        after = selected(replace(splat, **change), name, options)
        overlap = (after & before).sum(0) / (after | before).sum(0)
        print(f"| {case} | " + " | ".join(f"{value:.4f}" for value in overlap.tolist()) + " |", flush=True)


if __name__ == "__main__":
    main(sys.argv[1])
