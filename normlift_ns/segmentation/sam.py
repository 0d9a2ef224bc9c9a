"""Automatic masks of SAM, SAM 2, SAM 2.1 and HQ-SAM.

`resize_bilinear` resizes images like Pillow, first along rows and then along columns, with weights of 22 bits and sums
rounded to 8 bits. This integer arithmetic below 2^31 gives the same result on all devices. If an image is reduced in
height, Pillow 13 can start with the columns to save work. Pixel values then differ by at most one.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property, lru_cache, partial
from itertools import product
from threading import Lock
from typing import Any, Literal, NamedTuple, get_args

import torch
from jaxtyping import Bool, Float, Float32, Int32, Int64, UInt8
from torch import Tensor
from torch.nn.functional import gelu, interpolate, layer_norm, linear, pad, scaled_dot_product_attention

from normlift_ns.core.device import AdaptiveBatches, can_use_triton, shared_property
from normlift_ns.options import DEFAULT_SAM, SamPrecision
from normlift_ns.segmentation import mask_filtering
from normlift_ns.segmentation.checkpoint import (
    check_sam_checkpoint,
    import_transformers,
    load_sam_checkpoint,
    resolve_precision,
    sam_identity,
)
from normlift_ns.segmentation.regions import RegionDefaults, stack_masks

_BITS = 22
_network_lock = Lock()


def resize_bilinear(image: UInt8[Tensor, "h w c"], height: int, width: int) -> UInt8[Tensor, "height width c"]:
    """Resize an image like Pillow's Image.resize with Resampling.BILINEAR."""
    resized = _resize_axis(1, image, width) if width != image.shape[1] else image
    return _resize_axis(0, resized, height) if height != image.shape[0] else resized


def _resize_axis(axis: int, image: Tensor, size: int) -> Tensor:
    first, weights = (x.to(image.device) for x in _pillow_weights(image.shape[axis], size))
    shape = [1, 1, 1]
    shape[axis] = size
    total = torch.full((), 1 << (_BITS - 1), dtype=torch.int32, device=image.device)
    for tap, weight in enumerate(weights):
        index = (first + tap).clamp(max=image.shape[axis] - 1)  # the weight is 0 past the last pixel
        total = total + image.index_select(axis, index).int() * weight.view(shape)
    return (total >> _BITS).to(torch.uint8)


@lru_cache(maxsize=64)
def _pillow_weights(size: int, new_size: int) -> tuple[Int64[Tensor, " n"], Int32[Tensor, "taps n"]]:
    """Return the first source pixel of each sample, and the weights of this pixel and the following ones."""
    scale = size / new_size
    support = max(scale, 1.0)
    center = (torch.arange(new_size, dtype=torch.float64) + 0.5) * scale
    first = (center - support + 0.5).long().clamp(min=0)
    last = (center + support + 0.5).long().clamp(max=size)
    index = first + torch.arange(2 * math.ceil(support) + 1)[:, None]
    weights = (1 - ((index - center + 0.5) * (1.0 / support)).abs()).clamp(min=0) * (index < last)
    total = torch.zeros_like(center)
    for tap in weights:  # in the order of Pillow, for the same rounding
        total = total + tap
    return first, (0.5 + weights / total * (1 << _BITS)).int()


# SAM's mask decoder for many single points on one image, with the weights of the modules of transformers.
#
# The decoder computes the same function as transformers with less work. Tokens (seven per point) stay in float32. Image
# positions (thousands per point) have the precision of the decoder.
#
# * All points share the embedding of the image until a layer has attended to the tokens, so it is not copied per point.
# * Attention between tokens and image does not project the image. q . (W_k x) equals (W_k^T q) . x, and the mean of
#   W_v x equals W_v times the mean of x. The matrices of each head are therefore applied to the tokens. Each position
#   needs only two products with 56 columns, one column per token and head. The bias of the keys is the same for all
#   positions and cancels.
# * Transposed 2 x 2 convolutions with stride 2 are matrix products. Pixels are reordered only once, at the end, when
#   they consist of three logits each.
# * The first of the four masks of a point is intended for several prompts, and is not computed.


MaskPredictions = tuple[Float[Tensor, "p 3 y x"], Float[Tensor, "p 3"]]
"""Logits and predicted IoU of the three masks of each point."""


class MaskDecoder:
    """The mask decoder of a SAM model, on the device of the model."""

    def __init__(self, model: Any, dtype: torch.dtype) -> None:
        """Prepare the decoder of a model.

        Args:
            model: SamModel of transformers.
            dtype: Precision of the image in the decoder and of the logits.
        """
        self._model, self._dtype = model, dtype
        self._positions = model.get_image_wide_positional_embeddings().detach().flatten(2)[0].T.contiguous()
        self._upscaling = _load_upscaling(model, dtype)
        self._norms = [_Norm.from_module(layer.layer_norm4, dtype) for layer in model.mask_decoder.transformer.layers]

    @torch.no_grad()
    def __call__(self, embedding: Float[Tensor, "1 c y x"], points: Float[Tensor, "p 2"]) -> MaskPredictions:
        """Return logits and predicted IoU of the masks of points (x, y), in pixels of the network input."""
        labels = torch.ones(1, len(points), 1, dtype=torch.int32, device=points.device)
        prompts, dense = self._model.get_prompt_embeddings(input_points=points[None, :, None], input_labels=labels)
        image = (embedding + dense).flatten(2)[0].T
        return self._decode(image.to(self._dtype), (image + self._positions).to(self._dtype), prompts[0])

    def _decode(self, image: Tensor, positioned: Tensor, prompts: Tensor) -> MaskPredictions:
        """Decode the masks of prompts on an image.

        Args:
            image: Embedding of the image, one row per position, [N, C].
            positioned: The same embedding plus position embeddings, [N, C].
            prompts: Two tokens per point, [P, 2, C].
        """
        decoder = self._model.mask_decoder
        positions = self._positions.to(self._dtype)
        output_tokens = torch.cat([decoder.iou_token.weight, decoder.mask_tokens.weight])
        initial_tokens = torch.cat([output_tokens.expand(len(prompts), -1, -1), prompts], dim=1)
        tokens, keys, first_layer = initial_tokens, image, True
        for layer, norm in zip(decoder.transformer.layers, self._norms):
            if first_layer:
                tokens = _self_attention(layer.self_attn, tokens, tokens)
            else:
                tokens = tokens + _self_attention(layer.self_attn, tokens + initial_tokens, tokens)
            tokens = layer.layer_norm1(tokens)
            scores = _image_scores(positioned if first_layer else keys, None if first_layer else positions)
            to_image = _attend_to_image(layer.cross_attn_token_to_image, tokens + initial_tokens, keys, scores)
            tokens = layer.layer_norm2(tokens + to_image)
            tokens = layer.layer_norm3(tokens + layer.mlp(tokens))
            keys = norm(
                _attend_to_tokens(layer.cross_attn_image_to_token, tokens + initial_tokens, tokens, keys, scores)
            )
            first_layer = False
        final = decoder.transformer
        to_image = _attend_to_image(
            final.final_attn_token_to_image, tokens + initial_tokens, keys, _image_scores(keys, positions)
        )
        tokens = final.layer_norm_final_attn(tokens + to_image)
        mlps = list(decoder.output_hypernetworks_mlps)[1:]
        mask_channels = torch.stack([mlp(tokens[:, 2 + i]) for i, mlp in enumerate(mlps)], dim=1)
        ious = decoder.iou_prediction_head(tokens[:, 0])[:, 1:]
        return self._upscaling(keys, mask_channels.to(self._dtype)), ious


def _self_attention(attention: Any, positioned: Tensor, tokens: Tensor) -> Tensor:
    """Return the self-attention of tokens [P, T, C], in the precision of the tokens."""
    query, key, value = attention.q_proj(positioned), attention.k_proj(positioned), attention.v_proj(tokens)
    heads = (x.unflatten(2, (attention.num_attention_heads, -1)).transpose(1, 2) for x in (query, key, value))
    return attention.out_proj(scaled_dot_product_attention(*heads).transpose(1, 2).flatten(2))


def _heads(attention: Any, projected: Tensor) -> Tensor:
    """Split projected tokens into heads, [P, T, H, d]."""
    return projected.unflatten(2, (attention.num_attention_heads, -1))


def _per_head(attention: Any, projection: Any) -> Tensor:
    """Return the matrices of a projection for each head, [H, d, C]."""
    return projection.weight.unflatten(0, (attention.num_attention_heads, -1))


def _image_scores(keys: Tensor, positions: Tensor | None) -> Callable[[Tensor], Tensor]:
    """Return a function that computes the products [P, K, N] of vectors [P, K, C] with the image and its positions.

    Args:
        keys: Embedding of the image, [N, C] or [P, N, C].
        positions: Position embeddings [N, C], or None if `keys` includes them.
    """

    def multiply(directions: Tensor) -> Tensor:
        if positions is None:
            return directions @ keys.transpose(-1, -2)
        return torch.baddbmm(directions @ positions.T, directions, keys.transpose(-1, -2))

    return multiply


def _attend_to_image(attention: Any, tokens: Tensor, keys: Tensor, scores: Callable[[Tensor], Tensor]) -> Tensor:
    """Return the attention of tokens to the image, [P, T, C]. Keys are [N, C] or [P, N, C]."""
    query = _heads(attention, attention.q_proj(tokens))
    scale = query.shape[-1] ** -0.5
    directions = torch.einsum("pthd,hdc->pthc", query * scale, _per_head(attention, attention.k_proj))
    weights = scores(directions.flatten(1, 2).to(keys.dtype)).softmax(dim=-1)
    mean = (weights @ keys).to(tokens.dtype).unflatten(1, query.shape[1:3])
    value = torch.einsum("pthc,hdc->pthd", mean, _per_head(attention, attention.v_proj)).flatten(2)
    return attention.out_proj(value + attention.v_proj.bias)


def _attend_to_tokens(
    attention: Any, positioned: Tensor, tokens: Tensor, keys: Tensor, scores: Callable[[Tensor], Tensor]
) -> Tensor:
    """Return the image plus its attention to the tokens, [P, N, C]."""
    key, value = _heads(attention, attention.k_proj(positioned)), _heads(attention, attention.v_proj(tokens))
    heads, scale = key.shape[2], key.shape[3] ** -0.5
    directions = torch.einsum("pthd,hdc->phtc", key * scale, _per_head(attention, attention.q_proj))
    bias = torch.einsum("pthd,hd->pht", key * scale, attention.q_proj.bias.unflatten(0, (heads, -1)))
    raw = scores(directions.flatten(1, 2).to(keys.dtype)) + bias.flatten(1)[:, :, None].to(keys.dtype)
    weights = raw.unflatten(1, bias.shape[1:]).softmax(dim=2).flatten(1, 2)
    out = attention.out_proj
    rows = torch.einsum("pthd,chd->phtc", value, out.weight.unflatten(1, (heads, -1))) + out.bias / heads
    image = keys.expand(len(rows), *keys.shape[-2:])
    return torch.baddbmm(image, weights.transpose(1, 2), rows.flatten(1, 2).to(keys.dtype))


class _Norm(NamedTuple):
    """A layer norm over the last axis."""

    weight: Tensor
    bias: Tensor
    eps: float

    @classmethod
    def from_module(cls, norm: Any, dtype: torch.dtype) -> _Norm:
        return cls(norm.weight.detach().to(dtype), norm.bias.detach().to(dtype), norm.eps)

    def __call__(self, values: Tensor) -> Tensor:
        return layer_norm(values, self.weight.shape, self.weight, self.bias, self.eps)


class _Upscaling(NamedTuple):
    """Two transposed convolutions, with a layer norm between them and an activation after each."""

    side: int
    """Side of the image embedding, in positions."""
    weights: tuple[Tensor, Tensor]
    """Matrices [4 O, C], which map a position with C channels to 2 x 2 positions with O channels in row-major order."""
    biases: tuple[Tensor, Tensor]
    """Bias [O] of each convolution."""
    norm: _Norm

    def __call__(self, keys: Float[Tensor, "p n c"], mask_channels: Float[Tensor, "p m o"]) -> Float[Tensor, "p m y x"]:
        """Return logits, the scalar products of the upscaled channels of each pixel with the channels of each mask."""
        if can_use_triton(keys) and keys.dtype != torch.float32:
            from normlift_ns.kernels.sam import upscale_masks  # noqa: PLC0415 (needs Triton)

            return upscale_masks(keys, self.weights, self.biases, self.norm, mask_channels, self.side)
        pixels = gelu(self.norm(self._grow(0, keys)))  # [P, N, 4, O]
        pixels = gelu(self._grow(1, pixels))  # [P, N, 4, 4, O]
        logits = mask_channels @ pixels.flatten(1, 3).transpose(1, 2)
        blocks = logits.unflatten(2, (self.side, -1, 2, 2, 2, 2))  # y x, then twice: upper or lower, left or right
        return blocks.permute(0, 1, 2, 4, 6, 3, 5, 7).flatten(5, 7).flatten(2, 4)

    def _grow(self, step: int, pixels: Tensor) -> Tensor:
        return linear(pixels, self.weights[step], self.biases[step].repeat(4)).unflatten(-1, (4, -1))


def _load_upscaling(model: Any, dtype: torch.dtype) -> _Upscaling:
    decoder, side = model.mask_decoder, model.config.prompt_encoder_config.image_embedding_size
    steps = decoder.upscale_conv1, decoder.upscale_conv2
    first, second = (step.weight.detach().permute(2, 3, 1, 0).flatten(0, 2).to(dtype).contiguous() for step in steps)
    biases = steps[0].bias.detach().to(dtype), steps[1].bias.detach().to(dtype)
    return _Upscaling(side, (first, second), biases, _Norm.from_module(decoder.upscale_layer_norm, dtype))


# Networks of the SAM family, which map images to embeddings, and points to masks at the resolution of the network.


_MEAN = torch.tensor([123.675, 116.28, 103.53])[:, None, None]
_STD = torch.tensor([58.395, 57.12, 57.375])[:, None, None]
_BATCHES = {"cuda": (5, 256, 64), "cpu": (1, 16, 16)}
"""Maximum numbers of images, prompts and masks per batch, by device type."""


class PromptedNetwork(ABC):
    """A network that predicts three masks for each point on an image, on one device and in one precision."""

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
        self._images, self._prompts = AdaptiveBatches(images), AdaptiveBatches(prompts)
        self.masks = AdaptiveBatches(masks)
        """Batches for operations on masks at the size of the image."""

    @abstractmethod
    def pixels(self, images: Sequence[UInt8[Tensor, "h w 3"]]) -> Float[Tensor, "n 3 side side"]:
        """Convert images to network inputs."""

    def embed(self, pixels: Float[Tensor, "n 3 side side"]) -> list[Any]:
        """Return the embedding of each image for `prompt`."""
        with torch.no_grad(), self._autocast():
            batches = self._images(lambda batch: self._embed(batch.to(self._device)), pixels)
            return [embedding for batch in batches for embedding in batch]

    @abstractmethod
    def _embed(self, pixels: Tensor) -> list[Any]:
        """Return the embeddings of one batch of network inputs on the device."""

    @abstractmethod
    def decode(self, embedding: Any, points: Float[Tensor, "b 2"]) -> MaskPredictions:
        """Return logits and predicted IoU of the three masks of each point (x, y), in pixels of the network input."""

    def prompt(self, embedding: Any, points: Float[Tensor, "p 2"], size: tuple[int, int]) -> Iterator[MaskPredictions]:
        """Yield logits and predicted IoU of the three masks of each point, in batches of points.

        Args:
            embedding: Embedding of the image from `embed`.
            points: Points (x, y), in pixels of the image.
            size: Height and width of the image.
        """
        height, width = self._input_size(size)
        scaled = (points * torch.tensor([width / size[1], height / size[0]])).float().to(self._device)
        return self._prompts(lambda batch: self.decode(embedding, batch), scaled)

    def enlarge(self, logits: Float[Tensor, "n y x"], size: tuple[int, int]) -> Float[Tensor, "n h w"]:
        """Resize logits to the size of the image, in float32.

        They are resized bilinearly twice, first to the network input, and then, without its padding, to the image.
        """
        height, width = self._input_size(size)
        padded = interpolate(logits[:, None].float(), (self._side, self._side), mode="bilinear", align_corners=False)
        return interpolate(padded[:, :, :height, :width], size, mode="bilinear", align_corners=False)[:, 0]

    def measure(
        self, logits: Float[Tensor, "n y x"], size: tuple[int, int], offset: float
    ) -> mask_filtering.MaskMeasurements:
        """Return the measurements of `measure_logits` for enlarged logits.

        With Triton, the logits are not enlarged in memory. Pixels whose logit equals a threshold up to rounding can
        then be counted differently.
        """
        if len(logits) > 0 and can_use_triton(logits):
            from normlift_ns.kernels.sam import measure_masks  # noqa: PLC0415 (needs Triton)

            rows = self._bilinear_weights(logits.shape[1], size, 0)
            columns = self._bilinear_weights(logits.shape[2], size, 1)
            return mask_filtering.MaskMeasurements(*measure_masks(logits, *rows, *columns, offset))
        parts = [mask_filtering.measure_logits(logits.new_zeros(0, 1, 1), offset)]
        parts.extend(self.masks(lambda batch: mask_filtering.measure_logits(self.enlarge(batch, size), offset), logits))
        return mask_filtering.MaskMeasurements(*map(torch.cat, zip(*parts)))

    def _autocast(self) -> torch.autocast:
        return torch.autocast(self._device.type, self._dtype, enabled=self._dtype != torch.float32)

    def _bilinear_weights(self, count: int, size: tuple[int, int], axis: int) -> tuple[Tensor, Tensor]:
        first, weights = bilinear_weights(count, self._side, self._input_size(size)[axis], size[axis])
        return first.to(self._device), weights.to(self._device)

    def _input_size(self, size: tuple[int, int]) -> tuple[int, int]:
        """Return the height and width of an image in the network input, without padding."""
        scale = self._side / max(size)
        return int(size[0] * scale + 0.5), int(size[1] * scale + 0.5)


class SamNetwork(PromptedNetwork):
    """The original SAM network.

    In half precision, the image encoder uses autocast. In the mask decoder, image positions have the precision of the
    network, and tokens stay in float32.
    """

    def __init__(self, model: Any, device: str, precision: SamPrecision = "auto") -> None:
        super().__init__(model, device, precision)
        self._decoder = MaskDecoder(self._model, self._dtype)

    def pixels(self, images: Sequence[UInt8[Tensor, "h w 3"]]) -> Float[Tensor, "n 3 side side"]:
        """Convert images to network inputs, with the longer side scaled to the input and zeros as padding."""
        return torch.stack([self._pixels(image.to(self._device)) for image in images])

    def decode(self, embedding: Float[Tensor, "1 c y x"], points: Float[Tensor, "b 2"]) -> MaskPredictions:
        """Return logits and predicted IoU of the three masks of each point (x, y), in pixels of the network input.

        If a predicted IoU overflows in float16, the points are decoded again in float32.
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

    def _embed(self, pixels: Tensor) -> list[Any]:
        return list(self._model.get_image_embeddings(pixels).float().split(1))


@lru_cache(maxsize=64)
def bilinear_weights(
    count: int, side: int, scaled: int, size: int
) -> tuple[Int32[Tensor, " n"], Float32[Tensor, "n 3"]]:
    """Return the indices `first` and the weights of the interpolation in `enlarge` along one axis of the image.

    Pixel i is the sum of the logits first[i] to first[i] + 2, weighted by weights[i].

    Args:
        count: Number of logits along the axis, at least 3.
        side: Number of samples after the first interpolation.
        scaled: Number of samples after the first interpolation, without padding.
        size: Number of pixels of the image along the axis.
    """
    identity = torch.eye(count, dtype=torch.float64)[:, None]
    padded = interpolate(identity, side, mode="linear", align_corners=False)
    weights = interpolate(padded[:, :, :scaled], size, mode="linear", align_corners=False)[:, 0].T
    first = (weights != 0).int().argmax(dim=1).clamp(max=count - 3)
    return first.int(), weights.gather(1, first[:, None] + torch.arange(3)).float()


# SAM 2, SAM 2.1 and HQ-SAM, which are unchanged models of transformers with the same prompts and filters as SAM.


def load_sam_network(checkpoint: str, device: str, precision: SamPrecision = "auto") -> PromptedNetwork:
    """Load the network of a checkpoint. Raises the same errors as `load_sam_checkpoint`."""
    kind, model = load_sam_checkpoint(checkpoint)
    networks = {"SAM": SamNetwork, "SAM 2": Sam2Network, "HQ-SAM": HqSamNetwork}
    return networks[kind.name](model, device, precision)


class _LibraryNetwork(PromptedNetwork):
    """A model of transformers with its own image processor.

    Half precision uses autocast, which runs matrix products in half precision, and normalizations and some other
    operations in float32.
    """

    def pixels(self, images: Sequence[UInt8[Tensor, "h w 3"]]) -> Float[Tensor, "n 3 side side"]:
        """Convert images to network inputs with the image processor of transformers, on the device."""
        channels_first = [image.to(self._device).permute(2, 0, 1) for image in images]
        return torch.cat([self._processor(one, return_tensors="pt")["pixel_values"] for one in channels_first])

    def decode(self, embedding: Any, points: Float[Tensor, "b 2"]) -> MaskPredictions:
        """Decode points as in `PromptedNetwork`. If values overflow in float16, they are recomputed in float32."""
        with torch.no_grad():
            with self._autocast():
                masks, ious = self._predict(embedding, points.to(self._device))
            if self._dtype == torch.float16 and not bool(ious.isfinite().all() and masks.isfinite().all()):
                masks, ious = self._predict(embedding, points.to(self._device))
        return masks, ious.float()

    def _predict(self, embedding: Any, points: Tensor) -> MaskPredictions:
        raise NotImplementedError

    _processor: Any


class Sam2Network(_LibraryNetwork):
    """A SAM 2 or SAM 2.1 network. It stretches images to its square input, and resizes masks in one step."""

    def __init__(self, model: Any, device: str, precision: SamPrecision = "auto") -> None:
        super().__init__(model, device, precision)
        side = {"height": self._side, "width": self._side}
        self._processor = import_transformers().Sam2ImageProcessor(size=side)

    def enlarge(self, logits: Float[Tensor, "n y x"], size: tuple[int, int]) -> Float[Tensor, "n h w"]:
        """Resize logits bilinearly to the size of the image, in float32."""
        return interpolate(logits[:, None].float(), size, mode="bilinear", align_corners=False)[:, 0]

    def _embed(self, pixels: Tensor) -> list[Any]:
        levels = self._model.get_image_embeddings(pixels)
        return [list(one) for one in zip(*(level.float().split(1) for level in levels))]

    def _predict(self, embedding: Any, points: Tensor) -> MaskPredictions:
        output = self._model(image_embeddings=embedding, **_prompts(points), multimask_output=True)
        return output.pred_masks[0], output.iou_scores[0]

    def _bilinear_weights(self, count: int, size: tuple[int, int], axis: int) -> tuple[Tensor, Tensor]:
        first, weights = bilinear_weights(count, count, count, size[axis])
        return first.to(self._device), weights.to(self._device)

    def _input_size(self, size: tuple[int, int]) -> tuple[int, int]:
        return self._side, self._side


class HqSamNetwork(_LibraryNetwork):
    """An HQ-SAM network. It adds the correction of the high-quality token to each of the three masks of SAM."""

    def __init__(self, model: Any, device: str, precision: SamPrecision = "auto") -> None:
        super().__init__(model, device, precision)
        square = {"height": self._side, "width": self._side}
        self._processor = import_transformers().SamImageProcessor(size={"longest_edge": self._side}, pad_size=square)

    def _embed(self, pixels: Tensor) -> list[Any]:
        last, early = self._model.get_image_embeddings(pixels)
        return list(zip(last.float().split(1), early[0].float().split(1)))

    def _predict(self, embedding: Any, points: Tensor) -> MaskPredictions:
        """Predict masks in the order of the decoder, on which the levels depend.

        transformers sorts the three masks of a point by predicted IoU, so this method restores their order.
        """
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
    """Return the arguments of transformers for points, each of which is a separate prompt."""
    labels = torch.ones(1, len(points), 1, dtype=torch.int32, device=points.device)
    return {"input_points": points[None, :, None], "input_labels": labels}


# Automatic masks of SAM, in the four lists of LangSplat's preprocessing.
#
# The image and four crops of it are each prompted with a grid of points. The crops form a 2 x 2 grid and overlap by
# 512/1500 of the shorter side. Each point yields three masks, for a subpart, a part and the whole of the object at the
# point. Level "s" holds the first of them, "m" the second, "l" the third, and "default" all three. Each level is
# filtered separately:
#
# 1. Predicted IoU and stability must be high enough. Stability is the IoU of the mask at two thresholds of the logits.
# 2. No side of the box may lie at the border of a crop, unless it is also the border of the image.
# 3. Non-maximum suppression compares boxes within each crop (higher predicted IoU first), and then across crops
#    (smaller crops first).
# 4. Small holes are filled and small pieces are removed. Boxes are then suppressed again (unchanged masks first).
# 5. LangSplat's suppression compares masks, whose score is stability times predicted IoU; see `mask_nms`.
#
# The remaining masks keep the order of steps 3 and 4. If masks overlap, the lift uses the later one.


SamLevel = Literal["default", "s", "m", "l"]
SAM_LEVELS: tuple[SamLevel, ...] = get_args(SamLevel)
CropBox = tuple[int, int, int, int]
"""Box (x0, y0, x1, y1) in pixels, with x1 and y1 exclusive."""
_GROUP_OFFSET = 2**22
"""Distance between groups of boxes. It exceeds the width of any realistic image, and float32 represents all integers up
to four times this value."""


@dataclass(frozen=True)
class MaskRules:
    """Prompts and thresholds of the automatic masks. The defaults are LangSplat's settings."""

    points_per_side: int = 32
    """Number of prompts along each side of the image and of each crop."""
    crop_overlap: float = 512 / 1500
    """Overlap of neighboring crops, as a fraction of the shorter side of the image."""
    predicted_iou: float = 0.7
    """Predicted IoU up to which masks are dropped."""
    stability: float = 0.85
    """Smallest stability of masks that are kept."""
    stability_offset: float = 1.0
    """Absolute value of the two logit thresholds that define stability."""
    edge: int = 20
    """Distance from a border, in pixels, up to which a box counts as touching it."""
    box_iou: float = 0.7
    """Largest IoU of two boxes that are both kept."""
    region_area: int = 100
    """Number of pixels below which holes are filled and pieces are removed."""
    suppression: mask_filtering.Suppression = field(default_factory=mask_filtering.Suppression)


class _Candidates(NamedTuple):
    """Candidate masks before suppression."""

    logits: Float[Tensor, "c y x"]
    """Logits at the resolution of the network."""
    channel: Int64[Tensor, " c"]
    """Index of the mask among the three masks of its point."""
    predicted_iou: Float[Tensor, " c"]
    stability: Float[Tensor, " c"]
    boxes: Int64[Tensor, "c 4"]
    """Boxes in the image, in the format of `masks_to_boxes`."""
    crop: Int64[Tensor, " c"]
    """Index of the crop that the candidate was found in; 0 is the whole image."""

    def at(self, index: Tensor) -> _Candidates:
        return _Candidates(*(value[index] for value in self))

    def by_level(self) -> dict[SamLevel, Int64[Tensor, " k"]]:
        """Return the indices of the candidates of each level."""
        selected = [torch.ones_like(self.channel, dtype=torch.bool), *(self.channel == i for i in range(3))]
        return {level: flags.nonzero()[:, 0] for level, flags in zip(SAM_LEVELS, selected)}


@dataclass(frozen=True)
class SamMasks(RegionDefaults):
    """Regions from one level of SAM's automatic masks. Weights are loaded on first use.

    The network segments one image at a time, while another thread processes the label maps of the previous image.

    Raises:
        ValueError: If torch or transformers is missing or too old, or the checkpoint is invalid or belongs to another
            network.
        FileNotFoundError: If the checkpoint is a path that does not exist.
    """

    checkpoint: str = DEFAULT_SAM
    """Folder or file with weights of SAM, SAM 2, SAM 2.1 or HQ-SAM, or a name on the Hugging Face hub."""
    level: SamLevel = "l"
    """Selected level: "s", "m" or "l" for SAM's subparts, parts or wholes, or "default" for all three."""
    device: str = "cpu"
    """Device of the network, the mask filtering and the label maps."""
    precision: SamPrecision = "auto"
    """Precision of the network. "auto" selects float16 on a GPU and float32 on a CPU."""
    rules: MaskRules = field(default_factory=MaskRules)

    at_once = 2

    def __post_init__(self) -> None:
        check_sam_checkpoint(self.checkpoint)

    @property
    def identity(self) -> dict[str, Any]:
        """All settings that change the label maps. Checkpoint files are identified by their content, not their path."""
        precision = resolve_precision(self.precision, self.device)
        return {"kind": "sam", "checkpoint": self._checkpoint, "precision": precision, "rules": asdict(self.rules)}

    @property
    def chosen(self) -> tuple[int, ...]:
        return (SAM_LEVELS.index(self.level),)

    def labels(self, image: UInt8[Tensor, "h w 3"], name: str) -> Int32[Tensor, "levels depth h w"]:
        """Return label maps of the levels default, s, m and l, on the device. Raises the same errors as `masks`."""
        with _network_lock:
            maps = [stack_masks(masks) for masks in self.masks(image).values()]
        depth = max(len(labels) for labels in maps)
        return torch.stack([pad(labels, (0, 0, 0, 0, 0, depth - len(labels)), value=-1) for labels in maps])

    @torch.no_grad()
    def masks(self, image: UInt8[Tensor, "h w 3"]) -> dict[SamLevel, Bool[Tensor, "m h w"]]:
        """Return the masks of all levels, on the device. If masks overlap, the lift uses the later one.

        Raises:
            FileNotFoundError: If the weights cannot be downloaded.
            ValueError: If the checkpoint is damaged or belongs to another network, or the installed torch or
                transformers is too old.
            MemoryError: If a single image or prompt does not fit into GPU memory.
        """
        rules = self.rules
        size = image.shape[0], image.shape[1]
        crops = crop_boxes(*size, rules.crop_overlap)
        on_device = image.to(self.device)
        crop_images = [on_device[y0:y1, x0:x1] for x0, y0, x1, y1 in crops]
        embeddings = self.network.embed(self.network.pixels(crop_images))
        parts: list[_Candidates] = []
        per_crop: dict[SamLevel, list[Tensor]] = {level: [] for level in SAM_LEVELS}
        for i, embedding in enumerate(embeddings):
            candidates, before = self._candidates(embedding, crops[i], i, size), sum(len(part.crop) for part in parts)
            kept = _distinct(candidates.by_level(), candidates.boxes, candidates.predicted_iou, rules)
            rows = torch.cat(list(kept.values())).unique()
            parts.append(candidates.at(rows))
            for level, index in kept.items():
                per_crop[level].append(before + torch.searchsorted(rows, index))
        candidates = _Candidates(*map(torch.cat, zip(*parts)))
        area = torch.tensor([(x1 - x0) * (y1 - y0) for x0, y0, x1, y1 in crops], device=self.device)
        smaller_first = 1 / area[candidates.crop]
        groups: dict[SamLevel, Tensor] = {level: torch.cat(index) for level, index in per_crop.items()}
        kept = _distinct(groups, candidates.boxes, smaller_first, rules)
        rows = torch.cat(list(kept.values())).unique()
        candidates = candidates.at(rows)
        masks = self._image_masks(candidates, crops, size)
        masks, changed = mask_filtering.remove_small_regions(masks, rules.region_area)
        boxes, score = mask_filtering.masks_to_boxes(masks), candidates.stability * candidates.predicted_iou
        groups = {level: torch.searchsorted(rows, index) for level, index in kept.items()}
        kept = _distinct(groups, boxes, (~changed).float(), rules)
        return {
            level: masks[index[mask_filtering.mask_nms(masks[index], score[index], rules.suppression)]]
            for level, index in kept.items()
        }

    def _candidates(self, embedding: Tensor, crop: CropBox, number: int, size: tuple[int, int]) -> _Candidates:
        """Return the masks of one crop that pass the thresholds and do not touch its border inside the image."""
        x0, y0, x1, y1 = crop
        network, rules, crop_size = self.network, self.rules, (y1 - y0, x1 - x0)
        points = point_grid(rules.points_per_side) * torch.tensor([x1 - x0, y1 - y0])
        parts, channels, predicted = [], [], []
        for masks, ious in network.prompt(embedding, points, crop_size):
            point, channel = (ious > rules.predicted_iou).nonzero(as_tuple=True)
            parts.append(masks[point, channel])
            channels.append(channel)
            predicted.append(ious[point, channel])

        logits = torch.cat(parts)
        measured = network.measure(logits, crop_size, rules.stability_offset)
        boxes, stability = measured.boxes + torch.tensor([x0, y0, x0, y0], device=logits.device), measured.stability
        numbers = torch.full_like(stability, number).long()
        candidates = _Candidates(logits, torch.cat(channels), torch.cat(predicted), stability, boxes, numbers)
        good = (stability >= rules.stability) & (stability > 0) & ~near_crop_edge(boxes, crop, size, rules.edge)
        return candidates.at(good.nonzero()[:, 0])

    def _image_masks(
        self, candidates: _Candidates, crops: Sequence[CropBox], size: tuple[int, int]
    ) -> Bool[Tensor, "c h w"]:
        """Return the masks at the size of the image."""
        masks = torch.zeros(len(candidates.crop), *size, dtype=torch.bool, device=candidates.crop.device)
        for i, (x0, y0, x1, y1) in enumerate(crops):
            index, crop_size = (candidates.crop == i).nonzero()[:, 0], (y1 - y0, x1 - x0)
            parts = self.network.masks(partial(self._crop_masks, crop_size), candidates.logits[index])
            masks[index, y0:y1, x0:x1] = torch.cat([masks.new_zeros(0, *crop_size), *parts])
        return masks

    def _crop_masks(self, size: tuple[int, int], logits: Tensor) -> Tensor:
        return self.network.enlarge(logits, size) > 0

    @shared_property
    def _checkpoint(self) -> str:
        return sam_identity(self.checkpoint)

    @shared_property
    def network(self) -> PromptedNetwork:
        """The network with its weights, loaded on first use. Raises the same errors as `masks`."""
        return load_sam_network(self.checkpoint, self.device, self.precision)


def point_grid(side: int) -> Float[Tensor, "p 2"]:
    """Return the centers (x, y) of `side` x `side` cells of the unit square, in row-major order."""
    center = (torch.arange(side, dtype=torch.float64) + 0.5) / side
    y, x = torch.meshgrid(center, center, indexing="ij")
    return torch.stack([x.flatten(), y.flatten()], dim=1)


def crop_boxes(height: int, width: int, overlap: float) -> list[CropBox]:
    """Return the boxes of the whole image and of four crops, in column-major order.

    The crops overlap by the fraction `overlap` of the shorter side.

    >>> crop_boxes(960, 540, 512 / 1500)
    [(0, 0, 540, 960), (0, 0, 362, 572), (0, 388, 362, 960), (178, 0, 540, 572), (178, 388, 540, 960)]
    """
    shared = int(overlap * min(height, width))
    w, h = math.ceil((shared + width) / 2), math.ceil((shared + height) / 2)
    corners = product((0, w - shared), (0, h - shared))
    return [(0, 0, width, height), *((x, y, min(x + w, width), min(y + h, height)) for x, y in corners)]


def near_crop_edge(boxes: Int64[Tensor, "n 4"], crop: CropBox, size: tuple[int, int], edge: int) -> Bool[Tensor, " n"]:
    """Return whether each box has a side within `edge` pixels of the same side of the crop, but not of the image.

    Args:
        boxes: Boxes in the image, in the format of `masks_to_boxes`.
        size: Height and width of the image.
    """
    near_crop, near_image = (
        (boxes - torch.tensor(border, device=boxes.device)).abs() <= edge for border in (crop, (0, 0, size[1], size[0]))
    )
    return (near_crop & ~near_image).any(dim=1)


def _distinct(
    groups: Mapping[SamLevel, Int64[Tensor, " k"]], boxes: Int64[Tensor, "n 4"], scores: Float[Tensor, " n"],
    rules: MaskRules,
) -> dict[SamLevel, Int64[Tensor, " k"]]:  # fmt: skip
    """Suppress overlapping boxes within each group (non-maximum suppression).

    One NMS call handles all groups, because each call waits for the GPU. An offset separates boxes of different groups.

    Returns:
        The indices to keep in each group, in descending order of scores. Equal scores keep their order.
    """
    from torchvision.ops import nms  # noqa: PLC0415 (takes a second, and only SAM needs it)

    index = torch.cat(list(groups.values()))
    sizes = torch.tensor([len(group) for group in groups.values()], device=index.device)
    group = torch.repeat_interleave(torch.arange(len(groups), device=index.device), sizes)
    kept = nms((boxes[index] + group[:, None] * _GROUP_OFFSET).float(), scores[index], rules.box_iou)
    return {level: index[kept[group[kept] == i]] for i, level in enumerate(groups)}
