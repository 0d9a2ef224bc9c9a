"""OpenCLIP models with their weights on a device."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from normlift_ns.encoders.clip.weights import REMEDY, find_weights, import_open_clip
from normlift_ns.encoders.weights import FOREIGN_ERRORS, first_line
from normlift_ns.errors import InputError
from normlift_ns.options import DEFAULT_MODEL


class ClipNetwork(NamedTuple):
    """A model, in half precision on a GPU and in float32 elsewhere, with its tokenizer and preprocessing."""

    model: Any
    tokenizer: Any
    size: tuple[int, int]
    """Height and width of the training images."""
    mean: Float[Tensor, "3 1 1"]
    std: Float[Tensor, "3 1 1"]

    def normalized(self, pixels: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b 3 h w"]:
        """Return pixels, 0..255, on the device, normalized for the model."""
        return ((pixels / 255 - self.mean) / self.std).to(torch.float16 if pixels.is_cuda else torch.float32)


def load_clip(model: str, pretrained: str, device: str) -> ClipNetwork:
    """Load the network of an architecture and weights that have passed `check_names`.

    Raises:
        FileNotFoundError: If the weights or the tokenizer cannot be downloaded.
        ValueError: If the installed packages cannot build the architecture, or the weight file is damaged or of another
            architecture.
    """
    open_clip = import_open_clip()
    path, training = find_weights(model, pretrained)
    try:
        network = open_clip.create_model(
            model,
            pretrained_hf=False,
            precision="fp16" if torch.device(device).type == "cuda" else "fp32",
            force_quick_gelu=training.get("quick_gelu", False),
            force_preprocess_cfg={key: training[key] for key in ("mean", "std") if key in training},
        )
    except FOREIGN_ERRORS as error:
        raise InputError(
            f"OpenCLIP model {model} cannot be built with the packages installed here ({first_line(error)}); choose "
            f"another with --encoder-model, such as {DEFAULT_MODEL}"
        ) from None
    try:
        open_clip.load_checkpoint(network, str(path), weights_only=True)
    except FOREIGN_ERRORS as error:
        raise InputError(
            f"weight file {path} is damaged or not of OpenCLIP model {model} ({first_line(error)}); give its "
            f"architecture with --encoder-model, or {REMEDY}"
        ) from None
    try:
        tokenizer = open_clip.get_tokenizer(model)
    except Exception as error:  # download clients raise exceptions without a common base class
        raise FileNotFoundError(
            f"the tokenizer of OpenCLIP model {model} cannot be loaded ({first_line(error)}); go online once, "
            f"use a model with OpenCLIP's own tokenizer such as {DEFAULT_MODEL}, or use the encoder that needs "
            "none: --encoder colour"
        ) from None
    settings = open_clip.get_model_preprocess_cfg(network)
    size = settings["size"]
    mean, std = (torch.tensor(settings[key], device=device)[:, None, None] for key in ("mean", "std"))
    size = (size, size) if isinstance(size, int) else tuple(size)
    return ClipNetwork(network.to(device).eval().requires_grad_(False), tokenizer, size, mean, std)
