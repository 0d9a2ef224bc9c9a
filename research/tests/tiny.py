"""A small world for the tests of benchmarks."""

import torch

from research.synthetic_scenes import World, cell_evidence, made_words
from tests.random_scenes import generator, orbit, random_scene

CLASSES = 4
WORDS = made_words(CLASSES, dimension=128)


def exact_maps(cameras, seed: int) -> torch.Tensor:
    """Quarters of the image, in an order of their own in every view, and a strip of nothing."""
    g, maps = generator(seed), []
    for camera in cameras:
        y, x = torch.meshgrid(torch.arange(camera.height), torch.arange(camera.width), indexing="ij")
        quarter = (y > camera.height / 2).long() * 2 + (x > camera.width / 2).long()
        classes = torch.randperm(CLASSES, generator=g)[quarter]
        classes[:2] = -1
        maps.append(classes)
    return torch.stack(maps)


def tiny_world() -> World:
    scene, cameras, held_out = random_scene(300, dtype=torch.float32), orbit(6), orbit(2, distance=5.0)
    maps = exact_maps(cameras, 0)
    evidence, cells = cell_evidence(scene, cameras, maps)
    truth = torch.randint(-1, CLASSES, (300,), generator=generator(1))
    return World("tiny", scene, cameras, evidence, cells, truth, CLASSES, held_out, exact_maps(held_out, 1))
