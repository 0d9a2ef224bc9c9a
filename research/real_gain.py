"""Average precision on photographs with hand-drawn labels, before and after consensus and vote: the fox.

    python -m research.real_gain RUN/config.yml       a lifted run of the fox with `--regions edges --encoder imagenet
                                                     --storage evidence`, lifted while its consensus stayed off

Pixels of six labeled images are pooled. A text's relevancy, a cosine, is rendered and compared with the masks.
`fox head` is asked as "fox" and shows what a consensus costs a part. Prints one line for every way to refine.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from time import perf_counter

import numpy as np
import torch
from torch import Tensor

import normlift_ns as nl
from normlift_ns.core.consensus import consensus, sample_gaussians
from normlift_ns.core.gate import relative_gate, sample_pairs, shared_region_cosines
from normlift_ns.core.left_out import leave_views_out
from normlift_ns.core.lowrank import StoredEvidence
from normlift_ns.core.refine import labeled_share
from normlift_ns.encoders.imagenet_network import ImageNetEncoder
from normlift_ns.options import RefineConfig
from research.edges import CAPTURES, read_labels
from research.imagenet import average_precision
from tests.captures import capture

TEXTS = {"fox": "fox", "fox head": "fox", "shield": "shield"}
"""Text to ask for each label."""


def refined(evidence: nl.Evidence, features: Tensor, means: Tensor, texts: Tensor) -> Iterator[tuple[str, Tensor]]:
    """Cosines [N, T] of every way to refine."""
    start = perf_counter()
    seen = nl.lift(evidence, features)
    lifted = perf_counter()
    agreed = consensus(evidence, features, least=0.0)
    done = perf_counter()
    chosen, probability = sample_gaussians(evidence.rows, evidence.num_regions, 50)
    found = leave_views_out(evidence.select_gaussians(chosen), probability, features, least=0.0)
    seconds = (lifted - start, done - lifted, perf_counter() - done)
    print(f"lift {seconds[0]:.1f} s, consensus {seconds[1]:.1f} s, recognition {seconds[2]:.1f} s: {found}", flush=True)
    cleaned = nl.lift(evidence, agreed.features)
    own = torch.where(cleaned.scalars.norm > 0, seen.scalars.own_evidence, 0.0)
    near, labeled = nl.nearest_neighbors(means, 36), labeled_share(evidence)
    pairs = sample_pairs(torch.arange(len(means)), near.index, len(means))
    print(f"B {agreed.agreement}")

    def cosines(lifted: nl.Lifted) -> Tensor:
        return torch.cat([lifted.directions(rows) @ texts.T for rows in torch.arange(len(means)).split(2**13)])

    for name, lifted, gate in (("lift", seen, False), ("consensus", cleaned, True)):
        plain, r = cosines(lifted), torch.where(lifted.scalars.norm > 0, seen.scalars.reliability, 0.0)
        yield name, plain
        old = RefineConfig(tau=0.9, gamma=0.05, min_labeled=0.0)
        configs = {"fixed gate": old}
        found = relative_gate(shared_region_cosines(lifted, *pairs)) if gate else None
        if found is not None:
            configs["measured gate"] = replace(old, tau=found[0], gamma=found[1], min_labeled=None)
        for label, config in configs.items():
            source = nl.refine(means, lifted.directions, r, config, own=own, neighbors=near, labeled=labeled).long()
            changed = (source != torch.arange(len(source))).float().mean()
            yield f"{name}, {label} {config.numbers.tau:.3f}, copied {changed:.1%}", plain[source]


@torch.no_grad()
def main(arguments: argparse.Namespace) -> None:
    run, scene = nl.open_run(arguments.run), capture("fox")
    stored = run.field.store
    if not isinstance(stored, StoredEvidence):
        raise SystemExit("this run does not store its evidence; lift again with --storage evidence")
    views = {Path(x.name).stem: x for part in (scene.train, scene.held_out) for x in part}
    masks = read_labels(CAPTURES / "fox_labels.json")
    texts = ImageNetEncoder().text(list(TEXTS.values()))
    means = scene.gaussians.means
    for name, cosine in refined(stored.evidence, stored.features, means, texts):
        drawn = {image: nl.render(scene.gaussians, views[image].camera, cosine, rasterize_mode=scene.rasterize_mode)[0]
                 for image in masks}  # fmt: skip
        scores = {}
        for i, label in enumerate(TEXTS):
            truth = np.concatenate(
                [of.get(label, np.zeros_like(next(iter(of.values())))).ravel() for of in masks.values()]
            )
            scores[label] = average_precision(truth, np.concatenate([drawn[x][..., i].numpy().ravel() for x in masks]))
        print(f"{name:45}", {key: round(value, 4) for key, value in scores.items()}, flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    main(parser.parse_args())
