"""Panels that explain one answer: image, edges, regions, 2D answer, lifted answer, R, and supporting images.

    python -m research.panels RUN/config.yml VIEW --text "red fox" --output panels.png

VIEW is the name of a training image of the lifted run. Regions and features that are not in the run's cache are
computed, which needs the weights of the lift. Both answers have the same colors, and a white line at the threshold.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.colors import hsv_to_rgb
from matplotlib.figure import Figure
from torch import Tensor

from normlift_ns import LiftedRun, open_run, render
from normlift_ns.analysis.explain import ViewVote, draw_outlines
from normlift_ns.core.field import NULL_SHARE
from normlift_ns.core.relevancy import relevancy
from normlift_ns.encoders.build import null_vectors, restore_source
from normlift_ns.encoders.cache import cached
from normlift_ns.evidence_collection import observe_views
from normlift_ns.io.run_dir import cache_folder
from normlift_ns.query.engine import Finding
from normlift_ns.rasterization.rasterize import render_image
from normlift_ns.rasterization.settings import RasterSettings
from normlift_ns.rendering import colors
from normlift_ns.rendering.figures import Display, make_display, pixel_relevancy, relevancy_map
from normlift_ns.segmentation.edges import EdgeRegions

COLUMNS, WIDTH, GAP, TITLE = 4, 3.6, 0.1, 0.32
"""Number of panels per row, and width of a panel, gap between panels and height of a title in inches."""
WITNESSES, LARGEST, LEAST = 2, 10, 0.25
"""Numbers that choose supporting images: how many are shown, how many with the largest votes are candidates, and the
smallest vote of an outlined region relative to the largest of its image. The candidates with the best agreement win."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("config", type=Path, help="config.yml of a lifted run")
    parser.add_argument("view", help="name of a training image")
    parser.add_argument("--text", required=True, help="prompt")
    parser.add_argument("--output", type=Path, required=True, help="PNG to write")
    arguments = parser.parse_args()
    torch.set_grad_enabled(False)
    figure = draw(open_run(arguments.config, device="cpu"), arguments.view, arguments.text)
    figure.savefig(arguments.output, dpi=110)
    print(f"Written: {arguments.output}")


@dataclass(frozen=True)
class Observed:
    """A training image as processed by the lift."""

    image: Tensor
    """[H, W, 3] RGB, in 0..255."""
    region: Tensor
    """[H, W] region of every pixel in the (first) level of the lift, or -1 for none."""
    features: Tensor
    """[R, D] unit rows."""
    cells: Tensor
    """[H, W] cell of every pixel, or -1 for none."""
    regions: Tensor
    """[levels, C] region of every cell."""

    def outlined(self, vote: ViewVote) -> Tensor:
        """Return the image [H, W, 3] with outlines around the regions that voted."""
        inside = [
            (self.regions == one.region).any(dim=0)
            for one in vote.regions
            if one.share >= LEAST * vote.regions[0].share
        ]
        return draw_outlines(self.image, torch.stack([(self.cells >= 0) & x[self.cells.clamp(min=0)] for x in inside]))


@dataclass(frozen=True)
class Story:
    """A lifted run, one of its images and a prompt."""

    run: LiftedRun
    view: str
    found: Finding

    @cached_property
    def source(self) -> Any:
        return cached(restore_source(self.run.field.manifest), cache_folder(self.run.folder))

    def observe(self, name: str) -> Observed:
        options, images = self.run.field.manifest["options"], []
        settings = RasterSettings.recorded(self.run.field.manifest) if options["image_source"] == "render" else None
        block = observe_views(
            self.run.scene,
            [list(self.run.scene.train.names).index(name)],
            self.source,
            render_settings=settings,
            downscale=options["lift_downscale"],
            on_view=images.append,
        )
        cells, regions = block.labels[0].long(), block.regions[0].long()
        region = regions[0][cells.clamp(min=0)].where(cells >= 0, -1)
        return Observed(images[0].image, region, block.features[0], cells, regions)

    def edge_map(self, observed: Observed) -> Tensor | None:
        """Return the strength [H, W] of the learned edges, in 0..1; None for other regions."""
        regions = getattr(self.source, "regions", None)
        regions = getattr(regions, "inner", regions)
        if not isinstance(regions, EdgeRegions):
            return None
        edges = torch.from_numpy(regions.edges(observed.image)).float()[None, None] / 255
        return torch.nn.functional.interpolate(edges, observed.region.shape, mode="bilinear")[0, 0]

    def in_2d(self, observed: Observed) -> Tensor:
        """Return the relevancy [H, W] of the image's own regions; 0 for pixels without a region."""
        question = self.found.answer.question
        positive = observed.features @ torch.as_tensor(question.embeddings).T
        against = question.negative_embeddings
        negative = None if against is None else observed.features @ torch.as_tensor(against).T
        if question.rule == "contrast":
            null = null_vectors(restore_source(self.run.field.manifest), self.run.field.manifest["encoder"])
            assert null is not None
            cosines = observed.features @ torch.nn.functional.normalize(null, dim=1).T
            negative = cosines.topk(max(2, round(NULL_SHARE * len(null))), dim=1).values[:, -1:]
        found = relevancy(positive, negative, rule=question.rule)[:, self.found.index]
        return found[observed.region.clamp(min=0)].where(observed.region >= 0, 0.0)

    def rendered(self) -> tuple[Display, Tensor, Tensor, Tensor]:
        """Return the display of the answer, the rendered scene, its values and its opacity."""
        scene, settings = self.run.scene, RasterSettings.recorded(self.run.field.manifest)
        camera = self.run.camera(self.view)
        display = make_display(self.run.field, self.found.answer, shown=self.found.index)
        values, alpha = render(
            scene.gaussians, camera, display.values, rasterize_mode=scene.rasterize_mode, settings=settings
        )
        return display, render_image(scene, camera, settings=settings).float() / 255, values, alpha


def draw(run: LiftedRun, view: str, text: str) -> Figure:
    """Draw the panels of an answer in a view."""
    name = next((x for x in run.scene.train.names if view in (x, Path(x).name, Path(x).stem)), None)
    if name is None:
        raise SystemExit(f"{view!r} is not a training image; choose one of: {', '.join(run.scene.train.names)}")
    story = Story(run, name, run.ask(text)[text])
    panels = list(story_panels(story))
    height = WIDTH * panels[0][1].shape[0] / panels[0][1].shape[1] + TITLE
    rows = -(-len(panels) // COLUMNS)
    size = (COLUMNS * (WIDTH + GAP) + GAP, rows * (height + GAP) + TITLE)
    figure = Figure(figsize=size)
    for i, (title, image, line) in enumerate(panels):
        x, y = GAP + i % COLUMNS * (WIDTH + GAP), size[1] - (i // COLUMNS + 1) * (height + GAP) + GAP
        place = figure.add_axes((x / size[0], y / size[1], WIDTH / size[0], (height - TITLE) / size[1]))
        show(place, title, image, line)
    if bool(story.found.mask.any()):
        figure.text(GAP / size[0], 0.12 / size[1], run.why(story.found).sentence, fontsize=10)
    return figure


def show(place: Axes, title: str, image: Tensor, line: Tensor | None) -> None:
    place.imshow(image.numpy(), cmap="gray_r", vmin=0, vmax=1, interpolation="antialiased", aspect="auto")
    if line is not None and bool(line.any()):
        for color, width in (("black", 2.4), ("white", 1.2)):
            place.contour(line.numpy(), levels=[0.5], colors=color, linewidths=width)
    place.set_title(title, fontsize=11, loc="left", pad=4)
    place.set_axis_off()


def story_panels(story: Story) -> Iterator[tuple[str, Tensor, Tensor | None]]:
    """Yield title, image and selected pixels of each panel."""
    observed, found = story.observe(story.view), story.found
    threshold = found.answer.question.threshold
    yield f"Training image {Path(story.view).stem}", observed.image, None
    edges = story.edge_map(observed)
    boundary = boundaries(observed.region)
    yield ("Outlines of regions", boundary.float(), None) if edges is None else ("Learned edges", edges, None)
    yield f"{len(observed.features)} regions", colored(observed, boundary), None
    display, rgb, values, alpha = story.rendered()
    flat = story.in_2d(observed)
    photograph = observed.image.float() / 255
    yield (
        f"“{found.text}” in this image alone",
        relevancy_map(display, photograph, flat, torch.ones_like(flat)),
        (flat > threshold),
    )
    count = display.num_prompts
    pixel = pixel_relevancy(values[..., : count + 1], alpha)[..., found.index]
    lifted = relevancy_map(display, rgb, pixel, alpha)
    lifted = colors.add_color_bar(lifted, display.colormap, display.map_scale, "relevancy")
    yield f"“{found.text}” lifted onto the Gaussians", lifted, values[..., count + 1] > 0.5
    yield "How far the images agree", reliability(values[..., count + 3 : count + 4], alpha, rgb), None
    names, votes = story.run.votes.names, story.run.why(found).views if bool(found.mask.any()) else ()
    others = [x for x in votes if names[x.view] != story.view][:LARGEST]
    for vote in sorted(others, key=lambda x: -x.agreement)[:WITNESSES]:
        witness = story.observe(names[vote.view])
        title = f"Why: image {Path(names[vote.view]).stem}, {vote.share:.0%} of the evidence"
        yield title, witness.outlined(vote), None


def reliability(values: Tensor, alpha: Tensor, rgb: Tensor) -> Tensor:
    """Return a map [H, W, 3] of R between its 5 % and 95 % quantiles in the view."""
    pixel = pixel_relevancy(values, alpha)[..., 0]
    low, high = pixel[alpha > 0.5].quantile(torch.tensor([0.05, 0.95])).tolist()
    color, opacity = colors.apply_colormap(
        pixel, (low, max(high, low + 0.05)), colors.colormap_rgb(colors.RELIABILITY_COLORMAP), min_opacity=0.9
    )
    shown = rgb.mean(dim=2, keepdim=True) * (1 - opacity[..., None]) + color * opacity[..., None]
    return colors.add_color_bar(shown, colors.RELIABILITY_COLORMAP, (low, high), "reliability R")


def boundaries(region: Tensor) -> Tensor:
    """Return a mask [H, W] of the pixels next to another region."""
    found = torch.zeros_like(region, dtype=torch.bool)
    found[:, 1:] |= region[:, 1:] != region[:, :-1]
    found[1:] |= region[1:] != region[:-1]
    return found


def colored(observed: Observed, boundary: Tensor) -> Tensor:
    """Return an image [H, W, 3] with each region in a different color, and white lines between regions."""
    hue = np.random.default_rng(0).permutation(len(observed.features)) / len(observed.features)
    hsv = np.stack([hue, np.full_like(hue, 0.75), np.full_like(hue, 0.9)], axis=1)
    palette = torch.from_numpy(hsv_to_rgb(hsv)).float()
    gray = observed.image.float().mean(dim=2, keepdim=True) / 255
    inside = (observed.region >= 0)[..., None]
    picture = torch.where(inside, 0.5 * gray + 0.5 * palette[observed.region.clamp(min=0)], gray)
    return torch.where(boundary[..., None], 1.0, picture)


if __name__ == "__main__":
    main()
