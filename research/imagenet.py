"""Encoder of ImageNet's classes on the fox: seconds per image, and average precision of "fox" before and after a lift.

    python -m research.imagenet                  results/imagenet.json; weights: ns-normlift-weights --get imagenet
    python -m research.imagenet --device cuda    seconds and differences from a CPU; results/imagenet_gpu.json

The average precision pools the pixels of six images with labels drawn by hand. In 2D, it uses the cosine of the region
of a pixel; after the lift, it uses the rendered relevancy.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter

import numpy as np
import torch
from PIL import Image, ImageDraw

import normlift_ns as nl
from normlift_ns.encoders.build import make_source
from normlift_ns.encoders.imagenet_network import ImageNetEncoder
from research.report import Report
from tests.captures import SHARED, capture

CAPTURES = SHARED / "captures"
CONFIG = CAPTURES / "outputs" / "fox" / "splatfacto" / "run" / "config.yml"
REGIONS = ("superpixel", "patches")


def main() -> None:
    """Write the results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu")
    device = parser.parse_args().device
    report = Report("imagenet" if device == "cpu" else "imagenet_gpu")
    scene = capture("fox")
    views = {Path(x.name).stem: x for part in (scene.train, scene.held_out) for x in part}
    measure_time(report, device, [x.image for x in list(views.values())[:8]])
    if device == "cpu":
        masks = dict(fox_masks())
        for regions in REGIONS:
            measure_precision(report, regions, {name: views[name] for name in masks}, masks)
    report.write()


def measure_time(report: Report, device: str, images: list[torch.Tensor]) -> None:
    """Add seconds per image, and the differences of a second run and of a GPU."""
    labels = (torch.arange(images[0][..., 0].numel()).reshape(1, *images[0].shape[:2]) // 2000).int()
    encoder, again, seconds, rows = ImageNetEncoder(device), ImageNetEncoder(device), [], []
    encoder.encode(images[0], labels)
    for image in images:
        start = perf_counter()
        rows.append(encoder.encode(image, labels))
        seconds.append(perf_counter() - start)
    report.add("539x959", min(seconds), f"s per image, the fastest of {len(seconds)}")
    same = [torch.equal(row, again.encode(image, labels)) for row, image in zip(rows, images)]
    report.add("repeats", float(np.mean(same)), "share of images whose features are equal in a second run")
    if device != "cpu":
        cosines = torch.cat([(row * ImageNetEncoder().encode(x, labels)).sum(1) for row, x in zip(rows, images)])
        report.add("cpu", float(cosines.min()), "smallest cosine of a feature with that of the CPU")


def measure_precision(report: Report, regions: str, views: dict, masks: dict[str, np.ndarray]) -> None:
    """Add the average precision of "fox" with these regions, in 2D and after a lift."""
    options = nl.SourceOptions(encoder="imagenet", regions=regions)
    source, truth = make_source(options), np.concatenate([mask.ravel() for mask in masks.values()])
    scores = []
    for name, view in views.items():
        found = source.view(view.image, name)
        row = torch.where(found.region_of_cell[0] >= 0, found.region_of_cell[0], 0).long()
        scores.append((found.features @ source.text(["fox"])[0])[row][found.labels.long()].numpy().ravel())
    report.add(f"{regions}.images", average_precision(truth, np.concatenate(scores)), "average precision of fox")
    with TemporaryDirectory() as folder:
        run = nl.lift_run(CONFIG, source=options, output_dir=Path(folder), device="cpu")
        relevancy = run.ask("fox").relevancy.nan_to_num(0)
        drawn = [
            nl.render(run.scene.gaussians, x.camera, relevancy, rasterize_mode=run.scene.rasterize_mode)[0].numpy()
            for x in views.values()
        ]
    scores = np.concatenate([x.ravel() for x in drawn])
    report.add(f"{regions}.lifted", average_precision(truth, scores), "average precision of fox")


def fox_masks() -> Iterator[tuple[str, np.ndarray]]:
    """Yield the images with labels, and the pixels of the fox in each; later polygons cover earlier ones."""
    table = json.loads((CAPTURES / "fox_labels.json").read_text())
    for name in sorted({label["image"] for label in table["labels"]}):
        canvas = Image.new("1", tuple(table["size"]))
        for label in table["labels"]:
            if label["image"] == name and label["name"] != "fox head":
                points = [tuple(point) for point in label["polygon"]]
                ImageDraw.Draw(canvas).polygon(points, fill=int(label["name"] == "fox"))
        yield name, np.array(canvas)


def average_precision(truth: np.ndarray, scores: np.ndarray) -> float:
    """Return the area under the curve of precision over recall, with equal scores together."""
    _, rank = np.unique(-scores, return_inverse=True)
    hits, pixels = np.bincount(rank, truth), np.bincount(rank)
    return float((hits * hits.cumsum() / pixels.cumsum()).sum() / truth.sum())


if __name__ == "__main__":
    main()
