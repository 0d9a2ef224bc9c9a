"""Fields of scenes as people write them, against numbers that version 0.2 made."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from PIL import Image

import normlift_ns as nl
from normlift_ns.data.open_scene import SplatScene
from normlift_ns.data.splat import SplatParameters
from tests.data.scene_files import ply_columns, write_colmap, write_gsplat, write_ply
from tests.data.test_open_scene import _before, frames, native, splat  # noqa: F401 (fixtures)
from tests.random_scenes import generator

GOLDEN = {
    "run": [1.550911, 0.517914, 0.487446, 0.678298, 0.578619, 0.591747, 0.568412, 0.616744, 0.484737],
    "own intrinsics": [1.381454, 0.497452, 0.491336, 0.565203, 0.481207, 0.451494, 0.543786, 0.531722, 0.426057],
    "odd names": [1.578241, 0.511094, 0.637912, 0.640541, 0.529653, 0.615335, 0.600537, 0.647412, 0.492427],
    "three cameras": [1.557764, 0.506935, 0.626707, 0.645445, 0.497219, 0.509953, 0.621694, 0.48722, 0.498498],
}
"""Means of n_eff and R, and seven values of R. All other scenes are those of the run, to the last digit."""
OPTIONS = {
    "source": nl.SourceOptions(encoder="color", regions="grid"),
    "lift": nl.LiftOptions(storage="evidence", max_views=5, vote=nl.RefineConfig(k=12)),
}
NAMES = ("a b.PNG", "ünï#.png", "100%.png", "a.b.c.png", "(x).png", "[y].png", "-z.png", "'q'.png")


def _transforms(folder: Path, views: list, name: Callable[[int], str], size: Callable[[int], int]) -> nl.SplatOptions:
    """A capture whose frames have their own intrinsics and names; images of 1 / size."""
    entries = []
    for i, frame in enumerate(views):
        (folder / name(i)).parent.mkdir(parents=True, exist_ok=True)
        c, image = frame.intrinsics, Image.open(frame.file)
        width, height = c.width // size(i), c.height // size(i)
        image.resize((width, height), Image.Resampling.BOX).save(folder / name(i), "PNG")
        own = {"fl_x": c.fx / size(i), "fl_y": c.fy / size(i), "cx": c.cx / size(i), "cy": c.cy / size(i)}
        pose = [*frame.pose.tolist(), [0, 0, 0, 1]]
        entries.append({"file_path": name(i), "transform_matrix": pose, "w": width, "h": height, **own})
    (folder / "transforms.json").write_text(json.dumps({"frames": entries}))
    return nl.SplatOptions(transforms=folder)


def summary(scene: SplatScene, folder: Path) -> list[float]:
    """Means and a sample of the field that a lift writes."""
    scalars = nl.lift_run(scene, output_dir=folder, timestamp="t", check_alignment=False, **OPTIONS).field.scalars
    sample = scalars.reliability[:: len(scalars.reliability) // 8][:7]
    numbers = [scalars.n_eff.double().mean(), scalars.reliability.double().mean(), *sample]
    return [round(float(number), 6) for number in numbers]


@pytest.mark.slow
def test_fields_are_those_of_the_version_before(native, splat: SplatParameters, frames, trained, tmp_path) -> None:  # noqa: F811
    found: dict[str, list[float]] = {}

    def lift(kind: str, scene: SplatScene) -> None:
        found[kind] = summary(scene, tmp_path / f"out{len(found)}")

    world = trained.parent / "dataparser_transforms.json"
    files = nl.SplatOptions(transforms=native.location.folder, world_transform=world)
    path = write_ply(tmp_path / "s.ply", ply_columns(splat))
    lift("ply", nl.open_splat(path, files))
    for kind, name, size in (
        ("own intrinsics", lambda i: f"{i:03}.png", lambda i: 1 + i % 2),
        ("odd names", lambda i: f"x/{i // 8}/{NAMES[i % 8]}", lambda i: 1),
        ("three cameras", lambda i: f"{('left', 'middle', 'right')[i % 3]}/{i // 3:04}.png", lambda i: 1),
    ):
        lift(kind, nl.open_splat(path, _transforms(tmp_path / kind, frames, name, size)))
    moves = 0.05 * torch.randn(len(native.train), 9, generator=generator(0), dtype=torch.float64)
    eval_images = tuple(native.held_out.names)
    project = write_colmap(tmp_path / "p", _before(frames, moves, eval_images), "PINHOLE")
    checkpoint = write_gsplat(tmp_path / "ckpt_29999_rank0.pt", splat, pose_adjust={"embeds.weight": moves})
    images = native.location.folder / "images"
    moved = nl.SplatOptions(colmap=project, images=images, eval_images=eval_images, gsplat_normalize=False)
    lift("moved poses", nl.open_splat(checkpoint, moved))
    lift("run", native)
    for kind, numbers in found.items():
        expected = GOLDEN.get(kind, found["run"])
        assert numbers == pytest.approx(expected, abs=2e-4 if kind in GOLDEN else 1e-6), kind
