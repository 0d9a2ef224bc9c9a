"""docs/evidence.png and docs/concepts.png: evidence and numbers of Gaussians in the plain room with damaged masks.

python -m research.concepts
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

import numpy as np
import torch
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from torch import Tensor

from normlift_ns import lift, render
from normlift_ns.rendering.colors import RELIABILITY_COLORMAP
from research.damage import LADDER, Observed, observe
from research.pictures import of_regions
from research.plots import DOCS
from research.synthetic_scenes import World, demo, made_words
from tests.plain_room import plain_room

STEP, SEED, VIEW = "hard", 0, 12
"""Damage step, seed, and index of the view, which is one of the lifted views."""
THING = "red"
"""Class of the Gaussian whose evidence is drawn."""
LOW = 0.3
"""Value of the darkest color of maps from 0 to 1."""

Panel = tuple[str, Tensor | np.ndarray, bool]
"""Title, content, and True if the content is a map of numbers."""


def drawn(world: World, values: Tensor) -> Tensor:
    """Return [H, W], the mean value of the Gaussians that compose each pixel of the view."""
    shown, alpha = render(world.scene, world.cameras[VIEW], values[:, None])
    return shown[..., 0] / alpha.clamp(min=1e-6)


def draw(name: str, panels: Sequence[Panel]) -> None:
    """Draw panels next to each other as docs/NAME, with one color scale for all maps of numbers."""
    rows = (len(panels) + 2) // 3
    figure = Figure(figsize=(12, 3.1 * rows), layout="constrained")
    places, scale = figure.subplots(rows, 3, squeeze=False), None
    for place in places.flat:
        place.set_axis_off()
    for place, (title, values, number) in zip(places.flat, panels, strict=False):
        shown = place.imshow(values, **({"cmap": RELIABILITY_COLORMAP, "vmin": LOW, "vmax": 1} if number else {}))
        place.set_title(title)
        scale = shown if number else scale
    if scale is not None:
        figure.colorbar(scale, ax=places, shrink=0.6, extend="min")
    figure.savefig(DOCS / name, dpi=85)
    sys.stdout.write(f"Written: {DOCS / name}\n")


def evidence_panels(world: World, observed: Observed, classes: Tensor, names: Sequence[str]) -> list[Panel]:
    """Return the three images with the most weight of one Gaussian of the ball, each with its region highlighted."""
    rows = observed.evidence.rows
    totals = torch.segment_reduce(rows.weight.double(), "sum", offsets=rows.offsets)
    ball = world.truth == names.index(THING)
    gaussian = int(torch.where(ball, totals, -1).argmax())
    mine = slice(int(rows.offsets[gaussian]), int(rows.offsets[gaussian + 1]))
    column, weight = rows.column[mine].long(), rows.weight[mine]
    region = observed.columns[0][world.cells.of_pixel.long()]
    found: list[tuple[str, Tensor | np.ndarray, bool]] = []
    for i in weight.argsort(descending=True)[:3].tolist():
        view = int(observed.evidence.region_view[column[i]])
        colours, _ = render(world.scene, world.cameras[view], torch.as_tensor(world.colors))
        inside = (region[view] == column[i])[..., None]
        told = names[int((observed.features[column[i]] @ classes.T).argmax())]
        picture = torch.where(inside, colours, 0.25 * colours + 0.1).clamp(0, 1)
        found.append((f'mask says "{told}"; E = {float(weight[i]):.0f} pixels', picture, False))
    return found


def main() -> None:
    """Draw both figures."""
    torch.set_grad_enabled(False)
    world = demo()
    words = made_words(world.classes)
    room = plain_room(2000)
    palette = np.array([*(to_rgb(f"xkcd:{name}") for name in room.names), (0, 0, 0)])
    observed = observe(world, words, LADDER[STEP], SEED)
    lifted = lift(observed.evidence, observed.features)
    regions, _ = of_regions(world, observed, observed.features, words.classes)
    numbers = lifted.scalars
    colours, _ = render(world.scene, world.cameras[VIEW], torch.as_tensor(world.colors))
    right = (lifted.directions() @ words.classes.T).argmax(dim=1) == world.truth
    draw("evidence.png", evidence_panels(world, observed, words.classes, room.names))
    draw(
        "concepts.png",
        [
            ("a photograph", colours.clamp(0, 1), False),
            ("what its masks say (black: no mask)", palette[regions[VIEW]], False),
            ("agreement within views, C_intra", drawn(world, numbers.c_intra), True),
            ("agreement between views, C_inter", drawn(world, numbers.c_inter), True),
            ("reliability R", drawn(world, numbers.reliability), True),
            ("share of Gaussians that are right", drawn(world, right.float()), True),
        ],
    )


if __name__ == "__main__":
    main()
