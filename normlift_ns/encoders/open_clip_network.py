"""Encoder of images and prompts that uses OpenCLIP networks, and OpenCLIP's text tower in plain torch."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, cast

import torch
from jaxtyping import Float, Float32, Int64
from safetensors import safe_open
from torch import Tensor
from torch.nn.functional import gelu, interpolate, layer_norm, linear, normalize, scaled_dot_product_attention
from torch.overrides import TorchFunctionMode

from normlift_ns.core.device import shared_property
from normlift_ns.encoders.crops import NetworkEncoder
from normlift_ns.encoders.open_clip import (
    OPEN_CLIP_REMEDY,
    check_open_clip_names,
    find_local_clip_weights,
    find_open_clip_weights,
    import_open_clip,
    import_open_clip_module,
    missing_patches_reason,
    open_clip_model_config,
)
from normlift_ns.encoders.text_files import check_prompts, check_template, prompt_templates
from normlift_ns.encoders.weights import CONNECT_ONCE, third_party_errors
from normlift_ns.io.atomic import file_digest
from normlift_ns.io.guard import check_regular
from normlift_ns.options import DEFAULT_MODEL, DEFAULT_PRETRAINED, CropFill


class OpenClipNetwork(NamedTuple):
    """An OpenCLIP model with its tokenizer and preprocessing, in half precision on a GPU and in float32 on a CPU."""

    model: Any
    tokenizer: Any
    size: tuple[int, int]
    """Height and width of the training images, in pixels."""
    mean: Float[Tensor, "3 1 1"]
    std: Float[Tensor, "3 1 1"]

    def normalized(self, pixels: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b 3 h w"]:
        """Normalize pixels with values in 0..255 for the model, on its device."""
        return ((pixels / 255 - self.mean) / self.std).to(torch.float16 if pixels.is_cuda else torch.float32)

    @property
    def patch_size(self) -> tuple[int, int]:
        """Height and width of a patch, in pixels."""
        height, width = self.model.visual.patch_size
        return height, width

    def images(self, pixels: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b d"]:
        """Embed images; see `JointNetwork.images`."""
        return self.model.encode_image(self.normalized(pixels))

    def patches(self, pixels: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b r d"]:
        """Embed patches; see `patch_embeddings`."""
        return patch_embeddings(self.model.visual, self.normalized(pixels))

    def texts(self, texts: Sequence[str]) -> Float[Tensor, "b d"]:
        """Embed texts."""
        return self.model.encode_text(self.tokenizer(list(texts)).to(self.mean.device))


class _Uninitialized(TorchFunctionMode):
    """A context that skips the random initialization of modules in this thread. A weight file sets the values later."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if getattr(func, "__module__", None) == "torch.nn.init":
            return args[0] if len(args) > 0 else kwargs["tensor"]
        return func(*args, **(kwargs or {}))


def load_open_clip(model: str, pretrained: str, device: str) -> OpenClipNetwork:
    """Load a network whose architecture and weights have passed `check_open_clip_names`.

    Raises:
        FileNotFoundError: If the weights or the tokenizer cannot be downloaded.
        ValueError: If the installed packages cannot build the architecture, or the weight file is damaged or belongs to
            another architecture.
    """
    open_clip = import_open_clip()
    path, training = find_open_clip_weights(model, pretrained)
    with (
        _Uninitialized(),
        third_party_errors(
            f"OpenCLIP model {model} cannot be built with the packages installed here",
            f"lift with another --encoder-model, such as {DEFAULT_MODEL}",
        ),
    ):
        network = open_clip.create_model(
            model,
            pretrained_hf=False,
            precision="fp16" if torch.device(device).type == "cuda" else "fp32",
            force_quick_gelu=training.get("quick_gelu", False),
            force_preprocess_cfg={key: training[key] for key in ("mean", "std") if key in training},
        )
    with third_party_errors(
        f"weight file {path} cannot be loaded into OpenCLIP model {model}",
        f"give its architecture with --encoder-model, or {OPEN_CLIP_REMEDY}",
    ):
        open_clip.load_checkpoint(network, str(path), weights_only=True)
    with third_party_errors(
        f"the tokenizer of OpenCLIP model {model} cannot be loaded",
        f"{CONNECT_ONCE}, or lift with a model that has OpenCLIP's own tokenizer, such as {DEFAULT_MODEL}, or with "
        "--encoder color, which needs no tokenizer",
        FileNotFoundError,
    ):
        tokenizer = open_clip.get_tokenizer(model)
    settings = open_clip.get_model_preprocess_cfg(network)
    size = settings["size"]
    mean, std = (torch.tensor(settings[key], device=device)[:, None, None] for key in ("mean", "std"))
    size = (size, size) if isinstance(size, int) else tuple(size)
    return OpenClipNetwork(network.to(device).eval().requires_grad_(False), tokenizer, size, mean, std)


# Patch features of OpenCLIP's vision transformers.
#
# The last layer of CLIP mixes all patches into one vector. Patch features use only the value path of this layer, as in
# MaskCLIP (Zhou, Loy and Dai, ECCV 2022). Patch tokens of the preceding layer pass through the first norm and the value
# and output projections of the last layer, the final norm, and the projection into the joint space. The image is scaled
# to a whole number of patches, and position embeddings are interpolated to their grid.


@torch.no_grad()
def patch_embeddings(visual: Any, pixels: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b r d"]:
    """Return unnormalized patch embeddings in the joint space, in row-major order.

    Args:
        visual: open_clip's VisionTransformer.
        pixels: Normalized images with sides that are multiples of the patch size.
    """
    tokens = visual.conv1(pixels)
    rows, columns = tokens.shape[2:]
    tokens = tokens.flatten(2).transpose(1, 2)
    first = visual.class_embedding.to(tokens.dtype).expand(len(tokens), 1, -1)
    positions = _positions(visual, rows, columns).to(tokens.dtype)
    tokens = visual.ln_pre(torch.cat([first, tokens], dim=1) + positions)
    *before, last = visual.transformer.resblocks
    for block in before:
        tokens = block(tokens)
    tokens = last.ln_1(tokens[:, 1:])
    values = linear(tokens, last.attn.in_proj_weight.chunk(3)[2], last.attn.in_proj_bias.chunk(3)[2])
    return visual.ln_post(last.ls_1(last.attn.out_proj(values))) @ visual.proj


def _positions(visual: Any, rows: int, columns: int) -> Float[Tensor, "n d"]:
    """Return the position embeddings of the class token and, interpolated bicubically, of a grid of patches."""
    learned = visual.positional_embedding.float()
    grid = learned[1:].reshape(*visual.grid_size, -1).permute(2, 0, 1)[None]
    grid = interpolate(grid, (rows, columns), mode="bicubic", antialias=True, align_corners=False)
    return torch.cat([learned[:1], grid[0].flatten(1).T])


@dataclass(frozen=True)
class OpenClipEncoder(NetworkEncoder):
    """An encoder with a CLIP network of open_clip; see `NetworkEncoder`.

    Raises:
        ValueError: If the model or the weights tag is unknown, or the template has no placeholder.
        FileNotFoundError: If a weight file does not exist.
    """

    model: str = DEFAULT_MODEL
    """Name of the architecture, one of open_clip.list_models()."""
    pretrained: str = DEFAULT_PRETRAINED
    """Tag of the weights to download, or a local weight file. Pickle files are read with weights_only=True."""
    fill: CropFill = "black"  # pyrefly: ignore[bad-override]
    device: str = "cpu"  # pyrefly: ignore[bad-override]
    template: str = "{}"  # pyrefly: ignore[bad-override]

    def _check_names(self) -> None:
        check_open_clip_names(self.model, self.pretrained)

    @shared_property
    def _identity(self) -> dict[str, Any]:
        path = Path(self.pretrained)
        weights = file_digest(path) if path.is_file() else self.pretrained
        return {"kind": "open_clip", "model": self.model, "pretrained": weights, "fill": self.fill}

    @property
    def why_not_dense(self) -> str | None:
        reason = missing_patches_reason(self.model)
        if reason is None:
            return None
        return (
            f"--regions patches does not support the OpenCLIP model {self.model}, because {reason}. "
            f"Use --encoder-model {DEFAULT_MODEL}, or other regions"
        )

    @shared_property
    def network(self) -> OpenClipNetwork:
        return load_open_clip(self.model, self.pretrained, self.device)

    def _width(self) -> int:
        return cast(Any, open_clip_model_config(self.model))["embed_dim"]


# The CLIP text tower in plain torch, for prompts that are not cached.
#
# Most architectures of open_clip have the same kind of text tower, a causal transformer over byte pairs. The embedding
# of a text is the output at its end token. This module computes it with the same weights and open_clip's own tokenizer,
# without importing the rest of open_clip. open_clip computes all other kinds of text towers.


_PLAIN_KEYS = {"context_length", "vocab_size", "width", "heads", "layers"}
"""Configuration keys of a text tower of the standard architecture; any other key indicates a different architecture."""
_TEXT_BATCH_SIZE = 64


@dataclass(frozen=True)
class TextTower:
    """A text tower with weights in float32. The formulas are those of open_clip's transformer.py."""

    tokenizer: Callable[[Sequence[str]], Int64[Tensor, "b length"]]
    templates: Sequence[Callable[[str], str]]
    """Functions that fill the prompt templates. The embedding of a prompt is the mean over all templates."""
    weights: Mapping[str, Float32[Tensor, ...]]
    """Weights by name in the model's state dict."""
    heads: int
    layers: int
    quick_gelu: bool
    device: str

    def text(self, prompts: Sequence[str]) -> Float32[Tensor, "q d"]:
        """Return one unit vector per prompt, on the CPU.

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
    """Load the text tower of an OpenCLIP model if it has the standard architecture of CLIP, and otherwise return None.

    The result is also None if the weights are not on this machine (see `find_local_clip_weights`) or cannot be loaded.
    `OpenClipEncoder` then loads the model, or reports the error.
    """
    try:
        config = open_clip_model_config(model) or {}
        sizes = config["text_cfg"]
        path, published = find_local_clip_weights(model, pretrained)
        if path is None or not set(sizes) <= _PLAIN_KEYS or config.get("custom_text"):
            return None
        shapes = _shapes(config["embed_dim"], **sizes)
        weights = _read(path, shapes)
        check_template(template)
        templates = prompt_templates(template)
        tokenizer = import_open_clip_module("tokenizer").SimpleTokenizer(context_length=sizes["context_length"])
    except MemoryError:
        raise
    except Exception:  # torch, safetensors and open_clip raise many types of errors for a bad file or name
        return None
    if {name: weight.shape for name, weight in weights.items()} != shapes:
        return None
    quick_gelu = config.get("quick_gelu", False) or published.get("quick_gelu", False)
    weights = {name: weight.to(device, torch.float32) for name, weight in weights.items()}
    return TextTower(tokenizer, templates, weights, sizes["heads"], sizes["layers"], quick_gelu, device)


def _read(path: Path, names: Mapping[str, Any]) -> dict[str, Tensor]:
    """Read only the named tensors of a weight file. A bad file can raise any exception."""
    check_regular(path)
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
    """Return the shapes of all weights of a text tower of the standard architecture."""
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
