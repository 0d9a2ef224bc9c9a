"""OpenCLIP as an encoder: masked square crops of regions, as LangSplat cuts them, against texts.

For every region: pixels outside of it are filled, the image is cropped to its box, padded with black to a centred
square, resized bilinearly to the size of the model and normalised with the model's mean and standard deviation.
LangSplat fills with black; LaGa and SFS fill with white (and pad with black too). LangSplat's boxes, which come from
SAM, leave out the last row and column of a mask; ours do not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import torch
from jaxtyping import Float, Float32, Int32, UInt8
from scipy.ndimage import find_objects
from torch import Tensor
from torch.nn.functional import interpolate, normalize, pad

from normlift_ns.encoders.clip_weights import (
    DEFAULT_MODEL,
    DEFAULT_PRETRAINED,
    REMEDY,
    check_names,
    find_weights,
    import_open_clip,
)
from normlift_ns.encoders.source import check_prompts
from normlift_ns.encoders.weights import content_identity, first_line

Fill = Literal["black", "white"]
_BATCH = 64


class _Network(NamedTuple):
    model: Any
    tokenizer: Any
    size: tuple[int, int]
    mean: Tensor
    std: Tensor


@dataclass(frozen=True)
class OpenClipEncoder:
    """CLIP features of masked crops, by open_clip. The weights are loaded at the first use: in half precision on a
    GPU, in float32 elsewhere; vectors are normalised in float32.

    Raises:
        ValueError: a model or a tag of weights that open_clip does not know, an unknown fill.
        FileNotFoundError: a weight file that does not exist.
    """

    model: str = DEFAULT_MODEL
    """Architecture, a name of open_clip.list_models()."""
    pretrained: str = DEFAULT_PRETRAINED
    """Tag of weights to download, or a weight file of that architecture. Pickles are read with weights_only=True."""
    fill: Fill = "black"
    """What the pixels outside of a region become."""
    device: str = "cpu"
    """Where the network runs; results are on the CPU anyway."""

    def __post_init__(self) -> None:
        if self.fill not in get_args(Fill):
            raise ValueError(f"fill of crops must be one of {', '.join(get_args(Fill))}; got {self.fill!r}")
        check_names(self.model, self.pretrained)

    @property
    def identity(self) -> dict[str, Any]:
        """A weight file counts by its content, wherever it lies."""
        return {"kind": "open_clip", "model": self.model, "pretrained": self._weights_identity, "fill": self.fill}

    def encode(self, image: UInt8[Tensor, "h w 3"], labels: Int32[Tensor, "h w"]) -> Float32[Tensor, "r d"]:
        """As in `Encoder`.

        Raises:
            FileNotFoundError: the weights cannot be downloaded.
            ValueError: a weight file that is damaged or of another architecture.
        """
        boxes = find_objects(labels.numpy() + 1)
        features = torch.empty(len(boxes), import_open_clip().get_model_config(self.model)["embed_dim"])
        image, labels = image.to(self.device), labels.to(self.device)
        for first in range(0, len(boxes), _BATCH):
            crops = [
                masked_crop(image, labels, region, box, self._network.size, self.fill)
                for region, box in enumerate(boxes[first : first + _BATCH], start=first)
            ]
            features[first : first + _BATCH] = self._encode_crops(torch.stack(crops))
        return features

    def text(self, prompts: Sequence[str]) -> Float32[Tensor, "q d"]:
        """One unit row per prompt; raises as `encode`, and ValueError for an empty prompt or none."""
        check_prompts(prompts)
        tokens = self._network.tokenizer(list(prompts)).to(self.device)
        with torch.no_grad():
            rows = [self._network.model.encode_text(batch).float() for batch in tokens.split(_BATCH)]
        return normalize(torch.cat(rows), dim=1).cpu()

    @torch.no_grad()
    def _encode_crops(self, crops: Tensor) -> Tensor:
        pixels = (crops / 255 - self._network.mean) / self._network.std
        if torch.device(self.device).type == "cuda":
            pixels = pixels.half()
        return normalize(self._network.model.encode_image(pixels).float(), dim=1).cpu()

    @cached_property
    def _weights_identity(self) -> str:
        path = Path(self.pretrained)
        return content_identity(path) if path.is_file() else self.pretrained

    @cached_property
    def _network(self) -> _Network:
        open_clip = import_open_clip()
        path, training = find_weights(self.model, self.pretrained)
        try:
            model = open_clip.create_model(
                self.model,
                pretrained=str(path),
                precision="fp16" if torch.device(self.device).type == "cuda" else "fp32",
                force_quick_gelu=training.get("quick_gelu", False),
                force_preprocess_cfg={key: training[key] for key in ("mean", "std") if key in training},
            )
        except Exception as error:  # whatever a foreign file makes torch, safetensors and open_clip raise
            raise ValueError(
                f"weight file {path} is damaged or not of OpenCLIP model {self.model} ({first_line(error)}); name its "
                f"architecture with --encoder-model, or {REMEDY}"
            ) from None
        try:
            tokenizer = open_clip.get_tokenizer(self.model)
        except Exception as error:  # whatever a download makes its libraries raise
            raise FileNotFoundError(
                f"the tokenizer of OpenCLIP model {self.model} cannot be had ({first_line(error)}); go online once, "
                f"use a model with OpenCLIP's own tokenizer such as {DEFAULT_MODEL}, or use the encoder that needs "
                "none: --encoder colour"
            ) from None
        settings = open_clip.get_model_preprocess_cfg(model)
        size = settings["size"]
        mean, std = (torch.tensor(settings[key], device=self.device)[:, None, None] for key in ("mean", "std"))
        size = (size, size) if isinstance(size, int) else tuple(size)
        return _Network(model.to(self.device).eval(), tokenizer, size, mean, std)


def masked_crop(
    image: UInt8[Tensor, "h w 3"],
    labels: Int32[Tensor, "h w"],
    region: int,
    box: tuple[slice, slice],
    size: tuple[int, int],
    fill: Fill,
) -> Float[Tensor, "3 size_y size_x"]:
    """One region, 0..255, as the top of this file describes it.

    Args:
        box: rows and columns that hold the region.
        size: height and width of the result.
    """
    outside = (labels[box] != region)[:, :, None]
    crop = image[box].float().masked_fill(outside, 255.0 if fill == "white" else 0.0).permute(2, 0, 1)
    height, width = crop.shape[1:]
    side = max(height, width)
    left, top = (side - width) // 2, (side - height) // 2
    square = pad(crop, (left, side - width - left, top, side - height - top))
    return interpolate(square[None], size, mode="bilinear", align_corners=False)[0]
