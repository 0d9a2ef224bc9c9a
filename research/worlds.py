"""Distances of renders from the images' mean color, and the search for the world of a splat, on the captures.

    python -m research.worlds                     results/worlds.json
    python -m research.worlds --processes 16      the same on 16 cores
    python -m research.worlds --quick             two worlds and four rotations of each capture

The cameras of a capture are written in the world of its splat, which is the right one. Then the splat is rotated and
scaled by the transforms that `--world-transform auto` tries. The cameras are also rotated by random rotations that it
does not try. pale is the fox with a tenth of its contrast, and with noise of two levels like that of sensors.

Keys: <capture>.right.margin, .psnr and .mean_color of the right world; <capture>.wrong.margin, the largest of the wrong
ones; <capture>.<world>.found, .margin in the first world, .psnr in the found one, and .seconds of the search;
<capture>.random.taken of .rotations; <capture>.focal<factor>.psnr and .margin.
"""

from __future__ import annotations

import argparse
import atexit
import os
import tempfile
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import cache
from itertools import islice
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numba
import numpy as np
import torch
from PIL import Image
from scipy.spatial.transform import Rotation

import normlift_ns as nl
from normlift_ns.data.alignment import Alignment, measure_alignment
from normlift_ns.data.frames import Frame, transform_frames
from normlift_ns.data.open_scene import SplatScene
from normlift_ns.data.splat import SplatParameters
from normlift_ns.data.transforms import (
    gsplat_normalization,
    read_transforms,
    read_world_transform,
    write_transforms,
)
from normlift_ns.data.worlds import with_opengl_axes
from research.report import Report, Stopwatch, stopwatch
from tests.captures import SHARED, capture
from tests.data.scene_files import in_file_world, in_world, ply_columns, write_colmap, write_ply

CAPTURES = ("fox", "castle", "tabletop", "pale")
FACTORS = (1.0, 1.01, 1.02, 1.05, 1.5)
ROTATIONS = 50
"""Number of random rotations of each capture."""
_QUARTER = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
TURNS = {
    "half_x": np.diag([1.0, -1, -1]),
    "half_y": np.diag([-1.0, 1, -1]),
    "half_z": np.diag([-1.0, -1, 1]),
    "y_up_to_z_up": _QUARTER.T,
    "z_up_to_y_up": _QUARTER,
    "exchange": np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]]),
    "scale_2.5": 2.5 * np.eye(3),
    "scale_0.23": 0.23 * np.eye(3),
    "scale_0.0137": 0.0137 * np.eye(3),
    "z_up_to_y_up_scale_100": 100 * _QUARTER,
}
Rows = list[tuple[str, float, str]]
"""Keys, values and units of metrics."""
_CONTRAST, _NOISE = 0.1, 2.0
"""Factor on the contrast of the pale capture, and standard deviation of its noise in levels of 255."""


class Case:
    """A capture whose cameras are in the world of its splat, in files of a folder."""

    def __init__(self, name: str, folder: Path) -> None:
        source = "fox" if name == "pale" else name
        run = capture(source)
        cameras = read_transforms(SHARED / "captures" / source)
        file = run.location.run_dir / "dataparser_transforms.json"
        world = read_world_transform(file, cameras.applied_transform, cameras.applied_scale)
        self.name, self.folder, self.count = name, folder, 0
        self.frames = transform_frames(cameras.frames, world)
        self.splat = SplatParameters(**run.parameters)
        self.captured = SHARED / "captures" / source
        if name == "pale":
            self.splat = _pale_splat(self.splat)
            self.frames = [replace(frame, file=_pale_image(frame, folder)) for frame in self.frames]

    def open(
        self, matrix: np.ndarray | None = None, frames: list[Frame] | None = None, **options: Any
    ) -> tuple[SplatScene, Stopwatch]:
        """Open the splat in another world, with cameras, and measure the seconds that this takes."""
        self.count += 1
        path, transforms = self.folder / f"{self.count}.ply", self.folder / f"{self.count}.json"
        splat = self.splat if matrix is None else in_world(self.splat, matrix)
        write_ply(path, ply_columns(splat))
        if "colmap" not in options and "transforms" not in options:
            write_transforms(transforms, frames or self.frames, [])
            options["transforms"] = transforms
        with stopwatch() as watch:
            scene = nl.open_splat(path, nl.SplatOptions(**options))
        path.unlink()
        return scene, watch

    def worlds(self) -> Iterator[tuple[str, str, np.ndarray | None, dict[str, Any]]]:
        """Yield the key and part of the name of every world, the change of the splat, and options for its cameras."""
        for key, linear in TURNS.items():
            yield key, "", _square(linear), {}
        write_transforms(self.folder / "opencv.json", with_opengl_axes(self.frames), [])
        yield "opencv_cameras", "OpenCV", None, {"transforms": self.folder / "opencv.json"}
        if self.name != "pale":
            yield "ns_train", "ns-train", None, {"transforms": self.captured / "transforms.json"}
        points = self.splat.means[::20].numpy().astype(float)
        images = self.frames[0].file.parent
        project = write_colmap(self.folder / "project", self.frames, points=points)
        world = gsplat_normalization(sorted(self.frames, key=lambda frame: frame.name), points)
        matrix = np.vstack([world.scale * world.transform, [0, 0, 0, 1]])
        for key, turn in {"gsplat": np.eye(3), "gsplat_half_z": TURNS["half_z"]}.items():
            yield key, "gsplat", _square(turn) @ matrix, {"colmap": project, "images": images}


def _square(linear: np.ndarray) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3] = linear
    return matrix


def _pale_splat(splat: SplatParameters) -> SplatParameters:
    return replace(splat, features_dc=_CONTRAST * splat.features_dc, features_rest=_CONTRAST * splat.features_rest)


def _pale_image(frame: Frame, folder: Path) -> Path:
    """Write an image with little contrast around gray, which is the color 0 of spherical harmonics."""
    pixels = np.array(Image.open(frame.file).convert("RGB")).astype(float)
    noise = np.random.default_rng(len(frame.name)).normal(scale=_NOISE, size=pixels.shape)
    path = folder / "images" / frame.file.with_suffix(".png").name
    path.parent.mkdir(exist_ok=True)
    Image.fromarray((127.5 + _CONTRAST * (pixels - 127.5) + noise).round().clip(0, 255).astype(np.uint8)).save(path)
    return path


def _first(case: Case, matrix: np.ndarray | None, options: dict[str, Any]) -> Alignment:
    """Return the alignment in the first world, without a search."""
    scene, _ = case.open(matrix, **{**options, "world_transform": None})
    return measure_alignment(scene, explain=False)


def measure_right(case: Case) -> Rows:
    """Return the figures of the right world, and of other focal lengths in it."""
    name = case.name
    scene, watch = case.open()
    match = measure_alignment(scene, explain=False)
    assert scene.identity["source_world"]["name"] == "the world of its cameras"
    rows = [(f"{name}.right.seconds", watch.seconds, "s")]
    for key, value in (("margin", match.margin), ("psnr", match.psnr), ("mean_color", match.mean_color_psnr)):
        rows.append((f"{name}.right.{key}", value, "dB"))
    for factor in FACTORS:
        lenses = [frame.intrinsics._replace(fx=factor * frame.intrinsics.fx, fy=factor * frame.intrinsics.fy)
                  for frame in case.frames]  # fmt: skip
        frames = [replace(frame, intrinsics=lens) for frame, lens in zip(case.frames, lenses)]
        scene, _ = case.open(frames=frames, world_transform=None)
        match = measure_alignment(scene, explain=False)
        rows += [(f"{name}.focal{factor}.psnr", match.psnr, "dB"), (f"{name}.focal{factor}.margin", match.margin, "dB")]
    return rows


def measure_world(case: Case, number: int) -> Rows:
    """Return the figures of one of `Case.worlds`."""
    key, part, matrix, options = next(islice(case.worlds(), number, None))
    first = _first(case, matrix, options)
    scene, watch = case.open(matrix, **options)
    world = scene.identity["source_world"]
    found = scene.alignment is not None and part in world["name"] and _is_right(scene, case)
    print(case.name, key, world["name"], found, f"{watch.seconds:.1f} s", flush=True)
    name, psnr = f"{case.name}.{key}", measure_alignment(scene, explain=False).psnr
    return [
        (f"{name}.found", found, "of 1"),
        (f"{name}.margin", first.margin, "dB"),
        (f"{name}.psnr", psnr, "dB"),
        (f"{name}.seconds", watch.seconds, "s"),
    ]


def measure_rotations(case: Case, numbers: range) -> Rows:
    """Return, for random rotations, whether a world is accepted, and its margin."""
    generator = np.random.default_rng(CAPTURES.index(case.name))
    turns, rows = generator.normal(size=(ROTATIONS, 4)), []
    for number in numbers:
        turn = Rotation.from_quat(turns[number]).as_matrix()
        scene, watch = case.open(frames=in_file_world(case.frames, _square(turn)))
        taken, margin = scene.alignment is not None, measure_alignment(scene, explain=False).margin
        print(case.name, "random", number, f"{margin:.1f} dB, {watch.seconds:.1f} s", "taken" * taken, flush=True)
        rows += [(f"{case.name}.random{number}.taken", taken, ""), (f"{case.name}.random{number}.margin", margin, "dB")]
    return rows


def summarize(name: str, rows: Rows) -> Rows:
    """Return the rows of a capture with one row for all random rotations, and with the largest wrong margin."""
    kept = [row for row in rows if ".random" not in row[0]]
    taken = [value for key, value, _ in rows if key.endswith(".taken")]
    right = (f"{name}.right.", f"{name}.focal")
    wrong = [value for key, value, _ in rows if key.endswith(".margin") and not key.startswith(right)]
    return [
        *kept,
        (f"{name}.wrong.margin", max(wrong), "dB"),
        (f"{name}.random.rotations", len(taken), "rotations"),
        (f"{name}.random.taken", sum(taken), "rotations"),
    ]


def _limit_threads(count: int) -> None:
    torch.set_num_threads(count)
    numba.set_num_threads(count)


@cache
def _case(name: str) -> Case:
    """Return the case of a capture, cached in each process, with compiled kernels."""
    folder = tempfile.TemporaryDirectory()
    atexit.register(folder.cleanup)
    case = Case(name, Path(folder.name))
    case.open()
    return case


def _piece(name: str, part: int | range | None) -> Rows:
    case = _case(name)
    if part is None:
        return measure_right(case)
    return measure_world(case, part) if isinstance(part, int) else measure_rotations(case, part)


def _is_right(scene: SplatScene, case: Case) -> bool:
    """Return whether the distances of cameras from the splat are those of the right world, relative to its size."""
    centers = np.array([frame.pose[:, 3] for frame in scene.train.frames])
    right = np.array([frame.pose[:, 3] for frame in sorted(case.frames, key=lambda frame: frame.file)])
    means = scene.splat.means[:: len(scene.splat) // 100].double().numpy()
    known = case.splat.means[:: len(case.splat) // 100].double().numpy()
    found, expected = (np.linalg.norm(a[:, None] - b, axis=2) for a, b in ((centers, means), (right, known)))
    return bool(np.allclose(found / found.mean(), expected / expected.mean(), rtol=0.01, atol=0.01))


def main() -> None:
    """Measure all captures, and write the results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="two worlds and four rotations")
    parser.add_argument("--captures", nargs="+", default=CAPTURES, choices=CAPTURES, help="names of captures")
    parser.add_argument("--processes", type=int, default=1, help="number of processes that share the cores")
    parser.add_argument("--name", default="worlds", help="name of the results")
    args = parser.parse_args()
    rotations, step = (4, 8) if args.quick else (ROTATIONS, 1)
    report, found = Report(args.name), dict[str, list[Any]]()
    threads = max(1, len(os.sched_getaffinity(0)) // args.processes)
    with ProcessPoolExecutor(args.processes, get_context("spawn"), _limit_threads, (threads,)) as pool:
        for name in args.captures:
            count = len(TURNS) + (3 if name == "pale" else 4)
            parts = [None, *range(0, count, step), *(range(i, i + 2) for i in range(0, rotations, 2))]
            found[name] = [pool.submit(_piece, name, part) for part in parts]
        for name, pieces in found.items():
            for row in summarize(name, [row for piece in pieces for row in piece.result()]):
                report.add(*row)
    report.write()


if __name__ == "__main__":
    main()
