"""Best results on a capture of rules for the threshold whose parameter is chosen on the same capture.

    python -m research.hindsight castle=RUN/config.yml          results/hindsight.json

Prototypes and pixels are those of `research.cut`. Each family of rules has one parameter for all prototypes:

* a fixed cosine;
* a share of the top cosine;
* a share of the distance from the median to the top;
* a relevancy of rule contrast;
* the same number of Gaussians for all, as a share;
* the range in which the most stable threshold is searched.

The chosen parameter has the largest mean over prototypes of IoU divided by the best IoU of the cosine.

Keys: <capture>.<family>.mean, .worst and .below (the number under 40 %), over prototypes; <capture>.default likewise;
<capture>.<label>.best, the best IoU, and .share, the share of the pixels. The parameters themselves are printed.

Result: on the castle, a fixed cosine of 0.74 would reach 71 % on average, and all other families 64 % or less. Each
family leaves at least one prototype below 7 %. The default, which the castle confirms, reaches 55 %.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np

from normlift_ns.core.relevancy import TOP_QUANTILE
from normlift_ns.query.threshold import suggest_threshold
from research.cut import Asked, ask, best_cut
from research.report import Report

STEP = 5
"""One pixel in this many counts."""
SHARES = np.linspace(0, 1, 101)


class Prototype:
    """A prototype with IoU at any threshold."""

    def __init__(self, asked: Asked) -> None:
        order = np.argsort(-asked.values)
        self.descending, hits = asked.values[order], asked.truth[order].cumsum()
        self.iou = np.concatenate([[0.0], hits / (asked.truth.sum() + np.arange(1, len(order) + 1) - hits)])
        self.best, self.share = best_cut(asked.values, asked.truth), float(asked.truth.mean())
        self.cosines = np.sort(asked.answer.relevancy[asked.answer.valid, 0].numpy())
        self.threshold = float(asked.answer.question.threshold)
        self.median, self.top = np.quantile(self.cosines, (0.5, TOP_QUANTILE))

    def reached(self, threshold: float) -> float:
        """Return the IoU at a threshold, relative to the best IoU."""
        return float(self.iou[np.searchsorted(-self.descending, -threshold, side="left")] / self.best)


Family = tuple[Callable[[Prototype, Any], Any], Iterable[Any]]
STABLE = [(a, b) for a in (0.2, 0.3, 0.4, 0.5) for b in (0.5, 0.6, 0.7, 0.8) if a < b]
FAMILIES: dict[str, Family] = {
    "cosine": (lambda p, x: x, SHARES),
    "share of the top": (lambda p, x: x * p.top, SHARES),
    "from the median": (lambda p, x: p.median + x * (p.top - p.median), SHARES),
    "same number": (lambda p, x: float(np.quantile(p.cosines, 1 - x)), np.geomspace(1e-4, 0.5, 60)),
    "stable": (lambda p, x: suggest_threshold(p.cosines[:, None], np.ones(len(p.cosines), bool), x) or 0.0, STABLE),
}


def measure(report: Report, capture: str, config: Path) -> None:
    """Add the figures of one lifted capture."""
    asked = {key: Prototype(x) for key, x in ask(capture, config, step=STEP).items()}
    contrast = {key: Prototype(x) for key, x in ask(capture, config, "contrast", step=STEP).items()}
    shares = {"default": {key: p.reached(p.threshold) for key, p in asked.items()}}
    numbers: dict[str, Any] = {}
    for family, (rule, choices) in FAMILIES.items():
        tried = [(x, {key: p.reached(rule(p, x)) for key, p in asked.items()}) for x in choices]
        numbers[family], shares[family] = max(tried, key=lambda found: np.mean(list(found[1].values())))
    tried = [
        (x, {key: contrast[key].reached(x) * contrast[key].best / p.best for key, p in asked.items()}) for x in SHARES
    ]
    numbers["contrast"], shares["contrast"] = max(tried, key=lambda found: np.mean(list(found[1].values())))
    for name, found in shares.items():
        values = np.array(list(found.values()))
        print(capture, name, numbers.get(name), {key: round(value, 2) for key, value in found.items()})
        report.add(f"{capture}.{name}.mean", values.mean(), "of the best IoU")
        report.add(f"{capture}.{name}.worst", values.min(), "of the best IoU")
        report.add(f"{capture}.{name}.below", (values < 0.4).sum(), f"of {len(values)} prototypes")
    for key, p in asked.items():
        report.add(f"{capture}.{key}.best", p.best, "IoU")
        report.add(f"{capture}.{key}.share", p.share, "of the pixels")


def main() -> None:
    """Write the results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", help="CAPTURE=config.yml of a lifted run")
    report = Report("hindsight")
    for text in parser.parse_args().runs:
        capture, config = text.split("=", 1)
        measure(report, capture, Path(config))
    report.write()


if __name__ == "__main__":
    main()
