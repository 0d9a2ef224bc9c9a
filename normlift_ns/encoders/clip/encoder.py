"""OpenCLIP encoder: masked square crops of regions, compared with text."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, cast, get_args

import torch
from jaxtyping import Float, Float32, Int32, UInt8
from torch import Tensor
from torch.nn.functional import normalize

from normlift_ns.core.disk.digests import file_digest
from normlift_ns.encoders.batches import Batches
from normlift_ns.encoders.clip.architectures import model_config
from normlift_ns.encoders.clip.crops import CropNetwork, crop_features
from normlift_ns.encoders.clip.network import ClipNetwork, load_clip
from normlift_ns.encoders.clip.patches import dense_tokens, why_not_dense
from normlift_ns.encoders.clip.weights import check_names
from normlift_ns.encoders.patches import scaled
from normlift_ns.encoders.texts.prompts import check_prompts
from normlift_ns.encoders.texts.templates import check_template, templates_of
from normlift_ns.errors import InputError
from normlift_ns.options import DEFAULT_MODEL, DEFAULT_PRETRAINED, Fill

_BATCH_SIZE = {"cuda": 128, "cpu": 8}


@dataclass(frozen=True)
class OpenClipEncoder:
    """CLIP features of masked crops, computed with open_clip. The weights are loaded at their first use, in half
    precision on a GPU and in float32 elsewhere. Vectors are normalized in float32.

    Raises:
        ValueError: If open_clip or the installed timm does not know the model, or open_clip does not know the weights
            tag. Also if the fill is unknown, or the template has no placeholder for the text.
        FileNotFoundError: If a weight file does not exist.
    """

    model: str = DEFAULT_MODEL
    """Architecture, a name in open_clip.list_models()."""
    pretrained: str = DEFAULT_PRETRAINED
    """Tag of weights to download, or a weight file of that architecture. Pickles are read with weights_only=True."""
    fill: Fill = "black"
    """Color of the pixels outside of a region."""
    device: str = "cpu"
    """Device of the network; results are always on the CPU."""
    template: str = "{}"
    """Prompt template, with {} in place of the text; "ensemble": the mean over open_clip's seven templates."""

    def __post_init__(self) -> None:
        if self.fill not in get_args(Fill):
            raise InputError(f"crop fill must be one of {', '.join(get_args(Fill))}; got {self.fill!r}")
        check_template(self.template)
        check_names(self.model, self.pretrained)

    @property
    def identity(self) -> dict[str, Any]:
        """Settings of the image features. A weight file is identified by its content, independent of its path."""
        return {"kind": "open_clip", "model": self.model, "pretrained": self._weights_identity, "fill": self.fill}

    def encode(self, image: UInt8[Tensor, "h w 3"], labels: Int32[Tensor, "depth h w"]) -> Float32[Tensor, "r d"]:
        """Return one unit row per region; see `Encoder.encode`.

        Raises:
            FileNotFoundError: If the weights cannot be downloaded.
            ValueError: If the weight file is damaged or of another architecture.
            MemoryError: If not even one crop fits into the memory of the device.
        """
        return next(self.encode_each([(image, labels)]))

    def encode_each(
        self, views: Iterable[tuple[UInt8[Tensor, "h w 3"], Int32[Tensor, "depth h w"]]]
    ) -> Iterator[Float32[Tensor, "r d"]]:
        """Yield the features of several views; their crops share batches. Raises as `encode`."""
        network = CropNetwork(lambda: self.network.size, self._image_rows, self._width)
        return crop_features(views, network, self._crops, self.fill, self.device)

    @property
    def why_not_dense(self) -> str | None:
        reason = why_not_dense(self.model)
        if reason is None:
            return None
        return (
            f"--regions patches needs a vision transformer of open_clip, which {self.model} is not: {reason}. "
            f"Use --encoder-model {DEFAULT_MODEL}, or other regions"
        )

    def patches(self, image: UInt8[Tensor, "h w 3"], rows: int, columns: int) -> Float32[Tensor, "r d"]:
        visual = self.network.model.visual
        patch_height, patch_width = visual.patch_size
        pixels = self.network.normalized(scaled(image.to(self.device), rows * patch_height, columns * patch_width))
        return normalize(dense_tokens(visual, pixels)[0].float(), dim=1).cpu()

    def text(self, prompts: Sequence[str]) -> Float32[Tensor, "q d"]:
        """Return one unit row per prompt; raises as `encode`, and ValueError if `prompts` or a prompt is empty."""
        check_prompts(prompts)
        templates = templates_of(self.template)
        tokens = self.network.tokenizer([template(prompt) for prompt in prompts for template in templates])
        rows = torch.cat(list(self._texts(self._text_rows, tokens.to(self.device))))
        return normalize(rows.unflatten(0, (len(prompts), len(templates))).mean(dim=1), dim=1)

    def _width(self) -> int:
        return cast(Any, model_config(self.model))["embed_dim"]

    @torch.no_grad()
    def _image_rows(self, crops: Float[Tensor, "b 3 y x"]) -> Float32[Tensor, "b d"]:
        return normalize(self.network.model.encode_image(self.network.normalized(crops)).float(), dim=1).cpu()

    @torch.no_grad()
    def _text_rows(self, tokens: Tensor) -> Float32[Tensor, "b d"]:
        return normalize(self.network.model.encode_text(tokens).float(), dim=1).cpu()

    @cached_property
    def _weights_identity(self) -> str:
        path = Path(self.pretrained)
        return file_digest(path) if path.is_file() else self.pretrained

    @cached_property
    def network(self) -> ClipNetwork:
        """The model with its weights, loaded at its first use; raises as `encode`."""
        return load_clip(self.model, self.pretrained, self.device)

    @cached_property
    def _crops(self) -> Batches:
        return Batches(_BATCH_SIZE[torch.device(self.device).type])

    @cached_property
    def _texts(self) -> Batches:
        return Batches(_BATCH_SIZE[torch.device(self.device).type])
