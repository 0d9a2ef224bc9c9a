"""docs/demo.png: a query of the demo room, its answer from damaged masks, its reliability, and the repaired answer.

python -m research.front_page

The masks are those of step "wrong classes" of the ladder of damage, with seed 0: about a third of them have another
class. The features of masks are made of vectors that are as similar to each other as those of CLIP's texts.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from matplotlib.figure import Figure
from torch import Tensor

from normlift_ns import RefineConfig, lift, nearest_neighbors, render
from normlift_ns.core.consensus import consensus
from normlift_ns.core.metrics import mask_iou
from normlift_ns.demo.capture import demo_cameras, held_out_cameras
from normlift_ns.demo.room import demo_room
from normlift_ns.evaluation.studies import accuracy_bins
from normlift_ns.rendering.colors import RELIABILITY_COLORMAP
from research.damage import LADDER, observe
from research.plots import DOCS
from research.synthetic_scenes import World, made_words, world_of_room
from research.variants import Scores, lifted_scores, refined_scores

STEP, SEED, VIEW = "wrong classes", 0, 3
ASKED = "tomato red"
FOUND = torch.tensor([0.95, 0.2, 0.1])
"""RGB color of selected Gaussians; the rest is gray."""
LOWEST, HIGHEST = 0.55, 0.85
"""Ends of the color scale of R."""


def main() -> None:
    torch.set_grad_enabled(False)
    room = demo_room()
    world = world_of_room("room", room, demo_cameras(24, 320, 240), held_out_cameras(4, 640, 420))
    words = made_words(world.classes)
    asked = room.names.index(ASKED)
    observed = observe(world, words, LADDER[STEP], SEED)
    lifted = lift(observed.evidence, observed.features)
    agreed = lift(observed.evidence, consensus(observed.evidence, observed.features).features)
    near = nearest_neighbors(world.scene.means, RefineConfig().k)
    voting, both = replace(agreed, scalars=lifted.scalars), lifted_scores(agreed, words.classes)
    plain = lifted_scores(lifted, words.classes)
    final = refined_scores("posterior", world.scene.means, voting, both, near)

    reliability = lifted.scalars.reliability
    values, alpha = render(world.scene, world.held_out[VIEW], reliability[:, None])
    photo = shown(world, room.colors)
    known = world.truth >= 0
    tenths = accuracy_bins(reliability[known], (plain.cosine.argmax(dim=1) == world.truth)[known])
    figure = Figure(figsize=(11, 7.5), layout="constrained")
    panels = figure.subplots(2, 2)
    panels[0, 0].imshow(photo)
    panels[0, 0].set_title("Where are the tomatoes?")
    panels[0, 1].imshow(overlay(world, photo, plain, asked))
    panels[0, 1].set_title(f"Lifted, nothing else: IoU {iou(world, plain, asked):.2f}")
    mean = values[..., 0] / alpha.clamp(min=1e-6)
    scale = panels[1, 0].imshow(mean, cmap=RELIABILITY_COLORMAP, vmin=LOWEST, vmax=HIGHEST)
    panels[1, 0].set_title(f"Reliability R: {tenths[0]:.0%} right in its lowest tenth, {tenths[-1]:.0%} in its highest")
    legend = panels[1, 0].inset_axes((0.66, 0.09, 0.3, 0.035))
    figure.colorbar(scale, cax=legend, orientation="horizontal", extend="both", ticks=(LOWEST, 0.7, HIGHEST))
    panels[1, 1].imshow(overlay(world, photo, final, asked))
    panels[1, 1].set_title(f"Repaired by consensus and vote: IoU {iou(world, final, asked):.2f}")
    for place in panels.flat:
        place.set_axis_off()
    figure.savefig(DOCS / "demo.png", dpi=100)
    print(f"Written: {DOCS / 'demo.png'}")


def shown(world: World, values: Tensor) -> Tensor:
    """Return [H, W, C], values of the Gaussians rendered in the view."""
    return render(world.scene, world.held_out[VIEW], values)[0].clamp(0, 1)


def overlay(world: World, photo: Tensor, scores: Scores, asked: int) -> Tensor:
    """Return [H, W, 3], the view in gray with the Gaussians that are nearest to the class `asked` in color."""
    found = shown(world, (scores.cosine.argmax(dim=1) == asked).float()[:, None])
    return (0.6 * photo.mean(dim=-1, keepdim=True) + 0.25) * (1 - found) + FOUND * found


def iou(world: World, scores: Scores, asked: int) -> float:
    """Return the IoU over the Gaussians with a known class."""
    known = world.truth >= 0
    return mask_iou((scores.cosine.argmax(dim=1) == asked)[known], (world.truth == asked)[known])


if __name__ == "__main__":
    main()
