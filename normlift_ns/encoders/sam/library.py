"""SAM 2, SAM 2.1 and HQ-SAM: unchanged models of transformers, prompted like SAM and filtered by the same rules."""

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
    """Return the network of a checkpoint, as its config.json names it; raises like `load_model`."""
    kind, model = load_model(checkpoint)
    networks = {"SAM": SamNetwork, "SAM 2": Sam2Network, "HQ-SAM": HqNetwork}
    return networks[kind.name](model, device, precision)


class _LibraryNetwork(PromptedNetwork):
    """Model of transformers behind its own image processor.

    In half precision it runs under autocast: matrix products in half precision, normalizations and other operations
    that autocast protects in float32.
    """

    def pixels(self, images: Sequence[UInt8[Tensor, "h w 3"]]) -> Float[Tensor, "n 3 side side"]:
        """Return network inputs, prepared by the image processor of transformers on the device."""
        channels_first = [image.to(self._device).permute(2, 0, 1) for image in images]
        return torch.cat([self._processor(one, return_tensors="pt")["pixel_values"] for one in channels_first])

    def decode(self, embedding: Any, points: Float[Tensor, "b 2"]) -> Answers:
        """Decode points as in `PromptedNetwork`; values too large for float16 are recomputed in float32."""
        with torch.no_grad():
            with self._autocast():
                masks, ious = self._predict(embedding, points.to(self._device))
            if self._dtype == torch.float16 and not bool(ious.isfinite().all() and masks.isfinite().all()):
                masks, ious = self._predict(embedding, points.to(self._device))
        return masks, ious.float()

    def _predict(self, embedding: Any, points: Tensor) -> Answers:
        raise NotImplementedError

    @contextmanager
    def _autocast(self) -> Iterator[None]:
        with torch.autocast(self._device.type, self._dtype, enabled=self._dtype != torch.float32):
            yield

    _processor: Any


class Sam2Network(_LibraryNetwork):
    """SAM 2 and 2.1. Images are stretched to the square input; masks are resized to the image in one step."""

    def __init__(self, model: Any, device: str, precision: SamPrecision = "auto") -> None:
        super().__init__(model, device, precision)
        side = {"height": self._side, "width": self._side}
        self._processor = import_transformers().Sam2ImageProcessor(size=side)

    def enlarge(self, logits: Float[Tensor, "n y x"], size: tuple[int, int]) -> Float[Tensor, "n h w"]:
        """Return logits at the size of the image, in float32, resized bilinearly."""
        return interpolate(logits[:, None].float(), size, mode="bilinear", align_corners=False)[:, 0]

    @torch.no_grad()
    def _embed(self, pixels: Tensor) -> list[Any]:
        with self._autocast():
            levels = self._model.get_image_embeddings(pixels)
        return [list(one) for one in zip(*(level.float().split(1) for level in levels))]

    def _predict(self, embedding: Any, points: Tensor) -> Answers:
        output = self._model(image_embeddings=embedding, **_prompts(points), multimask_output=True)
        return output.pred_masks[0], output.iou_scores[0]

    def _bilinear_weights(self, count: int, size: tuple[int, int], axis: int) -> tuple[Tensor, Tensor]:
        first, weights = taps(count, count, count, size[axis])
        return first.to(self._device), weights.to(self._device)

    def _input_size(self, size: tuple[int, int]) -> tuple[int, int]:
        return self._side, self._side


class HqNetwork(_LibraryNetwork):
    """HQ-SAM. Adds the correction of the high-quality token to each of the three masks of SAM's decoder."""

    def __init__(self, model: Any, device: str, precision: SamPrecision = "auto") -> None:
        super().__init__(model, device, precision)
        square = {"height": self._side, "width": self._side}
        self._processor = import_transformers().SamImageProcessor(size={"longest_edge": self._side}, pad_size=square)

    @torch.no_grad()
    def _embed(self, pixels: Tensor) -> list[Any]:
        with self._autocast():
            last, early = self._model.get_image_embeddings(pixels)
        return list(zip(last.float().split(1), early[0].float().split(1)))

    def _predict(self, embedding: Any, points: Tensor) -> Answers:
        """Restore the order of the decoder, which levels need: transformers sorts the three masks by predicted IoU."""
        predicted: list[Tensor] = []
        head = self._model.mask_decoder.iou_prediction_head
        hook = head.register_forward_hook(lambda module, args, ious: predicted.append(ious))
        try:
            last, early = embedding
            output = self._model(
                image_embeddings=last, intermediate_embeddings=[early], **_prompts(points), multimask_output=True
            )
        finally:
            hook.remove()
        order = torch.sort(predicted[0][:, :, 1:], dim=2, descending=True).indices[0]  # as transformers sorts
        masks, ious = torch.empty_like(output.pred_masks[0]), torch.empty_like(output.iou_scores[0])
        row = torch.arange(len(points), device=order.device)[:, None]
        masks[row, order], ious[row, order] = output.pred_masks[0], output.iou_scores[0]
        return masks, ious


def _prompts(points: Tensor) -> dict[str, Tensor]:
    """Return the prompt arguments of transformers for single points, each a prompt of its own."""
    labels = torch.ones(1, len(points), 1, dtype=torch.int32, device=points.device)
    return {"input_points": points[None, :, None], "input_labels": labels}
