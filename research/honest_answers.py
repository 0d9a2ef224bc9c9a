"""Thresholds suggested from histograms, and verdicts without a null vocabulary, compared with the truth.

    python -m research.honest_answers           plain room, and the tabletop if the captures are available
    python -m research.honest_answers --scenes demo

The command writes results/honest_answers.json. CLIP-like features are made as in `damage` from vectors of LVIS names.
They use those of the scene's classes (in the plain room, 13 random names), and four others as negatives. 200 further
names are the unrelated words of rule contrast. 60 more names, whose cosine to every class is below 0.9, are queried
although no scene contains them. The encoder color uses images of the plain room, divided into superpixels and into
squares. Its absent words are all names of the XKCD survey whose cosine to every color of the room is below 0.5.

Keys: <scene>.<damage or cut>.<rule>.
  iou.<threshold>     mean IoU over the classes of the selection at a threshold: fixed (0.5, colors 0.7), suggested,
                      Otsu's, and the best for each class, which needs the truth
  visible.<verdict>   % of the classes that get a verdict
  absent.<verdict>    % of the absent words that get it
  auc.<statistic>     the probability that a statistic is larger for a class than for an absent word
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
import torch

from normlift_ns import nearest_neighbors, rasterize_evidence, refine
from normlift_ns.core.evidence import Evidence
from normlift_ns.core.field import NULL_SHARE
from normlift_ns.core.lift import lift
from normlift_ns.core.relevancy import relevancy, top_values
from normlift_ns.demo.capture import demo_cameras, view_image
from normlift_ns.encoders.base import RegionFeatures
from normlift_ns.encoders.color import ColorEncoder
from normlift_ns.encoders.registry import encoder_kind
from normlift_ns.options import RefineConfig, RelevancyRule
from normlift_ns.query.threshold import Histogram, Verdict, judge, relevancy_histogram
from normlift_ns.segmentation.regions import Grid, Superpixels
from research.damage import LADDER, observe
from research.report import RESULTS, Report
from research.synthetic_scenes import Words, World, demo, real_words, tabletop
from tests.plain_room import plain_room

DAMAGES = ("mild", "hard")
OTHERS, NEAR, NULL_WORDS = 60, 0.9, 200
NOT_A_COLOUR = 0.5
_BINS = 128


def otsu(values: np.ndarray) -> float:
    """Return Otsu's threshold from 128 bins."""
    counts, edges = np.histogram(values, _BINS)
    share, middle = counts / counts.sum(), (edges[1:] + edges[:-1]) / 2
    weight, moment = share.cumsum(), (share * middle).cumsum()
    rest = weight * (1 - weight)
    between = np.where(rest > 0, (moment[-1] * weight - moment) ** 2 / np.where(rest > 0, rest, 1), 0)
    return float(edges[between.argmax() + 1])


def iou(relevancy: np.ndarray, truth: np.ndarray, threshold: float) -> float:
    chosen = relevancy > threshold
    return float((chosen & truth).sum() / max(1, (chosen | truth).sum()))


def chance(more: list[float], less: list[float]) -> float:
    """Return the probability that a value of `more` is larger than one of `less`; ties count half."""
    a, b = np.array(more)[:, None], np.array(less)
    return float(((a > b) + 0.5 * (a == b)).mean())


STATISTICS = {
    "top": lambda h, x: h.top,
    "top_above_median": lambda h, x: h.top - h.median,
    "z": lambda h, x: (h.top - h.median) / (1e-9 + np.median(np.abs(x - h.median))),
    "otsu_separation": lambda h, x: float(np.var([x[x > otsu(x)].mean(), x[x <= otsu(x)].mean()]) / (1e-12 + x.var())),
    "skewness": lambda h, x: float((((x - x.mean()) / (1e-9 + x.std())) ** 3).mean()),
}
"""Statistics that may separate the classes from absent words, from a histogram and the relevancies."""


def measure(
    report: Report,
    name: str,
    present: np.ndarray,
    absent: np.ndarray,
    truth: np.ndarray,
    rule: RelevancyRule,
    encoder: str,
    cosines: tuple[np.ndarray, np.ndarray] | None = None,
    null_tops: list[float] | None = None,
) -> None:
    """Add the rows of one rule.

    Args:
        present: [N, K] relevancies of the classes, for Gaussians with a direction.
        absent: [N, M] relevancies of words that are not in the scene.
        truth: [N] class, or -1 if it is unknown.
        cosines: Cosines of the classes and of the absent words (default: the relevancies are cosines).
        null_tops: Best cosines of the null words, in ascending order.
    """
    kind, valid = encoder_kind(encoder), np.ones(len(truth), bool)
    fixed = kind.threshold if kind.rule == rule and not isinstance(kind.threshold, str) else 0.5

    def of(values: np.ndarray) -> list[Histogram]:
        found = [relevancy_histogram(x, valid, fixed, kind.suggested) for x in values.T]
        return [h for h in found if h is not None]

    there, elsewhere, known = of(present), of(absent), truth >= 0
    found: dict[str, list[float]] = {"fixed": [], "suggested": [], "otsu": [], "best": []}
    for q, h in enumerate(there):
        x, y = present[known, q], truth[known] == q
        if y.sum() < 30:
            continue
        thresholds = {"fixed": fixed, "suggested": h.suggested, "otsu": otsu(present[:, q])}
        for key, threshold in thresholds.items():
            found[key].append(iou(x, y, threshold))
        found["best"].append(max(iou(x, y, t) for t in np.quantile(x, np.linspace(0, 0.9995, 200))))
    for key, values in found.items():
        report.add(f"{name}.{rule}.iou.{key}", float(np.mean(values)), "of 1")
    manifest = {"null_words": {"tops": null_tops or []}}
    for key, histograms, cosine in zip(("visible", "absent"), (there, elsewhere), cosines or (present, absent)):
        tops = zip(top_values(cosine), histograms)
        verdicts = [judge(manifest, encoder, rule, top_cosine=best, top=h.top) for best, h in tops]
        for verdict in get_args(Verdict) if None not in verdicts else ():
            report.add(f"{name}.{rule}.{key}.{verdict}", 100 * verdicts.count(verdict) / len(verdicts), "%")
    for key, statistic in STATISTICS.items():
        a, b = (
            [statistic(h, x) for h, x in zip(hs, values.T)] for hs, values in ((there, present), (elsewhere, absent))
        )
        report.add(f"{name}.{rule}.auc.{key}", chance(a, b), "of 1")


def refined_directions(means: torch.Tensor, evidence: Evidence, features: torch.Tensor) -> tuple[torch.Tensor, ...]:
    """Return the directions after the paper's vote, and a mask of the Gaussians that have one."""
    lifted = lift(evidence, features)
    config = RefineConfig(vote="paper")
    neighbors, s = nearest_neighbors(means, config.k), lifted.scalars
    source = refine(means, lifted.directions, s.reliability, config, own=s.own_evidence, neighbors=neighbors).long()
    valid = (s.norm > 0)[source]
    return lifted.directions()[source[valid]], valid


def clip_like(report: Report, world: World) -> None:
    """Add the rows of a world whose classes are LVIS names."""
    words, g = real_words(), torch.Generator().manual_seed(1)
    if world.classes != len(words.classes):
        words = Words(words.others[torch.randperm(len(words.others), generator=g)[: world.classes]], words.others)
    far = words.others[(words.others @ words.classes.T).amax(1) < NEAR]
    far = far[torch.randperm(len(far), generator=g)]
    negatives, others, null_vectors = far[:4], far[4 : 4 + OTHERS], far[4 + OTHERS :][:NULL_WORDS]
    for damage in DAMAGES:
        observed = observe(world, words, LADDER[damage], 0)
        directions, valid = refined_directions(world.scene.means, observed.evidence, observed.features)
        present, absent, rivals = ((directions @ x.T).numpy() for x in (words.classes, others, negatives))
        truth, rival = world.truth[valid].numpy(), rivals.max(1, keepdims=True)
        name = f"{world.name}.{damage}"
        measure(report, name, present, absent, truth, "cosine", "open_clip")
        cosines, null = (present, absent), directions @ null_vectors.T
        level = null.topk(round(NULL_SHARE * len(null_vectors)), 1).values[:, -1:].numpy()
        present, absent = (relevancy(x, rival, rule="lerf") for x in cosines)
        measure(report, name, present, absent, truth, "lerf", "open_clip")
        present, absent = (relevancy(x, level, rule="contrast") for x in cosines)
        measure(report, name, present, absent, truth, "contrast", "open_clip", cosines, sorted(top_values(null)))


def colours(report: Report, num_gaussians: int, views: int, width: int) -> None:
    """Add the rows of the plain room with the encoder color."""
    from matplotlib.colors import XKCD_COLORS  # noqa: PLC0415 (the names)

    room, cameras, texts = plain_room(num_gaussians), demo_cameras(views, width, width * 3 // 4), ColorEncoder()
    names = [name.removeprefix("xkcd:") for name in XKCD_COLORS if "/" not in name]
    classes, survey = texts.text(room.names), texts.text(names)
    others = survey[(survey @ classes.T).amax(1) < NOT_A_COLOUR]
    for cut, regions in (("superpixels", Superpixels(256)), ("squares", Grid(192))):
        source = RegionFeatures(regions, ColorEncoder())
        seen = [source.view(view_image(room, camera), f"{i}.png") for i, camera in enumerate(cameras)]
        counts = [len(view.features) for view in seen]
        evidence = rasterize_evidence(room.scene, cameras, [view.labels for view in seen], num_regions=counts)
        table = torch.cat([view.features for view in seen])
        directions, valid = refined_directions(room.scene.means, evidence, table)
        present, absent = ((directions @ x.T).numpy() for x in (classes, others))
        measure(report, f"demo.colour_{cut}", present, absent, room.labels[valid].numpy(), "cosine", "colour")


def main(arguments: argparse.Namespace) -> None:
    torch.set_grad_enabled(False)
    report = Report("honest_answers")
    size = (15_000, 12, 240)
    if "demo" in arguments.scenes:
        colours(report, *size)
        clip_like(report, replace(demo(*size), name="demo"))
    if "tabletop" in arguments.scenes:
        clip_like(report, tabletop(arguments.views))
    report.write(arguments.output)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=["demo", "tabletop"], help="demo, tabletop")
    parser.add_argument("--views", type=int, default=16, help="training views of the tabletop")
    parser.add_argument("--output", type=Path, default=RESULTS, help="folder of the JSON file")
    main(parser.parse_args())
