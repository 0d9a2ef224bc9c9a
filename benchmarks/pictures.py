"""The demo room in a held-out view, every pixel in the colour of its class: the truth, the lift, and the lift refined.

python -m benchmarks.pictures      docs/refinement.png, step "hard" of the ladder of damage
"""

from __future__ import annotations

import numpy as np
import torch
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from benchmarks.damage import LADDER, observe
from benchmarks.plots import DOCS
from benchmarks.variants import lifted_scores, refined_scores
from benchmarks.worlds import demo, made_words
from normlift_ns import lift, nearest_neighbors, render
from normlift_ns.core.metrics import classify, mask_iou
from normlift_ns.core.refine import RefineConfig
from normlift_ns.demo import demo_room

STEP, SEED, VIEW = "hard", 0, 0


def main() -> None:
    torch.set_grad_enabled(False)
    world = demo()
    names, words = demo_room(2000).names, made_words(world.classes)
    palette = np.array([*(to_rgb(f"xkcd:{name}") for name in names), (0, 0, 0)])
    observed = observe(world, words, LADDER[STEP], SEED)
    lifted = lift(observed.evidence, observed.features)
    plain = lifted_scores(lifted, words.classes)
    near = nearest_neighbors(world.scene.means, RefineConfig().k)
    truth = world.held_out_maps[VIEW]
    figure = Figure(figsize=(12, 3.4), layout="constrained")
    axes = figure.subplots(1, 3)
    axes[0].imshow(palette[truth])
    axes[0].set_title("truth")
    for one, title, scores in (
        (axes[1], "lifted", plain),
        (axes[2], "lifted and refined", refined_scores("paper", world.scene.means, lifted, plain, near)),
    ):
        values, alpha = render(world.scene, world.held_out[VIEW], scores.cosine)
        found = classify(values.flatten(0, 1), alpha.flatten() > 0).view(alpha.shape)
        ious = [mask_iou(found == c, truth == c) for c in truth[truth >= 0].unique()]
        one.imshow(palette[found])
        one.set_title(f"{title}: mIoU {np.mean(ious):.2f}")
    for one in axes:
        one.set_axis_off()
    figure.savefig(DOCS / "refinement.png", dpi=100)
    print(f"Written: {DOCS / 'refinement.png'}")


if __name__ == "__main__":
    main()
