"""Gain of the consensus with and without its smallest agreement B, for masks of objects and for other regions.

    python -m research.agreement           four rooms made in code, two minutes on a GPU
    python -m research.agreement --quick   the plain room of 5,000 Gaussians, two steps, one seed

The regions are masks, damaged by each step of the ladder, and partitions that ignore objects: squares, and superpixels
of the rendered views. The feature of such a region is the mean over its pixels of their classes, with noise. The
command writes results/agreement.json: B, and the points of mIoU gained over the lift alone with the default and with
`--consensus-min-agreement 0`.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from pathlib import Path
from statistics import fmean

import torch
from skimage.segmentation import slic
from torch import Tensor
from torch.nn.functional import normalize

from normlift_ns import Evidence, lift, rasterize_evidence, render
from normlift_ns.core.consensus import consensus
from normlift_ns.demo.capture import demo_cameras, held_out_cameras
from normlift_ns.demo.room import DemoRoom, demo_room
from research.accuracy import scores_3d
from research.damage import LADDER, observe
from research.documents import Document, table
from research.report import RESULTS, Report
from research.second_room import second
from research.synthetic_scenes import Words, World, made_words, world_of_room
from research.third_room import third
from research.variants import lifted_scores
from tests.plain_room import plain_room

SEEDS, GAUSSIANS = 4, 20_000
SQUARES, SUPERPIXELS = (32, 64, 96), (30, 100, 300)
"""Side of the squares in pixels, in images 320 pixels wide, and approximate number of superpixels per view."""
DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
"""Device that rasterizes the scenes."""
NOISE = 0.5
"""Length of the noise that is added to the unit feature of every region of a partition."""


def _room(make: Callable[[int], DemoRoom]) -> Callable[[int], World]:
    cameras = demo_cameras(24, 320, 240), held_out_cameras(1, 320, 240)
    return lambda count: world_of_room("room", make(count), *cameras)


ROOMS = {"demo": _room(demo_room), "plain": _room(plain_room), "second": second, "third": third}


def partitions(world: World) -> Iterator[tuple[str, list[Tensor]]]:
    """Yield the name of each partition and its label maps [H, W] of all views."""
    views, height, width = world.cells.maps.shape
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    for side in SQUARES:
        yield f"squares of {side} pixels", [y // side * -(-width // side) + x // side] * views
    assert world.colors is not None
    scene, colors = world.scene.to(DEVICE), world.colors.to(DEVICE)
    pictures = [render(scene, camera, colors)[0].clamp(0, 1).cpu() for camera in world.cameras]
    for count in SUPERPIXELS:
        found = [torch.from_numpy(slic(x.numpy(), n_segments=count, start_label=0)) for x in pictures]
        yield f"{count} superpixels", [x.unique(return_inverse=True)[1] for x in found]


def called(labels: list[Tensor], maps: Tensor, classes: Tensor) -> Tensor:
    """Return unit features of the regions of a partition: the mean class vector of their pixels, with noise."""
    g, out = torch.Generator().manual_seed(0), []
    for regions, truth in zip(labels, maps):
        known = truth >= 0
        total = torch.zeros(int(regions.max()) + 1, classes.shape[1])
        total.index_add_(0, regions[known].long(), classes[truth[known].long()])
        noise = normalize(torch.randn(total.shape, generator=g), dim=1)
        out.append(normalize(normalize(total, dim=1) + NOISE * noise, dim=1))
    return torch.cat(out)


def gains(world: World, words: Words, evidence: Evidence, features: Tensor) -> dict[str, float]:
    """Return B, and the points of mIoU gained by the consensus with its default smallest B and with 0."""
    default, always = consensus(evidence, features), consensus(evidence, features, least=0.0)
    known = (world.truth >= 0).nonzero().squeeze(1)
    alone, as_it_is, unlimited = (
        scores_3d(world, lifted_scores(lift(evidence, x), words.classes), known)["miou"]
        for x in (features, default.features, always.features)
    )
    return {"agreement": default.agreement[0], "gain": as_it_is - alone, "unlimited": unlimited - alone}


def observations(name: str, *, quick: bool) -> Iterator[tuple[str, dict[str, float]]]:
    """Yield kinds of regions with the gains of the consensus. Each damage step occurs once per seed."""
    world = ROOMS[name](5000 if quick else GAUSSIANS)
    words = made_words(world.classes)
    for step in ("mild", "hard") if quick else LADDER:
        for seed in range(1 if quick else SEEDS):
            observed = observe(world, words, LADDER[step], seed)
            yield step, gains(world, words, observed.evidence, observed.features)
    for kind, labels in partitions(world):
        evidence = rasterize_evidence(world.scene.to(DEVICE), world.cameras, labels).to("cpu")
        yield kind, gains(world, words, evidence, called(labels, world.cells.maps, words.classes.float()))


def by_regions(found: Document) -> str:
    """Return a table with a row per kind of region: B, the gain, and the gain with a smallest B of 0.

    It has one group of columns for the demo room, and one for the three other rooms.
    """
    kinds = [key.removeprefix("demo.").removesuffix(".agreement") for key in found.values if key.startswith("demo.")]
    rows = []
    for kind in (x for x in kinds if "." not in x):
        cells = []
        for rooms in (("demo",), ("plain", "second", "third")):
            b, gain, unlimited = (
                [found.values[f"{room}.{kind}.{x}"] for room in rooms] for x in ("agreement", "gain", "unlimited")
            )
            span = f"{b[0]:.2f}" if len(b) == 1 else f"{min(b):.2f} to {max(b):.2f}"
            cells += [span, *(f"{fmean(x):+.1f}" for x in (gain, unlimited))]
        rows.append((kind, *cells))
    header = ("demo room: B", "gain", "gain, least 0", "three rooms: B", "gain", "gain, least 0")
    return table(("regions", *header), rows)


def main(output: Path, *, quick: bool) -> None:
    torch.set_grad_enabled(False)
    report = Report("agreement")
    for name in ("plain",) if quick else ROOMS:
        found = dict[str, list[dict[str, float]]]()
        for kind, row in observations(name, quick=quick):
            found.setdefault(kind, []).append(row)
            print(f"{name}, {kind}:", ", ".join(f"{key} {value:.2f}" for key, value in row.items()), flush=True)
        for kind, rows in found.items():
            for key, unit in (("agreement", "B"), ("gain", "points of mIoU"), ("unlimited", "points of mIoU")):
                report.add(f"{name}.{kind}.{key}", fmean(row[key] for row in rows), unit)
    report.write(output)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--output", type=Path, default=RESULTS, help="folder of the JSON file")
    arguments = parser.parse_args()
    main(arguments.output, quick=arguments.quick)
