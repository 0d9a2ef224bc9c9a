"""Draw the boxes of a catalog into the images that show most of each object, for inspection.

python -m research.draw_boxes outputs/…/normlift/…/config.yml /tmp/boxes --texts mug bowl
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

import normlift_ns as nl
from normlift_ns.analysis.objects import CatalogueObject
from normlift_ns.core.scene import Scene

EDGES = [(a, a | bit) for a in range(8) for bit in (1, 2, 4) if not a & bit]


def drawn(scene: Scene, name: str, found: CatalogueObject) -> Image.Image:
    """Return the image with the edges of the box, and the centroid as a dot."""
    view = scene.train[list(scene.train.names).index(name)]
    image = Image.fromarray(view.image.numpy())
    pen, pose, K = ImageDraw.Draw(image), view.camera.world_to_camera.double().numpy(), view.camera.K.double().numpy()

    def pixels(points: np.ndarray) -> np.ndarray:
        there = points @ pose[:3, :3].T + pose[:3, 3]
        there[:, 2] = there[:, 2].clip(min=1e-3)
        return (there @ K.T)[:, :2] / there[:, 2:]

    corners = pixels(found.scene.box.corners.numpy())
    for a, b in EDGES:
        pen.line([*map(float, corners[a]), *map(float, corners[b])], fill=(255, 0, 255), width=3)
    ((x, y),) = pixels(found.scene.centroid[None].numpy())
    pen.ellipse([x - 5, y - 5, x + 5, y + 5], fill=(0, 255, 0))
    pen.text((8, 8), f"{found.id} {found.text} {found.gaussians} in {found.views} views", fill=(255, 255, 0))
    return image


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("config")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--texts", nargs="+", required=True)
    parser.add_argument("--objects", type=int, default=1, help="objects to draw for each text")
    given = parser.parse_args()
    run = nl.open_run(given.config)
    given.folder.mkdir(parents=True, exist_ok=True)
    listed = run.catalogue(run.ask(*given.texts)).objects
    for text in given.texts:
        for found in [found for found in listed if found.text == text][: given.objects]:
            pictures = [drawn(run.scene, name, found) for name in found.best_views]
            sheet = Image.new("RGB", (sum(p.width for p in pictures), max(p.height for p in pictures)))
            for i, picture in enumerate(pictures):
                sheet.paste(picture, (sum(p.width for p in pictures[:i]), 0))
            sheet.thumbnail((1500, 1500))
            sheet.save(given.folder / f"{found.id}_{text.replace(' ', '_')}.png")


if __name__ == "__main__":
    main()
