"""Networks of the SAM family: images to embeddings, and points to masks at the resolution of the network."""

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
"""Images, prompts and masks per batch."""
_DEFAULT_PRECISION: dict[str, SamPrecision] = {"cuda": "float16", "cpu": "float32"}


def resolve_precision(precision: SamPrecision, device: str) -> SamPrecision:
    """Return the precision of a network on a device; "auto" becomes the default of the device."""
    return _DEFAULT_PRECISION[torch.device(device).type] if precision == "auto" else precision


class PromptedNetwork(ABC):
    """Network that turns each point on an image into three masks, on one device and in one precision."""

    def __init__(self, model: Any, device: str, precision: SamPrecision = "auto") -> None:
        """Move a model to a device.

        Args:
            model: Model of transformers, in float32.
            device: Device of the network.
            precision: Precision of the network.
        """
        self._model = model.to(device)
        self._device = torch.device(device)
        self._dtype: torch.dtype = getattr(torch, resolve_precision(precision, device))
        self._side: int = model.config.prompt_encoder_config.image_size
        images, prompts, masks = _BATCHES["cuda" if self._device.type == "cuda" else "cpu"]
        self._images, self._prompts = Batches(images), Batches(prompts)
        self.masks = Batches(masks)
        """Batches for operations on masks at the size of the image."""

    @abstractmethod
    def pixels(self, images: Sequence[UInt8[Tensor, "h w 3"]]) -> Float[Tensor, "n 3 side side"]:
        """Return images as network inputs."""

    def embed(self, pixels: Float[Tensor, "n 3 side side"]) -> list[Any]:
        """Return the embedding of each image, the input of `prompt`."""
        batches = self._images(lambda batch: self._embed(batch.to(self._device)), pixels)
        return [embedding for batch in batches for embedding in batch]

    @abstractmethod
    def _embed(self, pixels: Tensor) -> list[Any]:
        """Return the embeddings of images that fit into memory together."""

    @abstractmethod
    def decode(self, embedding: Any, points: Float[Tensor, "b 2"]) -> Answers:
        """Return logits and predicted IoU of the three masks of each point, (x, y) in pixels of the input."""

    def prompt(self, embedding: Any, points: Float[Tensor, "p 2"], size: tuple[int, int]) -> Iterator[Answers]:
        """Yield logits and predicted IoU of the three masks of each point, in batches of points.

        Args:
            embedding: One of the results of `embed`.
            points: (x, y) in pixels of the image.
            size: Height and width of the image.
        """
        height, width = self._input_size(size)
        scaled = (points * torch.tensor([width / size[1], height / size[0]])).float().to(self._device)
        return self._prompts(lambda batch: self.decode(embedding, batch), scaled)

    def enlarge(self, logits: Float[Tensor, "n y x"], size: tuple[int, int]) -> Float[Tensor, "n h w"]:
        """Return logits at the size of the image, in float32.

        They are resized bilinearly twice: to the input, then, without its padding, to the image.
        """
        height, width = self._input_size(size)
        padded = interpolate(logits[:, None].float(), (self._side, self._side), mode="bilinear", align_corners=False)
        return interpolate(padded[:, :, :height, :width], size, mode="bilinear", align_corners=False)[:, 0]

    def measure(self, logits: Float[Tensor, "n y x"], size: tuple[int, int], offset: float) -> Measured:
        """Return the measurements of `measured` for enlarged logits.

        With Triton, the logits are not enlarged in memory. Pixels whose logits are within rounding of a threshold may
        then be counted differently.
        """
        if len(logits) > 0 and kernels_apply(logits):
            from normlift_ns.kernels.masks import measure_masks  # noqa: PLC0415 (needs Triton)

            rows = self._bilinear_weights(logits.shape[1], size, 0)
            columns = self._bilinear_weights(logits.shape[2], size, 1)
            return Measured(*measure_masks(logits, *rows, *columns, offset))
        parts = [measured(logits.new_zeros(0, 1, 1), offset)]
        parts.extend(self.masks(lambda batch: measured(self.enlarge(batch, size), offset), logits))
        return Measured(*map(torch.cat, zip(*parts)))

    def _bilinear_weights(self, count: int, size: tuple[int, int], axis: int) -> tuple[Tensor, Tensor]:
        first, weights = taps(count, self._side, self._input_size(size)[axis], size[axis])
        return first.to(self._device), weights.to(self._device)

    def _input_size(self, size: tuple[int, int]) -> tuple[int, int]:
        """Return the height and width of an image in the input, without padding."""
        scale = self._side / max(size)
        return int(size[0] * scale + 0.5), int(size[1] * scale + 0.5)


class SamNetwork(PromptedNetwork):
    """The first SAM.

    Matrix products are in the precision of the network, sums and normalizations in float32. The prompt tokens of the
    mask decoder are always in float32.
    """

    def __init__(self, model: Any, device: str, precision: SamPrecision = "auto") -> None:
        super().__init__(model, device, precision)
        self._decoder = MaskDecoder(self._model, self._dtype)

    @classmethod
    def load(cls, checkpoint: str, device: str, precision: SamPrecision = "auto") -> SamNetwork:
        """Load the network of a checkpoint; raises like `load_sam`."""
        return cls(load_sam(checkpoint), device, precision)

    def pixels(self, images: Sequence[UInt8[Tensor, "h w 3"]]) -> Float[Tensor, "n 3 side side"]:
        """Return network inputs: each image is scaled until its longer side fills the input, and padded with 0."""
        return torch.stack([self._pixels(image.to(self._device)) for image in images])

    def decode(self, embedding: Float[Tensor, "1 c y x"], points: Float[Tensor, "b 2"]) -> Answers:
        """Return logits and predicted IoU of the three masks of each point, (x, y) in pixels of the input.

        Values too large for float16 are recomputed in float32.
        """
        masks, ious = self._decoder(embedding, points.to(self._device))
        if self._dtype == torch.float16 and not bool(ious.isfinite().all()):
            return self._float32_decoder(embedding, points.to(self._device))
        return masks, ious

    @cached_property
    def _float32_decoder(self) -> MaskDecoder:
        return MaskDecoder(self._model, torch.float32)

    def _pixels(self, image: Tensor) -> Tensor:
        height, width = self._input_size((image.shape[0], image.shape[1]))
        scaled = resize_bilinear(image, height, width).permute(2, 0, 1)
        pixels = (scaled - _MEAN.to(self._device)) / _STD.to(self._device)
        return pad(pixels, (0, self._side - width, 0, self._side - height))

    @torch.no_grad()
    def _embed(self, pixels: Tensor) -> list[Any]:
        with torch.autocast(self._device.type, self._dtype, enabled=self._dtype != torch.float32):
            return list(self._model.get_image_embeddings(pixels).float().split(1))


@lru_cache(maxsize=64)
def taps(count: int, side: int, scaled: int, size: int) -> tuple[Int32[Tensor, " n"], Float32[Tensor, "n 3"]]:
    """Return (first, weights) of the interpolation in `enlarge` along one axis of the image.

    Pixel i is the sum of the logits first[i] to first[i] + 2, weighted by weights[i].

    Args:
        count: Logits along the axis, at least 3.
        side: Size after the first interpolation.
        scaled: Samples without padding after the first interpolation.
        size: Pixels of the image along the axis.
    """
    identity = torch.eye(count, dtype=torch.float64)[:, None]
    padded = interpolate(identity, side, mode="linear", align_corners=False)
    weights = interpolate(padded[:, :, :scaled], size, mode="linear", align_corners=False)[:, 0].T
    first = (weights != 0).int().argmax(dim=1).clamp(max=count - 3)
    return first.int(), weights.gather(1, first[:, None] + torch.arange(3)).float()
