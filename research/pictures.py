"""The plain room at step "hard" of the ladder of damage, with every pixel in the color of its class.

python -m research.pictures      docs/refinement.png and docs/consensus.png

The first figure shows a held-out view: the truth, the lift, and the refined lift. The second figure shows the training
view with the median gain of the consensus: its truth, and the classes of its regions before and after the consensus. It
also shows the held-out view: the lift, the lift with consensus, and the lift with consensus and posterior vote.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from numpy.typing import NDArray
from torch import Tensor

from normlift_ns import RefineConfig, lift, nearest_neighbors, render
from normlift_ns.core.consensus import consensus
from normlift_ns.core.metrics import classify, mask_iou
from research.damage import LADDER, Observed, observe
from research.plots import DOCS
from research.synthetic_scenes import World, demo, made_words
from research.variants import Scores, lifted_scores, refined_scores
from tests.plain_room import plain_room

STEP, SEED, VIEW = "hard", 0, 0
"""Damage step, seed, and index of the held-out view."""
Panel = tuple[str, Tensor]
"""Title, and [H, W] class of every pixel, or -1 for none."""


def of_regions(world: World, observed: Observed, features: Tensor, classes: Tensor) -> tuple[Tensor, list[float]]:
    """Return [V, H, W] classes of the regions of the training views, and the share of correct labeled pixels per
    view."""
    region, truth = observed.columns[0][world.cells.of_pixel.long()], world.cells.maps
    found = torch.where(region >= 0, (features @ classes.T).argmax(dim=1)[region.clamp(min=0)], -1)
    known = (region >= 0) & (truth >= 0)
    return found, [float((a == b)[there].double().mean()) for a, b, there in zip(found, truth, known)]


def held_out_panel(title: str, world: World, scores: Scores) -> Panel:
    """Return the panel of the held-out view with its mIoU."""
    truth = world.held_out_maps[VIEW]
    values, alpha = render(world.scene, world.held_out[VIEW], scores.cosine)
    found = classify(values.flatten(0, 1), alpha.flatten() > 0).view(alpha.shape)
    ious = [mask_iou(found == c, truth == c) for c in truth[truth >= 0].unique()]
    return f"{title}: mIoU {np.mean(ious):.2f}", found


def draw(name: str, palette: NDArray[np.float64], panels: Sequence[Panel]) -> None:
    """Draw rows of three panels as docs/NAME."""
    rows = len(panels) // 3
    figure = Figure(figsize=(12, 3.4 * rows), layout="constrained")
    for axes, (title, labels) in zip(figure.subplots(rows, 3).flat, panels):
        axes.imshow(palette[labels])
        axes.set_title(title)
        axes.set_axis_off()
    figure.savefig(DOCS / name, dpi=100 if rows == 1 else 75)
    print(f"Written: {DOCS / name}")


def main() -> None:
    torch.set_grad_enabled(False)
    world = demo()
    means, classes = world.scene.means, (words := made_words(world.classes)).classes
    palette = np.array([*(to_rgb(f"xkcd:{name}") for name in plain_room(2000).names), (0, 0, 0)])
    observed = observe(world, words, LADDER[STEP], SEED)
    near = nearest_neighbors(means, RefineConfig().k)
    lifted = lift(observed.evidence, observed.features)
    plain = lifted_scores(lifted, classes)
    found = consensus(observed.evidence, observed.features).features
    agreed = lift(observed.evidence, found)
    both, voting = lifted_scores(agreed, classes), replace(agreed, scalars=lifted.scalars)
    final = refined_scores("posterior", means, voting, both, near)
    (damaged, before), (mended, after) = (of_regions(world, observed, x, classes) for x in (observed.features, found))
    gains = [b - a for a, b in zip(before, after)]
    view = gains.index(sorted(gains)[len(gains) // 2])
    without = held_out_panel("lifted", world, plain)
    draw(
        "refinement.png",
        palette,
        [("truth", world.held_out_maps[VIEW]), without, held_out_panel("with consensus and vote", world, final)],
    )
    draw(
        "consensus.png",
        palette,
        [
            ("a training view: truth", world.cells.maps[view]),
            (f"its regions: {before[view]:.0%} of pixels right", damaged[view]),
            (f"after the consensus: {after[view]:.0%}", mended[view]),
            ("a held-out view, " + without[0], without[1]),
            held_out_panel("with consensus", world, both),
            held_out_panel("and own evidence in the vote", world, final),
        ],
    )


if __name__ == "__main__":
    main()
