"""SAM 2, SAM 2.1 and HQ-SAM: transformers' models as they are, prompted as SAM is, so that the same rules apply."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from torch.nn.functional import interpolate

from normlift_ns.encoders.sam.decoder import Answers
from normlift_ns.encoders.sam.folders import import_transformers
from normlift_ns.encoders.sam.network import PromptedNetwork, SamNetwork, taps
from normlift_ns.encoders.sam.weights import load_model
from normlift_ns.options import SamPrecision


def load_network(checkpoint: str, device: str, precision: SamPrecision = "auto") -> PromptedNetwork:
    """The network of a checkpoint, of the kind that its config.json names; raises as `load_model`."""
    kind, model = load_model(checkpoint)
    networks = {"SAM": SamNetwork, "SAM 2": Sam2Network, "HQ-SAM": HqNetwork}
    return networks[kind.name](model, device, precision)


class _LibraryNetwork(PromptedNetwork):
    """A model of transformers behind its own image processor. In half precision it runs under autocast: products of
    matrices in half precision, normalisations and what torch deems delicate in float32."""

    def pixels(self, images: Sequence[UInt8[Tensor, "h w 3"]]) -> Float[Tensor, "n 3 side side"]:
        """Images as the network takes them, made by transformers' processor on the device."""
        channels_first = [image.to(self._device).permute(2, 0, 1) for image in images]
        return torch.cat([self._processor(one, return_tensors="pt")["pixel_values"] for one in channels_first])

    def decode(self, embedding: Any, points: Float[Tensor, "b 2"]) -> Answers:
        """As in `PromptedNetwork`. What is too large for float16 is answered in float32."""
        with torch.no_grad():
            with self._half():
                masks, ious = self._answer(embedding, points.to(self._device))
            if self._dtype == torch.float16 and not bool(ious.isfinite().all() and masks.isfinite().all()):
                masks, ious = self._answer(embedding, points.to(self._device))
        return masks, ious.float()

    def _answer(self, embedding: Any, points: Tensor) -> Answers:
        raise NotImplementedError

    @contextmanager
    def _half(self) -> Iterator[None]:
        with torch.autocast(self._device.type, self._dtype, enabled=self._dtype != torch.float32):
            yield

    _processor: Any


class Sam2Network(_LibraryNetwork):
    """SAM 2 and 2.1. Images are stretched to the square of the input; masks to the image in one step."""

    def __init__(self, model: Any, device: str, precision: SamPrecision = "auto") -> None:
        super().__init__(model, device, precision)
        side = {"height": self._side, "width": self._side}
        self._processor = import_transformers().Sam2ImageProcessor(size=side)

    def enlarge(self, logits: Float[Tensor, "n y x"], size: tuple[int, int]) -> Float[Tensor, "n h w"]:
        """Logits at the size of the image, in float32, bilinear."""
        return interpolate(logits[:, None].float(), size, mode="bilinear", align_corners=False)[:, 0]

    @torch.no_grad()
    def _embed(self, pixels: Tensor) -> list[Any]:
        with self._half():
            levels = self._model.get_image_embeddings(pixels)
        return [list(one) for one in zip(*(level.float().split(1) for level in levels))]

    def _answer(self, embedding: Any, points: Tensor) -> Answers:
        found = self._model(image_embeddings=embedding, **_prompts(points), multimask_output=True)
        return found.pred_masks[0], found.iou_scores[0]

    def _taps(self, count: int, size: tuple[int, int], axis: int) -> tuple[Tensor, Tensor]:
        first, weights = taps(count, count, count, size[axis])
        return first.to(self._device), weights.to(self._device)

    def _scaled(self, size: tuple[int, int]) -> tuple[int, int]:
        return self._side, self._side


class HqNetwork(_LibraryNetwork):
    """HQ-SAM: the three masks of SAM's decoder, each with the correction of the high-quality token added."""

    def __init__(self, model: Any, device: str, precision: SamPrecision = "auto") -> None:
        super().__init__(model, device, precision)
        square = {"height": self._side, "width": self._side}
        self._processor = import_transformers().SamImageProcessor(size={"longest_edge": self._side}, pad_size=square)

    @torch.no_grad()
    def _embed(self, pixels: Tensor) -> list[Any]:
        with self._half():
            last, early = self._model.get_image_embeddings(pixels)
        return list(zip(last.float().split(1), early[0].float().split(1)))

    def _answer(self, embedding: Any, points: Tensor) -> Answers:
        """transformers sorts the three masks by predicted IoU; levels need them in the order of the decoder."""
        seen: list[Tensor] = []
        head = self._model.mask_decoder.iou_prediction_head
        hook = head.register_forward_hook(lambda module, given, ious: seen.append(ious))
        try:
            last, early = embedding
            found = self._model(
                image_embeddings=last, intermediate_embeddings=[early], **_prompts(points), multimask_output=True
            )
        finally:
            hook.remove()
        place = torch.sort(seen[0][:, :, 1:], dim=2, descending=True).indices[0]  # as transformers sorts
        masks, ious = torch.empty_like(found.pred_masks[0]), torch.empty_like(found.iou_scores[0])
        row = torch.arange(len(points), device=place.device)[:, None]
        masks[row, place], ious[row, place] = found.pred_masks[0], found.iou_scores[0]
        return masks, ious


def _prompts(points: Tensor) -> dict[str, Tensor]:
    """Single points, each a prompt of its own, as transformers takes them."""
    labels = torch.ones(1, len(points), 1, dtype=torch.int32, device=points.device)
    return {"input_points": points[None, :, None], "input_labels": labels}
