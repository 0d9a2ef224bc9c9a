"""SAM's network: images become embeddings, points on them masks at the resolution of the network."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image
from torch import Tensor
from torch.nn.functional import interpolate, pad

from normlift_ns.encoders.batches import Batches
from normlift_ns.encoders.sam.weights import load_sam

_MEAN = torch.tensor([123.675, 116.28, 103.53])[:, None, None]
_STD = torch.tensor([58.395, 57.12, 57.375])[:, None, None]
_BATCHES = {"cuda": (5, 256, 64), "cpu": (1, 16, 16)}
"""Images, prompts and masks at a time."""


class SamNetwork:
    """A SAM on a device. On a GPU the image encoder runs in half precision, the mask decoder in float32."""

    def __init__(self, model: Any, device: str) -> None:
        self._model = model.to(device)
        self._device = torch.device(device)
        self._side: int = model.config.vision_config.image_size
        images, prompts, masks = _BATCHES["cuda" if self._device.type == "cuda" else "cpu"]
        self._images, self._prompts = Batches(images), Batches(prompts)
        self.masks = Batches(masks)
        """For what is done with masks at the size of the image."""

    @classmethod
    def load(cls, checkpoint: str, device: str) -> SamNetwork:
        """The network of a checkpoint; raises as `load_sam`."""
        return cls(load_sam(checkpoint), device)

    def pixels(self, images: Sequence[UInt8[Tensor, "h w 3"]]) -> Float[Tensor, "n 3 side side"]:
        """Images as the network takes them: scaled so that the longer side fills the input, the rest of which is 0."""
        return torch.stack([self._pixels(image) for image in images])

    def embed(self, pixels: Float[Tensor, "n 3 side side"]) -> list[Float[Tensor, "1 c y x"]]:
        """Embeddings of images."""
        batches = self._images(lambda batch: self._embed(batch.to(self._device)), pixels)
        return list(torch.cat(list(batches)).split(1))

    def prompt(
        self, embedding: Float[Tensor, "1 c y x"], points: Float[Tensor, "p 2"], size: tuple[int, int]
    ) -> Iterator[tuple[Float[Tensor, "b 3 y x"], Float[Tensor, "b 3"]]]:
        """Logits and predicted IoU of the three masks of each point, in batches of points.

        Args:
            points: (x, y) in pixels of the image.
            size: height and width of the image.
        """
        height, width = self._scaled(size)
        scaled = (points * torch.tensor([width / size[1], height / size[0]])).float()
        return self._prompts(lambda batch: self.decode(embedding, batch), scaled)

    def enlarge(self, logits: Float[Tensor, "n y x"], size: tuple[int, int]) -> Float[Tensor, "n h w"]:
        """Logits at the size of the image, bilinear: first to the size of the input, then, without its empty rest, to
        that of the image."""
        height, width = self._scaled(size)
        whole = interpolate(logits[:, None], (self._side, self._side), mode="bilinear", align_corners=False)
        return interpolate(whole[:, :, :height, :width], size, mode="bilinear", align_corners=False)[:, 0]

    def _scaled(self, size: tuple[int, int]) -> tuple[int, int]:
        scale = self._side / max(size)
        return int(size[0] * scale + 0.5), int(size[1] * scale + 0.5)

    def _pixels(self, image: Tensor) -> Tensor:
        height, width = self._scaled((image.shape[0], image.shape[1]))
        scaled = Image.fromarray(image.numpy()).resize((width, height), Image.Resampling.BILINEAR)
        pixels = (torch.from_numpy(np.array(scaled)).permute(2, 0, 1) - _MEAN) / _STD
        return pad(pixels, (0, self._side - width, 0, self._side - height))

    @torch.no_grad()
    def _embed(self, pixels: Tensor) -> Tensor:
        with torch.autocast("cuda", torch.float16, enabled=self._device.type == "cuda"):
            return self._model.get_image_embeddings(pixels).float()

    @torch.no_grad()
    def decode(
        self, embedding: Float[Tensor, "1 c y x"], points: Float[Tensor, "b 2"]
    ) -> tuple[Float[Tensor, "b 3 y x"], Float[Tensor, "b 3"]]:
        """Logits and predicted IoU of the three masks of each point, (x, y) in pixels of the input."""
        points = points.to(self._device)[None, :, None]
        found = self._model(image_embeddings=embedding, input_points=points, multimask_output=True)
        return found.pred_masks[0], found.iou_scores[0]
