"""SAM's mask decoder for many single points on one image, with the weights of transformers' modules.

It computes the same function with less work. Tokens (seven per point) stay in float32. The positions of the image,
thousands per point, are in the precision of the decoder.

* Until a layer has attended to the tokens, all points share the image, so its embedding is not copied per point.
* Attention between tokens and image does not project the image. q . (W_k x) is (W_k^T q) . x, and the mean of W_v x is
  W_v times the mean of x. So the matrices of a head move to the token side. Two products with 56 columns, one per token
  and head, remain for each position. The bias of the keys is the same for all positions and cancels.
* Transposed convolutions of 2 x 2 with stride 2 are matrix products. Pixels are reordered once, at the end, when they
  consist of three logits each.
* The first of a point's four masks is meant for several prompts at once and is not computed.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import gelu, layer_norm, linear, scaled_dot_product_attention

from normlift_ns.core.gpu import kernels_apply

Answers = tuple[Float[Tensor, "p 3 y x"], Float[Tensor, "p 3"]]
"""Logits and predicted IoU of the three masks of each point."""


class MaskDecoder:
    """Mask decoder of a SAM model, on the device of the model."""

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
    def __call__(self, embedding: Float[Tensor, "1 c y x"], points: Float[Tensor, "p 2"]) -> Answers:
        """Return the masks of points, (x, y) in pixels of the input."""
        labels = torch.ones(1, len(points), 1, dtype=torch.int32, device=points.device)
        prompts, dense = self._model.get_prompt_embeddings(input_points=points[None, :, None], input_labels=labels)
        image = (embedding + dense).flatten(2)[0].T
        return self._decode(image.to(self._dtype), (image + self._positions).to(self._dtype), prompts[0])

    def _decode(self, image: Tensor, positioned: Tensor, prompts: Tensor) -> Answers:
        """Decode prompts on an image.

        Args:
            image: Positions of the image, [N, C].
            positioned: The same plus their position embeddings.
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
    """Return the self-attention of tokens [P, T, C], in their own precision."""
    query, key, value = attention.q_proj(positioned), attention.k_proj(positioned), attention.v_proj(tokens)
    heads = (x.unflatten(2, (attention.num_attention_heads, -1)).transpose(1, 2) for x in (query, key, value))
    return attention.out_proj(scaled_dot_product_attention(*heads).transpose(1, 2).flatten(2))


def _heads(attention: Any, projected: Tensor) -> Tensor:
    """Split projected tokens into heads, [P, T, H, d]."""
    return projected.unflatten(2, (attention.num_attention_heads, -1))


def _per_head(attention: Any, projection: Any) -> Tensor:
    """Return the matrix of a projection by head, [H, d, C]."""
    return projection.weight.unflatten(0, (attention.num_attention_heads, -1))


def _image_scores(keys: Tensor, positions: Tensor | None) -> Callable[[Tensor], Tensor]:
    """Return a function that multiplies directions [P, K, C] with the positioned image, giving [P, K, N].

    Args:
        keys: The image, [N, C] or [P, N, C].
        positions: Position embeddings [N, C]; None if `keys` include them.
    """

    def multiply(directions: Tensor) -> Tensor:
        if positions is None:
            return directions @ keys.transpose(-1, -2)
        return torch.baddbmm(directions @ positions.T, directions, keys.transpose(-1, -2))

    return multiply


def _attend_to_image(attention: Any, tokens: Tensor, keys: Tensor, scores: Callable[[Tensor], Tensor]) -> Tensor:
    """Return the attention of tokens to the image, [P, T, C]; keys are [N, C] or [P, N, C]."""
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
    """Layer norm over the last axis."""

    weight: Tensor
    bias: Tensor
    eps: float

    @classmethod
    def from_module(cls, norm: Any, dtype: torch.dtype) -> _Norm:
        return cls(norm.weight.detach().to(dtype), norm.bias.detach().to(dtype), norm.eps)

    def __call__(self, values: Tensor) -> Tensor:
        return layer_norm(values, self.weight.shape, self.weight, self.bias, self.eps)


class _Upscaling(NamedTuple):
    """Two transposed convolutions with the layer norm and the activations between and after them."""

    side: int
    """Side of the image, in positions."""
    weights: tuple[Tensor, Tensor]
    """Matrices [4 O, C]: a position becomes four, row by row, with O channels."""
    biases: tuple[Tensor, Tensor]
    """Biases [O]."""
    norm: _Norm

    def __call__(self, keys: Float[Tensor, "p n c"], mask_channels: Float[Tensor, "p m o"]) -> Float[Tensor, "p m y x"]:
        """Return the products of the channels of every pixel with those of each mask."""
        if kernels_apply(keys) and keys.dtype != torch.float32:
            from normlift_ns.kernels.upscaling import upscaled_masks  # noqa: PLC0415 (needs Triton)

            return upscaled_masks(keys, self.weights, self.biases, self.norm, mask_channels, self.side)
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
