"""SAM's network: images become embeddings, points on them masks at the resolution of the network."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from functools import cached_property, lru_cache
from typing import Any

import torch
from jaxtyping import Float, Float32, Int32, UInt8
from torch import Tensor
from torch.nn.functional import interpolate, pad

from normlift_ns.core.gpu import kernels_apply
from normlift_ns.encoders.batches import Batches
from normlift_ns.encoders.sam.decoder import Answers, MaskDecoder
from normlift_ns.encoders.sam.resize import resize_bilinear
from normlift_ns.encoders.sam.rules import Measured, measured
from normlift_ns.encoders.sam.weights import load_sam
from normlift_ns.options import SamPrecision

_MEAN = torch.tensor([123.675, 116.28, 103.53])[:, None, None]
_STD = torch.tensor([58.395, 57.12, 57.375])[:, None, None]
_BATCHES = {"cuda": (5, 256, 64), "cpu": (1, 16, 16)}
"""Images, prompts and masks at a time."""
_DEFAULT: dict[str, SamPrecision] = {"cuda": "float16", "cpu": "float32"}


def resolve_precision(precision: SamPrecision, device: str) -> SamPrecision:
    """The precision of a network on a device, "auto" decided."""
    return _DEFAULT[torch.device(device).type] if precision == "auto" else precision


class PromptedNetwork(ABC):
    """A network that answers points on an image with three masks each, on a device and in one precision."""

    def __init__(self, model: Any, device: str, precision: SamPrecision = "auto") -> None:
        """
        Args:
            model: of transformers, in float32.
        """
        self._model = model.to(device)
        self._device = torch.device(device)
        self._dtype: torch.dtype = getattr(torch, resolve_precision(precision, device))
        self._side: int = model.config.prompt_encoder_config.image_size
        images, prompts, masks = _BATCHES["cuda" if self._device.type == "cuda" else "cpu"]
        self._images, self._prompts = Batches(images), Batches(prompts)
        self.masks = Batches(masks)
        """For what is done with masks at the size of the image."""

    @abstractmethod
    def pixels(self, images: Sequence[UInt8[Tensor, "h w 3"]]) -> Float[Tensor, "n 3 side side"]:
        """Images as the network takes them."""

    def embed(self, pixels: Float[Tensor, "n 3 side side"]) -> list[Any]:
        """What `prompt` needs to know of each image."""
        return [one for batch in self._images(lambda part: self._embed(part.to(self._device)), pixels) for one in batch]

    @abstractmethod
    def _embed(self, pixels: Tensor) -> list[Any]:
        """The same of images that fit into memory."""

    @abstractmethod
    def decode(self, embedding: Any, points: Float[Tensor, "b 2"]) -> Answers:
        """Logits and predicted IoU of the three masks of each point, (x, y) in pixels of the input."""

    def prompt(self, embedding: Any, points: Float[Tensor, "p 2"], size: tuple[int, int]) -> Iterator[Answers]:
        """Logits and predicted IoU of the three masks of each point, in batches of points.

        Args:
            points: (x, y) in pixels of the image.
            size: height and width of the image.
        """
        height, width = self._scaled(size)
        scaled = (points * torch.tensor([width / size[1], height / size[0]])).float().to(self._device)
        return self._prompts(lambda batch: self.decode(embedding, batch), scaled)

    def enlarge(self, logits: Float[Tensor, "n y x"], size: tuple[int, int]) -> Float[Tensor, "n h w"]:
        """Logits at the size of the image, in float32, bilinear: first to the size of the input, then, without its
        empty rest, to that of the image."""
        height, width = self._scaled(size)
        whole = interpolate(logits[:, None].float(), (self._side, self._side), mode="bilinear", align_corners=False)
        return interpolate(whole[:, :, :height, :width], size, mode="bilinear", align_corners=False)[:, 0]

    def measure(self, logits: Float[Tensor, "n y x"], size: tuple[int, int], offset: float) -> Measured:
        """What `measured` says of enlarged logits. Where Triton is, they are not made; then pixels whose logits are
        within rounding of a threshold may count otherwise."""
        if len(logits) > 0 and kernels_apply(logits):
            from normlift_ns.kernels.masks import measure_masks  # noqa: PLC0415 (only where Triton is)

            rows, columns = self._taps(logits.shape[1], size, 0), self._taps(logits.shape[2], size, 1)
            return Measured(*measure_masks(logits, *rows, *columns, offset))
        parts = [measured(logits.new_zeros(0, 1, 1), offset)]
        parts.extend(self.masks(lambda batch: measured(self.enlarge(batch, size), offset), logits))
        return Measured(*map(torch.cat, zip(*parts)))

    def _taps(self, count: int, size: tuple[int, int], axis: int) -> tuple[Tensor, Tensor]:
        first, weights = taps(count, self._side, self._scaled(size)[axis], size[axis])
        return first.to(self._device), weights.to(self._device)

    def _scaled(self, size: tuple[int, int]) -> tuple[int, int]:
        """Height and width that an image has in the input."""
        scale = self._side / max(size)
        return int(size[0] * scale + 0.5), int(size[1] * scale + 0.5)


class SamNetwork(PromptedNetwork):
    """The first SAM: products of matrices in the precision of the network, sums and normalisations in float32. In the
    mask decoder what belongs to prompts, not to positions of the image, is float32 in any case."""

    def __init__(self, model: Any, device: str, precision: SamPrecision = "auto") -> None:
        super().__init__(model, device, precision)
        self._decoder = MaskDecoder(self._model, self._dtype)

    @classmethod
    def load(cls, checkpoint: str, device: str, precision: SamPrecision = "auto") -> SamNetwork:
        """The network of a checkpoint; raises as `load_sam`."""
        return cls(load_sam(checkpoint), device, precision)

    def pixels(self, images: Sequence[UInt8[Tensor, "h w 3"]]) -> Float[Tensor, "n 3 side side"]:
        """Images as the network takes them: scaled so that the longer side fills the input, the rest of which is 0."""
        return torch.stack([self._pixels(image.to(self._device)) for image in images])

    def decode(self, embedding: Float[Tensor, "1 c y x"], points: Float[Tensor, "b 2"]) -> Answers:
        """Logits and predicted IoU of the three masks of each point, (x, y) in pixels of the input. What is too large
        for float16 is answered in float32."""
        masks, ious = self._decoder(embedding, points.to(self._device))
        if self._dtype == torch.float16 and not bool(ious.isfinite().all()):
            return self._exact(embedding, points.to(self._device))
        return masks, ious

    @cached_property
    def _exact(self) -> MaskDecoder:
        return MaskDecoder(self._model, torch.float32)

    def _pixels(self, image: Tensor) -> Tensor:
        height, width = self._scaled((image.shape[0], image.shape[1]))
        scaled = resize_bilinear(image, height, width).permute(2, 0, 1)
        pixels = (scaled - _MEAN.to(self._device)) / _STD.to(self._device)
        return pad(pixels, (0, self._side - width, 0, self._side - height))

    @torch.no_grad()
    def _embed(self, pixels: Tensor) -> list[Any]:
        with torch.autocast(self._device.type, self._dtype, enabled=self._dtype != torch.float32):
            return list(self._model.get_image_embeddings(pixels).float().split(1))


@lru_cache(maxsize=64)
def taps(count: int, side: int, scaled: int, size: int) -> tuple[Int32[Tensor, " n"], Float32[Tensor, "n 3"]]:
    """How `enlarge` makes the pixels along one axis of the image: of the logit first[i] and the two after it, with
    weights[i].

    Args:
        count: logits along the axis, at least 3.
        side: what they are enlarged to first, `scaled` of which are enlarged to `size`.
    """
    lines = torch.eye(count, dtype=torch.float64)[:, None]
    whole = interpolate(lines, side, mode="linear", align_corners=False)
    shares = interpolate(whole[:, :, :scaled], size, mode="linear", align_corners=False)[:, 0].T
    first = (shares != 0).int().argmax(dim=1).clamp(max=count - 3)
    return first.int(), shares.gather(1, first[:, None] + torch.arange(3)).float()
