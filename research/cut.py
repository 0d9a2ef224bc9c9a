"""IoU at candidate cuts against IoU at the best cut, on lifted captures with labels drawn by hand.

    python -m research.cut fox=RUN/config.yml castle=RUN/config.yml     results/cut.json

The labels are `fox_labels.json` next to the captures and `labels/castle_labels.json`. The vector of a label is its
prototype, the normalized mean of the features of the regions inside its polygons, by area; where the encoder knows
the word, its text is measured too. Relevancies are rendered
into the labeled images and compared with the polygons; a text has one IoU, pooled over its images.

Keys: <capture>.<label>.<cut>, the IoU of one text; <capture>.mean.<cut>, the mean over texts of IoU divided by the
best; <capture>.worst.<cut>, the smallest of these.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image, ImageDraw
from torch.nn.functional import normalize

import normlift_ns as nl
from normlift_ns.encoders.build import make_source
from normlift_ns.errors import InputError
from research.honest_answers import otsu
from research.report import Report
from tests.captures import SHARED

FRACTIONS = tuple(round(0.2 + 0.05 * i, 2) for i in range(13))
LABELS = {
    "fox": SHARED / "captures" / "fox_labels.json",
    "castle": Path(__file__).parent / "labels" / "castle_labels.json",
}
_PARTS = {"fox head"}


def label_masks(capture: str) -> Iterator[tuple[str, dict[str, np.ndarray]]]:
    """Yield the labeled images, and the pixels of every label in each."""
    table = json.loads(LABELS[capture].read_text())
    for image in sorted({label["image"] for label in table["labels"]}):
        canvas, parts, names = Image.new("I", tuple(table["size"])), {}, [""]
        for label in table["labels"]:
            if label["image"] != image:
                continue
            points, name = [tuple(point) for point in label["polygon"]], label["name"]
            if "part_of" in label or name in _PARTS:
                part = parts.setdefault(name, Image.new("1", tuple(table["size"])))
                ImageDraw.Draw(part).polygon(points, fill=1)
            else:
                names += [name] * (name not in names)
                ImageDraw.Draw(canvas).polygon(points, fill=names.index(name))
        pixels = np.array(canvas)
        whole = {name: pixels == i for i, name in enumerate(names) if i > 0}
        yield image, whole | {name: np.array(part) for name, part in parts.items()}


def prototypes(run: Any, views: dict[str, Any], masks: dict[str, dict[str, np.ndarray]]) -> dict[str, torch.Tensor]:
    """Return the vector of every label: the mean of the features of the regions under its pixels, by area."""
    total: dict[str, torch.Tensor] = {}
    source = make_source(nl.SourceOptions(**run.field.manifest["source"]), "cpu")
    for image, labels in masks.items():
        found = source.view(views[image].image, views[image].name)
        cells = found.region_of_cell[0].long()
        for name, mask in labels.items():
            cell = found.labels[torch.from_numpy(mask)].long()
            region = cells[cell[cell >= 0]]
            total[name] = total.get(name, 0) + found.features[region[region >= 0]].double().sum(0)
    return {name: normalize(vector, dim=0).float() for name, vector in total.items()}


def best_cut(values: np.ndarray, truth: np.ndarray) -> float:
    """Return the best IoU over all thresholds of pixels with these relevancies."""
    order = np.argsort(-values)
    hits = truth[order].cumsum()
    union = truth.sum() + np.arange(1, len(order) + 1) - hits
    return float((hits / union).max())


def candidate_cuts(values: np.ndarray) -> dict[str, float]:
    """Return the candidate thresholds from the relevancies of the Gaussians with a direction."""
    median, top = np.quantile(values, (0.5, 0.999))
    cuts = {f"median+{f:.2f}": median + f * (top - median) for f in FRACTIONS}
    return cuts | {f"zero+{f:.2f}": f * top for f in FRACTIONS} | {"otsu": otsu(values[values > median])}


def measure(report: Report, capture: str, config: Path) -> None:
    """Add the figures of one lifted capture."""
    run, masks = nl.open_run(config), dict(label_masks(capture))
    scene = run.scene
    views = {Path(x.name).stem: x for part in (scene.train, scene.held_out) for x in part}
    vectors = prototypes(run, views, masks)
    for name in list(vectors):
        with suppress(InputError):  # a word that the encoder does not know
            vectors[f"word {name}"] = torch.from_numpy(run.texts.rows([name])[0])
    cosine, valid = run.field.query(torch.stack(list(vectors.values())).numpy()), run.field.valid()
    ratios: dict[str, list[float]] = {}
    drawn = {
        image: nl.render(scene.gaussians, views[image].camera, cosine, rasterize_mode=scene.rasterize_mode)[0]
        for image in masks
    }
    for q, name in enumerate(vectors):
        label = name.removeprefix("word ")
        images = [image for image, labels in masks.items() if label in labels]
        values = np.concatenate([drawn[image][..., q].numpy().ravel() for image in images])
        truth = np.concatenate([masks[image][label].ravel() for image in images])
        best = best_cut(values, truth)
        report.add(f"{capture}.{name}.best", best, "IoU")
        for key, cut in candidate_cuts(cosine[valid, q].numpy()).items():
            iou = float(((values > cut) & truth).sum() / ((values > cut) | truth).sum())
            report.add(f"{capture}.{name}.{key}", iou, "IoU")
            ratios.setdefault(key, []).append(iou / best)
    for key, values_ in ratios.items():
        report.add(f"{capture}.mean.{key}", float(np.mean(values_)), "of the best IoU")
        report.add(f"{capture}.worst.{key}", min(values_), "of the best IoU")


def main() -> None:
    """Write the results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", help="CAPTURE=config.yml of a lifted run")
    parser.add_argument("--name", default="cut", help="name of the results")
    arguments = parser.parse_args()
    report = Report(arguments.name)
    for text in arguments.runs:
        capture, config = text.split("=", 1)
        measure(report, capture, Path(config))
    report.write()


if __name__ == "__main__":
    main()
