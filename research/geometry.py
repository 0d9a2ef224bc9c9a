"""Cosines between regions of lifted captures, from which the statistic "real" of features is derived.

    python -m research.geometry fox=RUN/config.yml tabletop=RUN/config.yml    results/geometry.json

The runs are those of `ns-normlift --encoder imagenet --regions edges`. In each view, a Gaussian belongs to the region
with most of its weight, if that is at least half. Objects are the labels of the fox (`cut.label_masks`), or the exact
masks of the tabletop. A Gaussian belongs to the label with three quarters of its weight in the labeled images.

Keys: <capture>.drift.<degrees>, the cosine between the features of one Gaussian in two views with this angle between
them; <capture>.<label>.… and <capture>.thing.…, between two Gaussians of one object; <capture>.two_things.…, of two
objects; <capture>.agreement, the B of its regions, also for small rooms with this statistic. If the encoder knows the
word for an object, further keys have its cosine with its own prompt (own) and with the best of 11 other names (wrong).
They also have the share of views in which any of the 1,000 names exceeds its own (wins), and the spread of the lifted
cosines.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
import torch
from PIL import Image
from safetensors.torch import load_file
from scipy.optimize import curve_fit
from torch import Tensor
from torch.nn.functional import normalize

import normlift_ns as nl
from normlift_ns import Camera, Evidence, consensus
from normlift_ns.encoders.imagenet import find_classes
from normlift_ns.encoders.imagenet_network import ImageNetEncoder
from normlift_ns.io.run_dir import FIELD_FOLDER
from research.cut import label_masks
from research.damage import STEPS, observe
from research.features import orthogonal_words
from research.real_features import FOX
from research.report import Report
from research.second_room import second
from research.synthetic_scenes import PURITY, WEIGHT, demo
from tests.captures import SHARED

BINS = (0, 3, 6, 10, 20, 30, 60, 180)
"""Bounds of the bins of the angle between two views, in degrees."""
SAMPLE, PAIRS, FEWEST = 6000, 200_000, 100
"""Number of Gaussians and of pairs of Gaussians in samples, and smallest number of pairs of views in a bin."""
WORDS = {"fox": "red fox", "fox head": "red fox", "shield": "shield"}
TEXT_UNITS = {"wins": "share of views of Gaussians", "one_name": "share of these", "spread": "of the median"}
OTHERS = 11
"""Number of other names that are compared with the right one, as many as the tabletop has."""


@dataclass(frozen=True)
class Seen:
    """Gaussians and the features of their regions."""

    home: Tensor
    """[N, V] region of each Gaussian in each view, or -1 for none."""
    features: Tensor
    """[S, D] unit rows."""
    toward: Tensor
    """[N, V, 3] unit vectors from the Gaussian to the camera."""

    @staticmethod
    def of(evidence: Evidence, features: Tensor, means: Tensor, cameras: Sequence[Camera]) -> Seen:
        """Return the regions of the Gaussians of a lift."""
        rows, views = evidence.rows, evidence.num_views
        place = rows.row_index() * views + evidence.region_view[rows.column.long()].long()
        total = torch.zeros(len(rows) * views).index_add_(0, place, rows.weight)
        most = torch.zeros_like(total).scatter_reduce_(0, place, rows.weight, "amax")
        home, top = torch.full((len(total),), -1), (rows.weight == most[place]) & (most >= 0.5 * total)[place]
        home[place[top]] = rows.column.long()[top]
        home[total < 0.5 * WEIGHT] = -1
        eyes = torch.stack([camera.world_to_camera.double().inverse()[:3, 3] for camera in cameras]).to(means)
        return Seen(home.view(-1, views), features, normalize(eyes - means[:, None], dim=2))

    def drift(self, some: Tensor) -> dict[str, tuple[float, float]]:
        """Return the mean cosine of the features of one Gaussian in two views, and the mean angle, by bins of the
        angle."""
        bounds, views = torch.tensor(BINS[1:-1]).float(), self.home.shape[1]
        sums, counts, angles = torch.zeros(3, len(BINS) - 1, dtype=torch.float64)
        for part in some.split(500):
            home, toward = self.home[part], self.toward[part]
            features = self.features[home.clamp(min=0)]
            both = torch.ones(views, views, dtype=torch.bool).triu(1) & (home >= 0)[:, :, None] & (home >= 0)[:, None]
            angle = torch.rad2deg((toward @ toward.transpose(1, 2))[both].clamp(-1, 1).acos())
            found = torch.bucketize(angle, bounds, right=True)
            sums += torch.bincount(found, (features @ features.transpose(1, 2))[both].double(), len(sums))
            counts += torch.bincount(found, minlength=len(sums))
            angles += torch.bincount(found, angle.double(), len(sums))
        values = zip(pairwise(BINS), (sums / counts).tolist(), (angles / counts).tolist(), counts.tolist())
        return {f"{low}-{high}": (x, angle) for (low, high), x, angle, n in values if n >= FEWEST}

    def pairs(self, some: Tensor, others: Tensor, g: torch.Generator, *, one_view: bool) -> float:
        """Return the mean cosine of random pairs of different Gaussians in different regions."""
        i, j = (x[torch.randint(0, len(x), (PAIRS,), generator=g)] for x in (some, others))
        v, u = torch.randint(0, self.home.shape[1], (2, PAIRS), generator=g)
        p, q = self.home[i, v], self.home[j, v if one_view else u]
        both = ((p >= 0) & (q >= 0) & (p != q) & (i != j)).nonzero().squeeze(1)
        parts = [(self.features[p[x]] * self.features[q[x]]).sum(1).double() for x in both.split(10_000)]
        return float(torch.cat(parts).mean())


def geometry(seen: Seen, things: Mapping[str, Tensor], g: torch.Generator) -> dict[str, float]:
    """Return all cosines except those with texts, and the parameters of a curve through the drift.

    The curve is far + (near - far) exp(-angle / scale).
    """
    known = (seen.home >= 0).sum(1) >= 3
    curve = seen.drift(_sample(known.nonzero().squeeze(1), g))
    found = {f"drift.{key}": cosine for key, (cosine, _) in curve.items()}
    cosines, angles = np.array(list(curve.values())).T
    start = (cosines[-1], cosines[0], 20.0)
    fitted: np.ndarray = curve_fit(
        lambda x, far, near, scale: far + (near - far) * np.exp(-x / scale), angles, cosines, start
    )[0]
    found |= dict(zip(("far", "near", "scale"), map(float, fitted)))
    for name, some in things.items():
        found |= {f"{name}.drift.{key}": cosine for key, (cosine, _) in seen.drift(_sample(some, g)).items()}
    for key, one_view in (("one_view", True), ("two_views", False)):
        inside = {name: seen.pairs(some, some, g, one_view=one_view) for name, some in things.items()}
        found |= {f"{name}.{key}": cosine for name, cosine in inside.items()}
        found[f"thing.{key}"] = fmean(inside.values())
        apart = [(a, b) for a, b in combinations(things, 2) if not a.startswith(f"{b} ") and not b.startswith(f"{a} ")]
        found[f"two_things.{key}"] = fmean(seen.pairs(things[a], things[b], g, one_view=one_view) for a, b in apart)
    return found


def spread(cosines: Tensor) -> float:
    """Return a standard deviation estimated from the 5 % and 95 % quantiles, relative to the median."""
    low, middle, high = cosines.float().quantile(torch.tensor([0.05, 0.5, 0.95])).tolist()
    return (high - low) / (2 * 1.645 * middle)


def text_cosines(
    seen: Seen, lifted: Tensor, some: Tensor, word: str, texts: Tensor, g: torch.Generator
) -> dict[str, float]:
    """Return the cosines of an object with its own text and with others.

    Args:
        lifted: [N, D] unit directions.
        texts: [1000, D] unit vectors.
    """
    own = find_classes(word)
    home = seen.home[some]
    by_text = seen.features[home[home >= 0].unique(return_inverse=True)[0]] @ texts.T
    weights = home[home >= 0].unique(return_counts=True)[1].float()
    mean = weights @ by_text / weights.sum()
    right, related = by_text[:, own].amax(1), sorted({*own, *find_classes(word.rsplit(maxsplit=1)[-1])})
    others = by_text.clone()
    others[:, related] = -1
    best, name = others.max(1)
    wins = torch.bincount(name, weights * (best > right), len(texts))
    strangers = torch.tensor([i for i in range(len(texts)) if i not in related])
    drawn = torch.rand(1000, len(strangers), generator=g).topk(OTHERS, dim=1).indices
    cosines = (lifted[some] @ texts[own].T).amax(1)
    return {
        "own": float(weights @ right / weights.sum()),
        "wrong": float(mean[strangers][drawn].amax(1).mean()),
        "wrong_of_all": float(mean[strangers].max()),
        "noise": float((by_text - mean).std(dim=0).mean()),
        "wins": float(wins.sum() / weights.sum()),
        "one_name": float(wins.max() / wins.sum()),
        "spread": spread(cosines),
        **{f"lifted{q}": float(cosines.quantile(q / 100)) for q in (5, 50, 95)},
    }


def _sample(some: Tensor, g: torch.Generator) -> Tensor:
    return some[torch.randperm(len(some), generator=g)[:SAMPLE]]


def label_maps(capture: str, names: Sequence[str]) -> dict[str, tuple[Tensor, list[str]]]:
    """Return maps [H, W] of some views by the stem of their image, 0 for pixels without a label, and the names of 1, 2,
    ..."""
    if capture == "tabletop":
        folder, things = SHARED / "captures" / "tabletop" / "instance", [str(i) for i in range(1, 13)]
        stems = sorted(Path(name).stem for name in names)[::6]
        return {x: (torch.from_numpy(np.array(Image.open(folder / f"{x}.png"))).int(), things) for x in stems}
    masks = dict(label_masks(capture))
    things, found = list(dict.fromkeys(name for labels in masks.values() for name in labels)), {}
    for stem, labels in masks.items():
        found[stem] = (numbers := torch.zeros(next(iter(labels.values())).shape, dtype=torch.int32), things)
        for name, mask in labels.items():  # parts come last
            numbers[torch.from_numpy(mask)] = things.index(name) + 1
    return found


def things_of(run: Any, capture: str) -> dict[str, Tensor]:
    """Return the Gaussians of every label."""
    scene = run.scene
    cameras = {Path(x.name).stem: x.camera for part in (scene.train, scene.held_out) for x in part}
    maps = label_maps(capture, scene.train.names)
    (names,) = {tuple(names) for _, names in maps.values()}
    count = len(names) + 1
    labels, seen_by = [x for x, _ in maps.values()], [cameras[stem] for stem in maps]
    evidence = nl.rasterize_evidence(scene.gaussians, seen_by, labels, num_regions=[count] * len(labels))
    weights = evidence.rows.matmul(torch.eye(count).repeat(len(labels), 1))
    total, (share, best) = weights.sum(1), weights.max(1)
    clear = (total >= WEIGHT) & (share >= PURITY * total)
    found = {name: (clear & (best == i)).nonzero().squeeze(1) for i, name in enumerate(names, start=1)}
    return {name: some for name, some in found.items() if len(some) > 0}


def measure(report: Report, capture: str, config: Path) -> None:
    """Add the figures of one lifted run."""
    run, g = nl.open_run(config), torch.Generator().manual_seed(0)
    features = load_file(config.parent / FIELD_FOLDER / "field.safetensors")["features"]
    evidence = Evidence.load(config.parent / FIELD_FOLDER / "evidence.safetensors")
    means = run.scene.gaussians.means.float()
    seen = Seen.of(evidence, normalize(features, dim=1), means, run.scene.train.cameras)
    things = things_of(run, capture)
    for key, value in geometry(seen, things, g).items():
        report.add(f"{capture}.{key}", value, "degrees" if key == "scale" else "cosine")
    agreement = run.field.manifest["statistics"]["consensus"]["agreement"]
    report.add(f"{capture}.agreement", agreement[0], "B")
    report.add(f"{capture}.empty", (features == 0).all(1).float().mean(), "share of regions without a feature")
    texts = normalize(ImageNetEncoder().network.fc.weight.detach().float(), dim=1)
    lifted = run.field.directions().cpu()
    found = {
        name: text_cosines(seen, lifted, some, WORDS[name], texts, g) for name, some in things.items() if name in WORDS
    }
    for name, values in found.items():
        for key, value in values.items():
            report.add(f"{capture}.{name}.{key}", value, TEXT_UNITS.get(key, "cosine"))
    for key in ("own", "wrong", "spread"):
        if found:
            report.add(f"{capture}.{key}", fmean(x[key] for x in found.values()), "mean over the labels")


def measure_agreement(report: Report) -> None:
    """Add B, the agreement of regions across views, of small rooms with statistic real."""
    for world in (demo(8000, 24, 160), second(8000, views=24, width=160)):
        for step in ("noise only", "mild", "hard"):
            seen = observe(world, orthogonal_words(world.classes), STEPS[step], 1000, FOX)
            found = consensus(seen.evidence, seen.features)
            report.add(f"{world.name}.{step}.agreement", found.agreement[0], "B")


def main() -> None:
    """Write the results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", help="CAPTURE=config.yml of a lifted run")
    report = Report("geometry")
    for text in parser.parse_args().runs:
        capture, config = text.split("=", 1)
        measure(report, capture, Path(config))
    measure_agreement(report)
    report.write()


if __name__ == "__main__":
    main()
