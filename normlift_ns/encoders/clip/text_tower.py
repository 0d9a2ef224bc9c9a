"""The CLIP text tower in plain torch, for prompts that are not cached.

Most architectures of open_clip share one kind of text tower: a causal transformer over byte pairs, read out at the end
of the text. This module computes those from the same weights with open_clip's own tokenizer, which avoids importing the
rest of open_clip. Other kinds are left to open_clip.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float32, Int64
from safetensors import safe_open
from torch import Tensor
from torch.nn.functional import gelu, layer_norm, linear, normalize, scaled_dot_product_attention

from normlift_ns.encoders.clip.architectures import model_config, open_clip_part
from normlift_ns.encoders.texts.prompts import check_prompts
from normlift_ns.encoders.texts.templates import check_template, templates_of
from normlift_ns.encoders.weights import FOREIGN_ERRORS, hub_file

_PLAIN_KEYS = {"context_length", "vocab_size", "width", "heads", "layers"}
"""Configuration keys of a plain text tower; any other key indicates another kind."""
_TEXT_BATCH_SIZE = 64


@dataclass(frozen=True)
class TextTower:
    """A text tower with its weights in float32; formulas as in open_clip's transformer.py."""

    tokenizer: Callable[[Sequence[str]], Int64[Tensor, "b length"]]
    templates: Sequence[Callable[[str], str]]
    """Functions that fill the prompt templates; the embedding of a text is the mean over them."""
    weights: Mapping[str, Float32[Tensor, ...]]
    """Weights by their names in the model's state dict."""
    heads: int
    layers: int
    quick_gelu: bool
    device: str

    def text(self, prompts: Sequence[str]) -> Float32[Tensor, "q d"]:
        """Return one unit row per prompt, on the CPU.

        Raises:
            ValueError: If `prompts` or a prompt is empty.
        """
        check_prompts(prompts)
        tokens = self.tokenizer([template(prompt) for prompt in prompts for template in self.templates])
        rows = torch.cat([self._rows(part.to(self.device)) for part in tokens.split(_TEXT_BATCH_SIZE)])
        return normalize(rows.unflatten(0, (len(prompts), len(self.templates))).mean(dim=1), dim=1).cpu()

    @torch.no_grad()
    def _rows(self, tokens: Int64[Tensor, "b length"]) -> Float32[Tensor, "b d"]:
        end = tokens.argmax(dim=1)  # the end-of-text token has the largest id
        tokens = tokens[:, : int(end.max()) + 1]  # causal attention ignores later tokens
        x = self.weights["token_embedding.weight"][tokens] + self.weights["positional_embedding"][: tokens.shape[1]]
        for i in range(self.layers):
            block = f"transformer.resblocks.{i}."
            qkv = self._linear(self._norm(x, f"{block}ln_1"), f"{block}attn.in_proj_")
            q, k, v = qkv.unflatten(2, (3, self.heads, -1)).permute(2, 0, 3, 1, 4)
            attended = scaled_dot_product_attention(q, k, v, is_causal=True)
            x = x + self._linear(attended.transpose(1, 2).flatten(2), f"{block}attn.out_proj.")
            hidden = self._linear(self._norm(x, f"{block}ln_2"), f"{block}mlp.c_fc.")
            hidden = hidden * torch.sigmoid(1.702 * hidden) if self.quick_gelu else gelu(hidden)
            x = x + self._linear(hidden, f"{block}mlp.c_proj.")
        last = x[torch.arange(len(x), device=x.device), end]
        return normalize(self._norm(last, "ln_final") @ self.weights["text_projection"], dim=1)

    def _norm(self, x: Tensor, name: str) -> Tensor:
        return layer_norm(x, x.shape[-1:], self.weights[f"{name}.weight"], self.weights[f"{name}.bias"])

    def _linear(self, x: Tensor, name: str) -> Tensor:
        return linear(x, self.weights[f"{name}weight"], self.weights[f"{name}bias"])


def load_text_tower(model: str, pretrained: str, template: str, device: str = "cpu") -> TextTower | None:
    """Load the text tower of an OpenCLIP model.

    Return None if it is not of the plain kind, its weights are not on this machine, or anything is unexpected.
    `OpenClipEncoder` then handles the model, or reports what is wrong.
    """
    try:
        config = model_config(model) or {}
        sizes = config["text_cfg"]
        local = _find_local_weights(model, pretrained)
        if local is None or not set(sizes) <= _PLAIN_KEYS or config.get("custom_text"):
            return None
        path, published = local
        shapes = _shapes(config["embed_dim"], **sizes)
        weights = _read(path, shapes)
        check_template(template)
        templates = templates_of(template)
        tokenizer = open_clip_part("tokenizer").SimpleTokenizer(context_length=sizes["context_length"])
    except FOREIGN_ERRORS:
        return None
    if {name: weight.shape for name, weight in weights.items()} != shapes:
        return None
    quick_gelu = config.get("quick_gelu", False) or published.get("quick_gelu", False)
    weights = {name: weight.to(device, torch.float32) for name, weight in weights.items()}
    return TextTower(tokenizer, templates, weights, sizes["heads"], sizes["layers"], quick_gelu, device)


def _find_local_weights(model: str, pretrained: str) -> tuple[Path, Mapping[str, Any]] | None:
    """Return the weight file and open_clip's description of its training; None if it is not on this machine."""
    if os.path.isfile(pretrained):
        return Path(pretrained), {}
    published = open_clip_part("pretrained").get_pretrained_cfg(model, pretrained)
    path = hub_file(published, open_clip_part("constants")) if published else None
    return None if path is None else (path, published)


def _read(path: Path, names: Mapping[str, Any]) -> dict[str, Tensor]:
    """Read the named tensors of a weight file and nothing else. Raises exceptions in `FOREIGN_ERRORS`."""
    if path.suffix == ".safetensors":
        with safe_open(path, "pt") as file:
            return {name: file.get_tensor(name) for name in names}
    state = torch.load(str(path), map_location="cpu", weights_only=True, mmap=True)
    state = state.get("state_dict", state)
    prefix = "module." if next(iter(state)).startswith("module.") else ""
    return {name: state[prefix + name] for name in names}


def _shapes(
    embed_dim: int, context_length: int, vocab_size: int, width: int, heads: int, layers: int
) -> dict[str, tuple[int, ...]]:
    """Return the shapes of all weights of a plain text tower."""
    block = {
        "ln_1.weight": (width,), "ln_1.bias": (width,), "ln_2.weight": (width,), "ln_2.bias": (width,),
        "attn.in_proj_weight": (3 * width, width), "attn.in_proj_bias": (3 * width,),
        "attn.out_proj.weight": (width, width), "attn.out_proj.bias": (width,),
        "mlp.c_fc.weight": (4 * width, width), "mlp.c_fc.bias": (4 * width,),
        "mlp.c_proj.weight": (width, 4 * width), "mlp.c_proj.bias": (width,),
    }  # fmt: skip
    blocks = {f"transformer.resblocks.{i}.{name}": shape for i in range(layers) for name, shape in block.items()}
    shapes = {
        "token_embedding.weight": (vocab_size, width),
        "positional_embedding": (context_length, width),
        "ln_final.weight": (width,),
        "ln_final.bias": (width,),
        "text_projection": (width, embed_dim),
    }
    return {**shapes, **blocks}
