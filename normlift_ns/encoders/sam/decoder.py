"""SAM's mask decoder for many single points on one image, with the weights of transformers' modules.

The same function, computed with less. Tokens (seven per point) stay in float32; what belongs to the positions of the
image, thousands per point, is in the precision of the decoder:

* Until a layer has looked at the tokens, all points share the image: its embedding is not copied per point.
* Attention between tokens and image needs no projection of the image. q . (W_k x) is (W_k^T q) . x, and the mean of
  W_v x is W_v of the mean of x, so that the matrices of a head move to the side of the tokens. What is left per
  position are two products with 56 columns, one per token and head. The bias of keys is the same for all positions and
  cancels.
* Transposed convolutions of 2 x 2 with stride 2 are products with a matrix; pixels are brought into order once, at the
  end, when they are three logits each.
* Of the four masks of a point, the first, which is for several prompts at once, is not made.
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
    """The decoder of a model, on the model's device."""

    def __init__(self, model: Any, dtype: torch.dtype) -> None:
        """
        Args:
            model: transformers' SamModel.
            dtype: of the image in the decoder, and of the logits.
        """
        self._model, self._dtype = model, dtype
        self._positions = model.get_image_wide_positional_embeddings().detach().flatten(2)[0].T.contiguous()
        self._upscaling = _upscaling(model, dtype)
        self._norms = [_Norm.of(layer.layer_norm4, dtype) for layer in model.mask_decoder.transformer.layers]

    @torch.no_grad()
    def __call__(self, embedding: Float[Tensor, "1 c y x"], points: Float[Tensor, "p 2"]) -> Answers:
        """The masks of points, (x, y) in pixels of the input."""
        labels = torch.ones(1, len(points), 1, dtype=torch.int32, device=points.device)
        prompts, dense = self._model.get_prompt_embeddings(input_points=points[None, :, None], input_labels=labels)
        image = (embedding + dense).flatten(2)[0].T
        return self._decode(image.to(self._dtype), (image + self._positions).to(self._dtype), prompts[0])

    def _decode(self, image: Tensor, placed: Tensor, prompts: Tensor) -> Answers:
        """
        Args:
            image: [N, C], the positions of the image.
            placed: the same with their position embeddings.
            prompts: [P, 2, C].
        """
        decoder = self._model.mask_decoder
        positions = self._positions.to(self._dtype)
        own = torch.cat([decoder.iou_token.weight, decoder.mask_tokens.weight])
        given = torch.cat([own.expand(len(prompts), -1, -1), prompts], dim=1)
        tokens, keys, first = given, image, True
        for layer, norm in zip(decoder.transformer.layers, self._norms):
            if first:
                tokens = _among_tokens(layer.self_attn, tokens, tokens)
            else:
                tokens = tokens + _among_tokens(layer.self_attn, tokens + given, tokens)
            tokens = layer.layer_norm1(tokens)
            scores = _scores(placed if first else keys, None if first else positions)
            to_image = _to_image(layer.cross_attn_token_to_image, tokens + given, keys, scores)
            tokens = layer.layer_norm2(tokens + to_image)
            tokens = layer.layer_norm3(tokens + layer.mlp(tokens))
            keys = norm(_to_tokens(layer.cross_attn_image_to_token, tokens + given, tokens, keys, scores))
            first = False
        final = decoder.transformer
        to_image = _to_image(final.final_attn_token_to_image, tokens + given, keys, _scores(keys, positions))
        tokens = final.layer_norm_final_attn(tokens + to_image)
        mlps = list(decoder.output_hypernetworks_mlps)[1:]
        wanted = torch.stack([mlp(tokens[:, 2 + i]) for i, mlp in enumerate(mlps)], dim=1)
        ious = decoder.iou_prediction_head(tokens[:, 0])[:, 1:]
        return self._upscaling(keys, wanted.to(self._dtype)), ious


def _among_tokens(attention: Any, where: Tensor, what: Tensor) -> Tensor:
    """Self-attention of tokens [P, T, C], in their own precision."""
    query, key, value = attention.q_proj(where), attention.k_proj(where), attention.v_proj(what)
    heads = (x.unflatten(2, (attention.num_attention_heads, -1)).transpose(1, 2) for x in (query, key, value))
    return attention.out_proj(scaled_dot_product_attention(*heads).transpose(1, 2).flatten(2))


def _heads(attention: Any, projected: Tensor) -> Tensor:
    """[P, T, H, d]."""
    return projected.unflatten(2, (attention.num_attention_heads, -1))


def _per_head(attention: Any, projection: Any) -> Tensor:
    """The matrix of a projection, [H, d, C]."""
    return projection.weight.unflatten(0, (attention.num_attention_heads, -1))


def _scores(keys: Tensor, positions: Tensor | None) -> Callable[[Tensor], Tensor]:
    """What multiplies directions [P, K, C] with the placed image: [P, K, N]. Without positions keys have theirs."""

    def multiply(directions: Tensor) -> Tensor:
        if positions is None:
            return directions @ keys.transpose(-1, -2)
        return torch.baddbmm(directions @ positions.T, directions, keys.transpose(-1, -2))

    return multiply


def _to_image(attention: Any, where: Tensor, keys: Tensor, scores: Callable[[Tensor], Tensor]) -> Tensor:
    """Attention of tokens to the image: [P, T, C]; keys are [N, C] or [P, N, C]."""
    query = _heads(attention, attention.q_proj(where))
    scale = query.shape[-1] ** -0.5
    directions = torch.einsum("pthd,hdc->pthc", query * scale, _per_head(attention, attention.k_proj))
    shares = scores(directions.flatten(1, 2).to(keys.dtype)).softmax(dim=-1)
    mean = (shares @ keys).to(where.dtype).unflatten(1, query.shape[1:3])
    value = torch.einsum("pthc,hdc->pthd", mean, _per_head(attention, attention.v_proj)).flatten(2)
    return attention.out_proj(value + attention.v_proj.bias)


def _to_tokens(attention: Any, where: Tensor, what: Tensor, keys: Tensor, scores: Callable[[Tensor], Tensor]) -> Tensor:
    """The image plus its attention to the tokens: [P, N, C]."""
    key, value = _heads(attention, attention.k_proj(where)), _heads(attention, attention.v_proj(what))
    heads, scale = key.shape[2], key.shape[3] ** -0.5
    directions = torch.einsum("pthd,hdc->phtc", key * scale, _per_head(attention, attention.q_proj))
    bias = torch.einsum("pthd,hd->pht", key * scale, attention.q_proj.bias.unflatten(0, (heads, -1)))
    raw = scores(directions.flatten(1, 2).to(keys.dtype)) + bias.flatten(1)[:, :, None].to(keys.dtype)
    shares = raw.unflatten(1, bias.shape[1:]).softmax(dim=2).flatten(1, 2)
    out = attention.out_proj
    rows = torch.einsum("pthd,chd->phtc", value, out.weight.unflatten(1, (heads, -1))) + out.bias / heads
    every = keys.expand(len(rows), *keys.shape[-2:])
    return torch.baddbmm(every, shares.transpose(1, 2), rows.flatten(1, 2).to(keys.dtype))


class _Norm(NamedTuple):
    """A layer norm over the last axis."""

    weight: Tensor
    bias: Tensor
    eps: float

    @classmethod
    def of(cls, norm: Any, dtype: torch.dtype) -> _Norm:
        return cls(norm.weight.detach().to(dtype), norm.bias.detach().to(dtype), norm.eps)

    def __call__(self, values: Tensor) -> Tensor:
        return layer_norm(values, self.weight.shape, self.weight, self.bias, self.eps)


class _Upscaling(NamedTuple):
    """Two transposed convolutions with what stands between and after them."""

    side: int
    """Of the image, in positions."""
    weights: tuple[Tensor, Tensor]
    """[4 O, C] each: a position becomes four, row by row, with O channels."""
    biases: tuple[Tensor, Tensor]
    """[O] each."""
    norm: _Norm

    def __call__(self, keys: Float[Tensor, "p n c"], wanted: Float[Tensor, "p m o"]) -> Float[Tensor, "p m y x"]:
        """Products of the channels of every pixel with those of each mask."""
        if kernels_apply(keys) and keys.dtype != torch.float32:
            from normlift_ns.kernels.upscaling import upscaled_masks  # noqa: PLC0415 (only where Triton is)

            return upscaled_masks(keys, self.weights, self.biases, self.norm, wanted, self.side)
        pixels = gelu(self.norm(self._grow(0, keys)))  # [P, N, 4, O]
        pixels = gelu(self._grow(1, pixels))  # [P, N, 4, 4, O]
        found = wanted @ pixels.flatten(1, 3).transpose(1, 2)
        places = found.unflatten(2, (self.side, -1, 2, 2, 2, 2))  # y x, then twice: upper or lower, left or right
        return places.permute(0, 1, 2, 4, 6, 3, 5, 7).flatten(5, 7).flatten(2, 4)

    def _grow(self, step: int, pixels: Tensor) -> Tensor:
        return linear(pixels, self.weights[step], self.biases[step].repeat(4)).unflatten(-1, (4, -1))


def _upscaling(model: Any, dtype: torch.dtype) -> _Upscaling:
    decoder, side = model.mask_decoder, model.config.prompt_encoder_config.image_embedding_size
    steps = decoder.upscale_conv1, decoder.upscale_conv2
    first, second = (step.weight.detach().permute(2, 3, 1, 0).flatten(0, 2).to(dtype).contiguous() for step in steps)
    biases = steps[0].bias.detach().to(dtype), steps[1].bias.detach().to(dtype)
    return _Upscaling(side, (first, second), biases, _Norm.of(decoder.upscale_layer_norm, dtype))
