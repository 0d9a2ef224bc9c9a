"""Regions between learned edges on photographs: error of the network, times, and agreement with labels drawn by hand.

    python -m research.edges                   the fox: error, seconds per image, fit; results/edges.json
    python -m research.edges --device cuda     error, seconds per image, differences from a CPU; results/edges_gpu.json
    python -m research.edges --clip            CLIP ViT-B-16 on a CPU, in patches and on crops; results/edges_clip.json

*Error*: the largest difference of edge probabilities between the network and numpy in float64, on a crop of 300 x 300
pixels. The numpy version (`tests/encoders/hed.py`) reads the weight file independently.

*Fit* of a label: the largest IoU of a union of regions with the label, as the mean over six images. If regions are
sorted by their share inside the label, the best union consists of the first k. SLIC makes as many superpixels as there
are regions, or the next larger number that it can.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from itertools import count
from pathlib import Path
from statistics import mean, median
from tempfile import TemporaryDirectory
from time import perf_counter

import numpy as np
import torch
from PIL import Image, ImageDraw

from normlift_ns.encoders.base import PatchFeatures
from normlift_ns.encoders.weights import EDGES
from normlift_ns.segmentation.edges import EDGE_COUNTS, WORKING_PIXELS, EdgeRegions, watershed_levels
from normlift_ns.segmentation.regions import Superpixels, read_image
from research.front_end_inputs import Size, random_clip
from research.report import Report
from tests.captures import SHARED, capture
from tests.encoders.hed import edge_probability

CAPTURES = SHARED / "captures"
PIXELS = (2**17, 481 * 321, WORKING_PIXELS, 2**20)
"""Working sizes. 481 x 321 is the size of the training images, and 2**20 leaves the images of the fox unchanged."""


def main() -> None:
    """Write the results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--clip", action="store_true")
    args = parser.parse_args()
    device, paths = args.device, sorted((CAPTURES / "fox" / "images").glob("*.jpg"))
    source = EdgeRegions(device=device)
    report = Report("edges_clip" if args.clip else "edges" if device == "cpu" else "edges_gpu")
    if args.clip:
        time_clip(report, source, read_image(paths[0]))
    else:
        measure_error(report, source, read_image(paths[0])[300:600, 100:400])
        measure_time(report, source, paths)
        if device == "cpu":
            measure_fit(report, source)
        else:
            compare_devices(report, source, paths)
    report.write()


def measure_error(report: Report, source: EdgeRegions, crop: torch.Tensor) -> None:
    """Add the error of the network."""
    with torch.backends.cudnn.flags(enabled=True, benchmark=False, deterministic=True, allow_tf32=False):
        found = source.network(crop.to(source.device)).double().cpu().numpy()
    report.add("network.error", np.abs(found - edge_probability(EDGES.read(), crop.numpy())).max(), "probability")


def measure_time(report: Report, source: EdgeRegions, paths: list[Path]) -> None:
    """Add the times for images of two sizes, and whether regions are reproducible. The shortest time excludes other
    programs."""
    photographs = [read_image(path) for path in paths[:12]]
    large = [torch.from_numpy(np.array(Image.fromarray(x.numpy()).resize((1080, 1920)))) for x in photographs]
    for name, images in (("540x960", photographs), ("1080x1920", large)):
        _ = source.labels(images[0], "")
        maps = [source.edges(x) for x in images]
        edges = [seconds(lambda x=x: source.edges(x)) for x in images]
        levels = [seconds(lambda x=x: watershed_levels(x, EDGE_COUNTS)) for x in maps]
        report.add(f"{name}.edges", min(edges), "s per image, the fastest of 12")
        report.add(f"{name}.levels", median(levels), "s per image, the watershed of its edge map")
    sources = {pixels: replace(source, pixels=pixels) for pixels in PIXELS}
    taken = [[seconds(lambda x=x, one=one: one.edges(x)) for one in sources.values()] for x in photographs]
    for pixels, values in zip(sources, zip(*taken[1:])):  # the first loads the weights
        report.add(f"{pixels}.edges", min(values), "s per image, the fastest of 11")
    again = replace(source)
    same = [torch.equal(source.labels(x, ""), again.labels(x, "")) for x in photographs]
    report.add("repeats", mean(same), "share of images whose regions are equal in a second run")


def time_clip(report: Report, source: EdgeRegions, image: torch.Tensor) -> None:
    """Add the times of CLIP, with random weights, for all patches of an image and for twelve of its regions."""
    labels = source.labels(image, "")[1]
    with TemporaryDirectory() as folder:
        encoder = random_clip(Size(), Path(folder), source.device)
        patches = PatchFeatures(encoder, 1024)
        twelve = labels.where(labels < 12, -1)
        calls = (lambda: patches.features(image, ""), lambda: encoder.encode(image, twelve))
        taken = [[seconds(call) for call in calls] for _ in range(8)]
    for name, values in zip(("patches", "crops"), zip(*taken)):
        report.add(name, min(values), "s, all patches of an image or 12 crops, the fastest of 8")


def seconds(call: Callable[[], object]) -> float:
    start = perf_counter()
    call()
    return perf_counter() - start


def measure_fit(report: Report, source: EdgeRegions) -> None:
    """Add the fit of regions and superpixels, and that of regions from other working sizes."""
    scene, masks = capture("fox"), read_labels(CAPTURES / "fox_labels.json")
    views = {Path(x.name).stem: x.image for part in (scene.train, scene.held_out) for x in part}
    for pixels in PIXELS:
        sized, fits = replace(source, pixels=pixels), {}
        for image, labels in masks.items():
            maps = dict(zip(EDGE_COUNTS, sized.labels(views[image], "")[:, 0].numpy()))
            for name, number, regions in candidates(views[image], maps, pixels == WORKING_PIXELS):
                for label, mask in labels.items():
                    fits.setdefault((name, number, label), []).append(best_union(regions, mask))
        for name, number in dict.fromkeys((name, number) for name, number, _ in fits):
            key = f"{name}.{number}" if pixels == WORKING_PIXELS else f"{pixels}.{number}"
            by_label = {label: mean(found) for (*at, label), found in fits.items() if at == [name, number]}
            for label, value in by_label.items():
                if pixels == WORKING_PIXELS:
                    report.add(f"{key}.{label}", value, "IoU of the best union of regions")
            report.add(f"{key}.mean", mean(by_label.values()), "mean IoU over the labels")


def candidates(
    image: torch.Tensor, maps: Mapping[int, np.ndarray], superpixels: bool
) -> Iterator[tuple[str, int, np.ndarray]]:
    """Yield the name, number and label map of the regions of each level, and of as many superpixels."""
    for number, regions in maps.items():
        yield "edges", number, regions
        if superpixels:
            found = (Superpixels(asked).labels(image, "")[0, 0].numpy() for asked in count(number, number // 20))
            yield "superpixels", number, next(x for x in found if x.max() >= regions.max())


def read_labels(path: Path) -> dict[str, dict[str, np.ndarray]]:
    """Return the mask of every label by image. Later polygons cover earlier ones, except for those of parts."""
    table, found = json.loads(path.read_text()), {}
    for label in table["labels"]:
        canvas = Image.new("1", tuple(table["size"]))
        ImageDraw.Draw(canvas).polygon([tuple(point) for point in label["polygon"]], fill=1)
        mask, masks = np.array(canvas), found.setdefault(label["image"], {})
        if label["name"] != "fox head":
            masks.update({name: other & ~mask for name, other in masks.items() if name != "fox head"})
        masks[label["name"]] = masks.get(label["name"], False) | mask
    return found


def best_union(regions: np.ndarray, mask: np.ndarray) -> float:
    """Return the largest IoU of a union of regions with a mask."""
    area, inside = np.bincount(regions.ravel()), np.bincount(regions[mask], minlength=regions.max() + 1)
    order = np.argsort(-inside / area)
    shared = inside[order].cumsum()
    return float((shared / (mask.sum() + area[order].cumsum() - shared)).max())


def compare_devices(report: Report, source: EdgeRegions, paths: list[Path]) -> None:
    """Add the differences from the CPU."""
    other, changed, equal = replace(source, device="cpu"), [], []
    for image in map(read_image, paths[:12]):
        ours, theirs = source.edges(image), other.edges(image)
        changed.append(float((ours != theirs).mean()))
        equal.append([common(*maps) for maps in zip(*(watershed_levels(x, EDGE_COUNTS) for x in (ours, theirs)))])
    report.add("cpu.edges", mean(changed), "share of pixels of the edge map that differ from the CPU")
    for number, shares in zip(EDGE_COUNTS, zip(*equal)):
        report.add(f"cpu.{number}", mean(shares), "share of pixels in the largest overlaps of regions with the CPU's")


def common(first: np.ndarray, second: np.ndarray) -> float:
    """Return the share of pixels that lie in the largest overlap of a region with one of the other map."""
    pairs = np.bincount((first * (second.max() + 1) + second).ravel(), minlength=(first.max() + 1) * (second.max() + 1))
    return float(pairs.reshape(first.max() + 1, -1).max(axis=1).sum() / first.size)


if __name__ == "__main__":
    main()
