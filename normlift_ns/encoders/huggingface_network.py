"""Encoder of images and prompts that uses Hugging Face networks.

SigLIP pools the tokens of all patches by attention with one learned query. Patch features use only the value path of
this pooling, as MaskCLIP (Zhou, Loy and Dai, ECCV 2022) does for the attention pooling of CLIP's ResNets. After the
final norm, each token passes through the value and output projections of the pooling and the rest of the head.

MetaCLIP 2 has a class token, like CLIP. As in MaskCLIP for vision transformers, each token passes only through the
first norm and the value and output projections of the last layer. The final norm and the projection into the joint
space follow. Position embeddings are interpolated as in transformers.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, cast

import torch
from jaxtyping import Float
from safetensors.torch import load_file
from torch import Tensor
from torch.nn.functional import linear

from normlift_ns.core.device import shared_property
from normlift_ns.encoders import huggingface
from normlift_ns.encoders.crops import NetworkEncoder
from normlift_ns.encoders.weights import third_party_errors
from normlift_ns.errors import InputError
from normlift_ns.io.atomic import file_digest
from normlift_ns.io.guard import check_regular
from normlift_ns.options import CropFill

_CLASSES = {"siglip": "Siglip", "siglip2": "Siglip2", "metaclip_2": "MetaClip2"}
"""Prefixes of class names in transformers, by model type."""


@dataclass
class HuggingFaceNetwork:
    """A network in half precision on a GPU, or in float32 on a CPU. It switches to float32 if half precision
    overflows."""

    model: Any
    tokenizer: Any
    folder: huggingface.ModelFolder
    mean: Float[Tensor, "3 1 1"]
    std: Float[Tensor, "3 1 1"]

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of the images that `images` embeds, in pixels."""
        config, count = self.model.config.vision_config, self.folder.pixels.max_patches
        side = config.image_size if count is None else math.isqrt(count) * config.patch_size
        return side, side

    @property
    def patch_size(self) -> tuple[int, int]:
        """Height and width of a patch, in pixels."""
        side = self.model.config.vision_config.patch_size
        return side, side

    @property
    def width(self) -> int:
        """Embedding dimension D."""
        config = self.model.config
        return config.projection_dim if self._is_clip else config.vision_config.hidden_size

    @property
    def _is_clip(self) -> bool:
        return self.folder.model_type == "metaclip_2"

    def normalized(self, pixels: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b 3 h w"]:
        """Normalize pixels with values in 0..255 for the model, on its device."""
        normalized = (pixels.to(self.mean.dtype) * self.folder.pixels.rescale_factor - self.mean) / self.std
        return normalized.to(self.model.logit_scale.dtype)

    def images(self, pixels: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b d"]:
        """Return unnormalized embeddings of images of size `size` with values in 0..255, on the device."""
        return self._finite(lambda: self._pooled(pixels))

    def patches(self, pixels: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b r d"]:
        """Return unnormalized embeddings of all patches in row-major order; see the module docstring.

        Args:
            pixels: Images with values in 0..255 and sides that are multiples of the patch size, on the device.
        """
        return self._finite(lambda: self._value_path(pixels))

    def texts(self, texts: Sequence[str]) -> Float[Tensor, "b d"]:
        """Return unnormalized embeddings of texts that `ModelFamily.preprocess_text` has prepared.

        Raises:
            InputError: If the tokenizer returns a token that the network does not have, or embeddings are not finite.
        """
        encoded = self.tokenizer.encode_batch(list(texts))
        vocab_size, largest = self.model.config.text_config.vocab_size, max(max(text.ids) for text in encoded)
        if largest >= vocab_size:
            raise InputError(
                f"{huggingface.TOKENIZER_FILE} in {self.folder.path} has the token {largest}, but the network has only "
                f"{vocab_size} tokens; download the folder again"
            )
        inputs = {"input_ids": torch.tensor([text.ids for text in encoded], device=self.mean.device)}
        if self.folder.tokens.attention_mask:
            inputs["attention_mask"] = torch.tensor([x.attention_mask for x in encoded], device=self.mean.device)
        return self._finite(lambda: _pooled_output(self.model.get_text_features(**inputs)))

    def _pooled(self, pixels: Tensor) -> Tensor:
        return _pooled_output(self.model.get_image_features(**self._vision_inputs(pixels)))

    def _vision_inputs(self, pixels: Tensor) -> dict[str, Any]:
        """Return the inputs of the vision transformer."""
        pixels, (side, _) = self.normalized(pixels), self.patch_size
        if self.folder.model_type != "siglip2":
            return {"pixel_values": pixels, "interpolate_pos_encoding": pixels.shape[2:] != self.size}
        rows, columns = pixels.shape[2] // side, pixels.shape[3] // side
        parts = pixels.unflatten(3, (columns, side)).unflatten(2, (rows, side))  # b 3 rows side columns side
        shape = torch.tensor([[rows, columns]], device=pixels.device).expand(len(pixels), 2)
        return {
            "pixel_values": parts.permute(0, 2, 4, 3, 5, 1).flatten(3).flatten(1, 2),
            "pixel_attention_mask": torch.ones(len(pixels), rows * columns, dtype=torch.int32, device=pixels.device),
            "spatial_shapes": shape,
        }

    def _value_path(self, pixels: Tensor) -> Tensor:
        """Return patch embeddings from the value path; see the module docstring."""
        vision = self.model.vision_model
        if self._is_clip:
            last = vision.encoder.layers[-1]
            tokens = last.layer_norm1(self._input_of(last, pixels)[:, 1:])
            mixed = last.self_attn.out_proj(last.self_attn.v_proj(tokens))
            return self.model.visual_projection(vision.post_layernorm(mixed))
        head = vision.head
        tokens = self._input_of(head, pixels)
        weight, bias = (x.chunk(3)[2] for x in (head.attention.in_proj_weight, head.attention.in_proj_bias))
        mixed = head.attention.out_proj(linear(tokens, weight, bias))
        return mixed + head.mlp(head.layernorm(mixed))

    def _input_of(self, module: Any, pixels: Tensor) -> Tensor:
        """Run the network on images, and return the input of one of its modules."""
        recorded: list[Tensor] = []
        hook = module.register_forward_pre_hook(lambda _, inputs: recorded.append(inputs[0]))
        try:
            self._pooled(pixels)
        finally:
            hook.remove()
        return recorded[0]

    @torch.no_grad()
    def _finite(self, compute: Callable[[], Tensor]) -> Tensor:
        """Compute embeddings, in float32 if half precision overflows; raise InputError if any are not finite."""
        rows = compute()
        if rows.dtype == torch.float16 and not bool(rows.isfinite().all()):
            self.model.float()
            rows = compute()
        if not bool(rows.isfinite().all()):
            raise InputError(
                f"the network in {self.folder.path} returns vectors that are not finite; download it again"
            )
        return rows


def _pooled_output(output: Any) -> Tensor:
    """Return the embeddings, which transformers 4 returns directly and transformers 5 inside an output object."""
    return output if isinstance(output, Tensor) else output.pooler_output


def load_huggingface_network(
    folder: huggingface.ModelFolder, family: huggingface.ModelFamily, device: str
) -> HuggingFaceNetwork:
    """Load the network of a model folder.

    Raises:
        InputError: If a file is damaged, the weights do not match the configuration, or transformers does not support
            the network.
    """
    remedy = (
        f"lift with --encoder-model set to another folder or to a name such as {family.default_model}, or with "
        "--encoder open_clip"
    )
    with third_party_errors(f"{folder.path} cannot be loaded as a {family.title} network", remedy):
        model = _build_model(folder)
        tokenizer = _load_tokenizer(folder, model.config.text_config)
    half = torch.device(device).type == "cuda"
    model = model.to(device, torch.float16 if half else torch.float32).eval().requires_grad_(False)
    mean, std = (torch.tensor(x, device=device)[:, None, None] for x in (folder.pixels.mean, folder.pixels.std))
    return HuggingFaceNetwork(model, tokenizer, folder, mean, std)


def _build_model(folder: huggingface.ModelFolder) -> Any:
    """Build the model from the checked sizes, and load its weights in float32.

    Raises:
        InputError: If the image sizes of the preprocessing and of the network differ, or a weight is not a float.
        Exception: If the weights do not match the model, or cannot be read.
    """
    transformers = importlib.import_module("transformers")
    name = _CLASSES[folder.model_type]
    config = getattr(transformers, f"{name}Config")(
        text_config=folder.text, vision_config=folder.vision, **folder.sizes
    )
    vision, pixels = config.vision_config, folder.pixels
    if pixels.image_size is not None and pixels.image_size != vision.image_size:
        raise InputError(
            f"images are preprocessed to {pixels.image_size} pixels, but the network expects {vision.image_size}"
        )
    with torch.device("meta"):
        model = getattr(transformers, f"{name}Model")(config)
    for file in folder.weights:
        check_regular(file)
    state = {name: value for file in folder.weights for name, value in load_file(file).items()}
    state = {name: value for name, value in state.items() if not name.endswith(".position_ids")}
    integers = [name for name, value in state.items() if not value.is_floating_point()]
    if len(integers) > 0:
        raise InputError(f"the weight {integers[0]} has type {state[integers[0]].dtype}, expected floats")
    model.load_state_dict({name: value.float() for name, value in state.items()}, assign=True)
    for name, buffer in [*model.named_buffers()]:  # position_ids, which are not in weight files
        owner = model.get_submodule(name.rpartition(".")[0])
        setattr(owner, name.rpartition(".")[2], torch.arange(buffer.shape[-1])[None])
    return model


def _load_tokenizer(folder: huggingface.ModelFolder, config: Any) -> Any:
    """Load the tokenizer, and set it to pad or truncate texts to the length used in training.

    Raises:
        InputError: If the tokenizer does not have the padding token.
        Exception: If the file cannot be read.
    """
    tokenizer = importlib.import_module("tokenizers").Tokenizer.from_file(str(folder.path / huggingface.TOKENIZER_FILE))
    length, tokens = cast(int, config.max_position_embeddings), folder.tokens
    pad_id = tokenizer.token_to_id(tokens.pad_token)
    if pad_id is None:
        raise InputError(f"{huggingface.TOKENIZER_FILE} does not contain the padding token {tokens.pad_token!r:.40}")
    tokenizer.enable_truncation(length)
    tokenizer.enable_padding(direction=tokens.padding_side, pad_id=pad_id, pad_token=tokens.pad_token, length=length)
    return tokenizer


@dataclass(frozen=True)
class HuggingFaceEncoder(NetworkEncoder):
    """An encoder with a SigLIP, SigLIP 2 or MetaCLIP 2 network; see `NetworkEncoder`.

    Raises:
        ValueError: If the model is neither a folder nor a hub name, or the template has no placeholder.
        FileNotFoundError: If the folder does not exist.
    """

    family: huggingface.ModelFamily
    model: str
    """Folder, or name on the Hugging Face hub."""
    fill: CropFill = "black"  # pyrefly: ignore[bad-override]
    device: str = "cpu"  # pyrefly: ignore[bad-override]
    template: str = "{}"  # pyrefly: ignore[bad-override]

    def _check_names(self) -> None:
        huggingface.check_model_name(self.model, self.family)

    @shared_property
    def _identity(self) -> dict[str, Any]:
        """Settings that change image features. Files are identified by their content, and downloaded if missing."""
        return {"kind": self.family.name, "weights": file_digest(*self._folder.files), "fill": self.fill}

    @shared_property
    def network(self) -> HuggingFaceNetwork:
        return load_huggingface_network(self._folder, self.family, self.device)

    def _width(self) -> int:
        return self.network.width

    def _prepare(self, prompt: str, text: str) -> str:
        text = self.family.preprocess_text(text)
        if not text.strip():
            raise InputError(
                f"prompt {prompt!r} consists only of punctuation, which {self.family.title} ignores; use words"
            )
        return text

    @shared_property
    def _folder(self) -> huggingface.ModelFolder:
        return huggingface.read_model_folder(huggingface.fetch_model(self.model, self.family), self.family)
