"""Evaluation with instance masks: true classes of Gaussians from the evidence of the masks, and held-out pixels."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor

from normlift_ns.core.evidence import Evidence
from normlift_ns.core.metrics import NO_CLASS, ClassScores, class_scores, confusion
from normlift_ns.encoders.regions import LabelFiles
from normlift_ns.errors import InputError
from normlift_ns.evaluation.documents import Name, read_document
from normlift_ns.evaluation.results import Evaluation

_VALUE = re.compile(r"0|-?[1-9][0-9]{0,9}")


class _NamesFile(msgspec.Struct):
    """Content of the file of names."""

    labels: dict[str, Name]
    background: int | None = None


@dataclass(frozen=True)
class Names:
    """Class names of the values of instance masks."""

    classes: tuple[str, ...]
    """Distinct names, used as prompts."""
    class_of: Mapping[int, int]
    """Class of each value; pixels with other values do not count."""


def read_names(path: Path) -> Names:
    """Read {"labels": {"1": "table", ...}, "background": 0}, or only the inner part; equal names are one class.

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: the file has another format.
    """
    expected = 'expected {"labels": {"1": "table", ...}}'
    if not os.path.lexists(path):
        raise FileNotFoundError(f'mask names {path} do not exist; write {{"labels": {{"1": "table", ...}}}} to it')
    try:
        document = read_document(path, dict[str, Any])
        named = msgspec.convert(document if "labels" in document else {"labels": document}, _NamesFile)
        name_of = _by_value(named.labels)
        if named.background is not None and named.background in name_of:
            raise InputError(f"value {named.background} is the background, but has a name")
        if len(name_of) == 0:
            raise InputError("it has no names")
    except ValueError as error:
        raise InputError(f"{path} is not a valid file of mask names ({error}); {expected}") from error
    classes = tuple(dict.fromkeys(name_of.values()))
    return Names(classes, {value: classes.index(name) for value, name in name_of.items()})


def _by_value(labels: Mapping[str, str]) -> dict[int, str]:
    wrong = [key for key in labels if _VALUE.fullmatch(key) is None]
    if len(wrong) > 0:
        raise InputError(f"{wrong[0]!r} is not a mask value, expected an integer such as 1")
    return {int(value): name for value, name in labels.items()}


def read_classes(masks: LabelFiles, name: str, names: Names, height: int, width: int) -> Int64[Tensor, "h w"]:
    """Return the class of every pixel of an image; -1 if it does not count.

    Raises:
        FileNotFoundError, ValueError: the mask is missing, damaged or of another size; the message names it.
    """
    values = masks.values(name)
    if values.shape != (1, height, width):
        size = values.shape if len(values) > 1 else values.shape[1:]
        raise InputError(
            f"mask {masks.path(name)} has shape {size}, but its image {name} is {height} x {width} (height x width); "
            "give masks the size of the undistorted image"
        )
    unique, inverse = np.unique(values[0], return_inverse=True)
    table = torch.tensor([names.class_of.get(int(value), NO_CLASS) for value in unique])
    return table[torch.from_numpy(inverse.reshape(height, width))]


def gaussian_truth(
    evidence: Evidence, classes: int, *, purity: float = 0.75, min_weight: float = 1.0
) -> Int64[Tensor, " n"]:
    """Return the true class of every Gaussian from evidence of the exact masks, with one column per view and class.

    A Gaussian below either minimum has class -1.

    Args:
        purity: minimum share of the class in the weight of the Gaussian, including pixels that do not count.
        min_weight: minimum weight in all views together, in pixels.
    """
    columns = torch.arange(evidence.num_regions) % classes
    by_class = evidence.rows.matmul(torch.nn.functional.one_hot(columns, classes).to(evidence.rows.weight))
    total = by_class.sum(1) + evidence.unlabeled.row_sums().to(by_class)
    best = by_class.max(dim=1)
    valid = (total >= min_weight) & (best.values >= purity * total)
    return torch.where(valid, best.indices, NO_CLASS)


def evaluate_masks(
    names: Sequence[str],
    truth: Int64[Tensor, " n"],
    prediction: Int64[Tensor, " n"],
    pixels: Sequence[tuple[Int64[Tensor, "h w"], Int64[Tensor, "h w"]]],
    reliability: Float[Tensor, " n"],
    settings: Mapping[str, object],
) -> Evaluation:
    """Compute miou_3d and macc_3d over Gaussians, and miou_2d and macc_2d over all pixels of the held-out views.

    Args:
        pixels: true and predicted classes of every held-out view.
    """
    classes = len(names)
    of_gaussians = class_scores(confusion(truth, prediction, classes))
    counts = sum((confusion(t, f, classes) for t, f in pixels), torch.zeros(classes, classes + 1, dtype=torch.int64))
    of_pixels = class_scores(counts)
    scored = truth >= 0
    correct = (prediction == truth)[scored].double()
    results = {
        "miou_3d": of_gaussians.miou,
        "macc_3d": of_gaussians.macc,
        "accuracy_3d": float(correct.mean()) if len(correct) > 0 else float("nan"),
        "miou_2d": of_pixels.miou,
        "macc_2d": of_pixels.macc,
        "gaussians_with_truth_share": float(scored.double().mean()),
        "zero_evidence_share": float((reliability == 0).double().mean()),
    }
    rows = [
        {"class": name, "gaussians": int((truth == c).sum()), **_row(of_gaussians, c, "3d"), **_row(of_pixels, c, "2d")}
        for c, name in enumerate(names)
    ]
    return Evaluation(results, rows, {"protocol": "masks", **settings})


def _row(scores: ClassScores, c: int, suffix: str) -> dict[str, float]:
    return {f"iou_{suffix}": float(scores.iou[c]), f"accuracy_{suffix}": float(scores.accuracy[c])}
