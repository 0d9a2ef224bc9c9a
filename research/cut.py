"""Average precision, and IoU at the default threshold compared with the best threshold, on captures with labels.

    python -m research.cut fox=RUN/config.yml castle=RUN/config.yml tabletop=RUN/config.yml     results/cut.json

The labels are `fox_labels.json` next to the captures, `labels/castle_labels.json`, and the exact masks of six images of
the tabletop. The vector of a label is its prototype: the normalized mean of the features of the regions inside its
polygons, weighted by area. It is used like a click. If the encoder knows the word of a label, the word is also a
prompt. Relevancies are rendered into the labeled images and compared with the polygons. The figures of a prompt pool
its images.

Keys: <capture>.<label>.ap; .images, the average precision in the images alone, by the cosines of regions; .best and
.default, the IoU at the best threshold of the prompt and at the default one; for prototypes also other candidates.
<capture>.mean.<cut>, the mean over prompts of IoU divided by the best; <capture>.worst.<cut>, the smallest of these;
<capture>.total.<cut>, the mean IoU over prompts divided by the mean of the best.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from PIL import Image, ImageDraw
from torch.nn.functional import normalize

import normlift_ns as nl
from normlift_ns.encoders.base import FeatureSource
from normlift_ns.encoders.build import make_source
from normlift_ns.errors import InputError
from normlift_ns.options import RelevancyRule
from normlift_ns.query.engine import run_query
from normlift_ns.query.question import Query, make_query
from research.honest_answers import otsu
from research.report import Report
from tests.captures import SHARED

POSITIONS = (0.3, 0.4, 0.5, 0.6, 0.7, 0.8)
LABELS = {
    "fox": SHARED / "captures" / "fox_labels.json",
    "castle": Path(__file__).parent / "labels" / "castle_labels.json",
}
TABLETOP_IMAGES = ("0000", "0009", "0018", "0027", "0036", "0045")
_PARTS = {"fox head"}


def label_masks(capture: str) -> Iterator[tuple[str, dict[str, np.ndarray]]]:
    """Yield the labeled images, and the pixels of every label in each."""
    if capture == "tabletop":
        folder = SHARED / "captures" / "tabletop"
        names = json.loads((folder / "labels.json").read_text())["labels"]
        for image in TABLETOP_IMAGES:
            pixels = np.array(Image.open(folder / "instance" / f"{image}.png"))
            yield image, {name: pixels == int(label) for label, name in names.items() if (pixels == int(label)).any()}
        return
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


def region_rows(
    source: FeatureSource, views: dict[str, Any], images: Iterable[str]
) -> dict[str, tuple[torch.Tensor, torch.Tensor]]:
    """Return the features of every labeled image, and the row of each pixel among them, or -1 without a region."""
    rows = {}
    for image in images:
        found = source.view(views[image].image, views[image].name)
        cell, region = found.labels.long().cpu(), found.region_of_cell[0].long().cpu()
        rows[image] = (found.features.cpu(), torch.where(cell >= 0, region[cell.clamp(min=0)], -1))
    return rows


def prototypes(
    rows: dict[str, tuple[torch.Tensor, torch.Tensor]], masks: dict[str, dict[str, np.ndarray]]
) -> dict[str, torch.Tensor]:
    """Return the vector of every label: the mean of the features of the regions under its pixels, by area."""
    total: dict[str, torch.Tensor] = {}
    for image, labels in masks.items():
        features, row = rows[image]
        for name, mask in labels.items():
            inside = row[torch.from_numpy(mask)]
            total[name] = total.get(name, 0) + features[inside[inside >= 0]].double().sum(0)
    return {name: normalize(vector, dim=0).float() for name, vector in total.items()}


def best_cut(values: np.ndarray, truth: np.ndarray) -> float:
    """Return the best IoU over all thresholds of pixels with these relevancies."""
    order = np.argsort(-values)
    hits = truth[order].cumsum()
    union = truth.sum() + np.arange(1, len(order) + 1) - hits
    return float((hits / union).max())


def average_precision(values: np.ndarray, truth: np.ndarray) -> float:
    """Return the average precision of pixels with these relevancies."""
    hit = truth[np.argsort(-values)]
    return float((hit.cumsum() / np.arange(1, len(hit) + 1))[hit].mean())


def candidate_cuts(values: np.ndarray) -> dict[str, float]:
    """Return the candidate thresholds of a prototype from the relevancies of the Gaussians with a direction."""
    median, top = np.quantile(values, (0.5, 0.999))
    return {f"median+{f:.1f}": median + f * (top - median) for f in POSITIONS} | {"otsu": otsu(values[values > median])}


class Asked(NamedTuple):
    """Answer to a prompt in one capture, with the pixels of the images that show its label."""

    answer: Any
    values: np.ndarray
    """Rendered relevancy of every pixel."""
    truth: np.ndarray
    in_images: np.ndarray
    """Cosine of the region of every pixel, or -1 without a region."""


def ask(capture: str, config: Path, rule: RelevancyRule = "cosine", *, step: int = 1) -> dict[str, Asked]:
    """Query the prototype of every label of a lifted capture, and its word if the encoder knows it.

    Args:
        rule: Relevancy rule of the prototypes.
        step: Keep every step-th pixel. If it is above 1, words are omitted.
    """
    run, masks = nl.open_run(config), dict(label_masks(capture))
    scene, field = run.scene, run.field
    views = {Path(x.name).stem: x for part in (scene.train, scene.held_out) for x in part}
    rows = region_rows(make_source(nl.SourceOptions.stored(run.field.manifest["source"]), "cpu"), views, masks)
    vectors = prototypes(rows, masks)
    asked = {
        name: (name, Query((name,), row[None].numpy(), rule=rule, suggest_threshold=True))
        for name, row in vectors.items()
    }
    for name in vectors if step == 1 else ():
        with suppress(InputError):  # a word that the encoder does not know
            asked[f"word {name}"] = (name, make_query(field, run.texts.rows, [name]))
    answers = {key: run_query(field, scene.gaussians.means, question) for key, (_, question) in asked.items()}
    relevancy = torch.cat([answer.relevancy for answer in answers.values()], 1)
    drawn = {
        image: nl.render(scene.gaussians, views[image].camera, relevancy, rasterize_mode=scene.rasterize_mode)[0]
        for image in masks
    }
    found = {}
    for q, (key, (label, question)) in enumerate(asked.items()):
        images = [image for image, labels in masks.items() if label in labels]
        vector = normalize(torch.from_numpy(question.embeddings[0]).float(), dim=0)
        cosines = [(torch.cat([rows[x][0] @ vector, vector.new_tensor([-1])]), rows[x][1]) for x in images]
        found[key] = Asked(
            answers[key],
            np.concatenate([drawn[image][..., q].numpy().ravel()[::step] for image in images]),
            np.concatenate([masks[image][label].ravel()[::step] for image in images]),
            np.concatenate([cosine[row].numpy().ravel()[::step] for cosine, row in cosines]),
        )
    return found


def measure(report: Report, capture: str, config: Path) -> None:
    """Add the figures of one lifted capture."""
    reached: dict[str, list[tuple[float, float]]] = {}
    for key, (answer, values, truth, in_images) in ask(capture, config).items():
        best = best_cut(values, truth)
        cuts = {"default": answer.question.threshold}
        if not key.startswith("word "):
            cuts |= candidate_cuts(answer.relevancy[answer.valid, 0].numpy())
        report.add(f"{capture}.{key}.ap", average_precision(values, truth), "of 1")
        report.add(f"{capture}.{key}.images", average_precision(in_images, truth), "of 1, without a lift")
        report.add(f"{capture}.{key}.best", best, "IoU")
        for name, cut in cuts.items():
            value = float(((values > cut) & truth).sum() / ((values > cut) | truth).sum())
            report.add(f"{capture}.{key}.{name}", value, "IoU")
            reached.setdefault(name, []).append((value, best))
    for name, pairs in reached.items():
        values, best = np.array(pairs).T
        report.add(f"{capture}.mean.{name}", float((values / best).mean()), "of the best IoU")
        report.add(f"{capture}.worst.{name}", float((values / best).min()), "of the best IoU")
        report.add(f"{capture}.total.{name}", float(values.sum() / best.sum()), "of the best IoU")


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
