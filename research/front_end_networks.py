"""Times and errors of SAM's network alone, in each precision."""

from __future__ import annotations

import copy
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from normlift_ns.options import SamPrecision
from normlift_ns.segmentation.sam import SamNetwork
from research.report import Report

_REPEATS = 3


def seconds(function: Callable[[], object], device: str) -> float:
    """Return the shortest time of some runs after a warm-up run."""
    times = []
    for _ in range(1 + _REPEATS):
        start = time.perf_counter()
        function()
        if device.startswith("cuda"):
            torch.cuda.synchronize()
        times.append(time.perf_counter() - start)
    return min(times[1:])


@dataclass(frozen=True)
class Exact:
    """Answers in float64 to some prompts on the first crop."""

    embedding: Tensor
    points: Tensor
    logits: Tensor

    @classmethod
    def of(cls, model: Any, pixels: Tensor, points: Tensor) -> Exact:
        model = copy.deepcopy(model).double()
        with torch.no_grad():
            embedding = model.get_image_embeddings(pixels[:1].double())
            found = model(image_embeddings=embedding, input_points=points[None, :, None].to(pixels.device).double())
        return cls(embedding, points, found.pred_masks[0])

    def encoder_error(self, network: SamNetwork, pixels: Tensor) -> float:
        """Return the norm of the error of an embedding, relative to its norm."""
        return float((network.embed(pixels[:1])[0] - self.embedding).norm() / self.embedding.norm())

    def decoder_error(self, network: SamNetwork) -> float:
        """Return the same error of the logits for the exact embedding."""
        found = SamNetwork.decode(network, self.embedding.float(), self.points)[0]
        return float((found.double() - self.logits).norm() / self.logits.norm())


def decode_all(network: SamNetwork, embeddings: list[Tensor], points: Tensor) -> None:
    for embedding in embeddings:
        for batch in points.split(256):
            SamNetwork.decode(network, embedding, batch)


def add_networks(
    report: Report, model: Any, pixels: Tensor, points: Tensor, device: str, exact: Exact, variants: bool
) -> None:
    """Add the times of the network in float32 or, with `variants`, in all precisions."""
    precisions: list[SamPrecision] = ["float32", "float16", "bfloat16"]
    for precision in precisions if variants else precisions[:1]:
        network = SamNetwork(model, device, precision)
        unit, error = f"s/image, {len(pixels)} crops", exact.encoder_error(network, pixels)
        time_s = seconds(lambda network=network: network.embed(pixels), device)
        report.add(f"sam_{precision}_encoder_s", time_s, unit, error)
        embeddings, unit = network.embed(pixels), f"s/image, {len(pixels) * len(points)} prompts"
        start = time.perf_counter()
        error = exact.decoder_error(network)
        report.add(f"sam_{precision}_first_s", time.perf_counter() - start, "first call, compilation included")
        time_s = seconds(lambda network=network, e=embeddings: decode_all(network, e, points), device)
        report.add(f"sam_{precision}_decoder_s", time_s, unit, error)
    if variants:
        for name, half, compiled in (("half", True, False), ("compiled", False, True), ("compiled_half", True, True)):
            with going_on(name, compiled):
                add_encoder(report, model, pixels, device, exact, name, half, compiled)


@contextmanager
def going_on(name: str, foreign: bool) -> Iterator[None]:
    """Print exceptions of compilers, which can raise any exception, so that the benchmark continues without them."""
    try:
        yield
    except Exception as error:
        if not foreign:
            raise
        print(f"{name} does not work here: {error}")


def add_encoder(
    report: Report, model: Any, pixels: Tensor, device: str, exact: Exact, name: str, half: bool, compiled: bool
) -> None:
    """Add the time of the image encoder, with or without weights and residuals in float16, compiled or not."""
    encoder = copy.deepcopy(model.vision_encoder)
    encoder = encoder.half() if half else encoder
    run = torch.compile(encoder, dynamic=False) if compiled else encoder

    @torch.no_grad()
    def embed() -> Tensor:
        with torch.autocast(torch.device(device).type, torch.float16, enabled=not half):
            return run(pixels.half() if half else pixels)[0].float()

    start = time.perf_counter()
    error = float((embed()[:1] - exact.embedding).norm() / exact.embedding.norm())
    report.add(f"sam_encoder_{name}_first_s", time.perf_counter() - start, "first call")
    report.add(f"sam_encoder_{name}_s", seconds(embed, device), f"s/image, {len(pixels)} crops", error)
