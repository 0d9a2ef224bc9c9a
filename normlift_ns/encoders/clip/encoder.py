"""OpenCLIP as an encoder: masked square crops of regions against texts."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple, cast, get_args

import torch
from jaxtyping import Float, Float32, Int32, Int64, UInt8
from torch import Tensor
from torch.nn.functional import normalize

from normlift_ns.core.disk.digests import file_digest
from normlift_ns.encoders.batches import Batches
from normlift_ns.encoders.clip.architectures import model_config, open_clip_part
from normlift_ns.encoders.clip.crops import masked_crops, region_boxes
from normlift_ns.encoders.clip.network import ClipNetwork, load_clip
from normlift_ns.encoders.clip.text_tower import ENSEMBLE
from normlift_ns.encoders.clip.weights import check_names
from normlift_ns.encoders.texts.prompts import check_prompts
from normlift_ns.errors import InputError
from normlift_ns.options import DEFAULT_MODEL, DEFAULT_PRETRAINED, Fill

_BATCH = {"cuda": 256, "cpu": 64}


@dataclass(frozen=True)
class OpenClipEncoder:
    """CLIP features of masked crops, by open_clip. The weights are loaded at the first use: in half precision on a
    GPU, in float32 elsewhere; vectors are normalised in float32.

    Raises:
        ValueError: a model or a tag of weights that open_clip does not know, a model that the installed timm does not
            know, an unknown fill, a template without a place for the text.
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
    template: str = "{}"
    """What the network reads for a text, which takes the place of {}; "ensemble": the mean of open_clip's seven."""

    def __post_init__(self) -> None:
        if self.fill not in get_args(Fill):
            raise InputError(f"fill of crops must be one of {', '.join(get_args(Fill))}; got {self.fill!r}")
        if self.template != ENSEMBLE and "{}" not in self.template:
            raise InputError(
                f"text template {self.template!r} has no {{}} where the text belongs; write it like "
                f'"a photo of a {{}}", or {ENSEMBLE} for the mean of several'
            )
        check_names(self.model, self.pretrained)

    @property
    def identity(self) -> dict[str, Any]:
        """A weight file counts by its content, wherever it lies."""
        return {"kind": "open_clip", "model": self.model, "pretrained": self._weights_identity, "fill": self.fill}

    def encode(self, image: UInt8[Tensor, "h w 3"], labels: Int32[Tensor, "depth h w"]) -> Float32[Tensor, "r d"]:
        """As in `Encoder`.

        Raises:
            FileNotFoundError: the weights cannot be downloaded.
            ValueError: a weight file that is damaged or of another architecture.
            MemoryError: the memory of the device does not hold a single crop.
        """
        return next(self.encode_each([(image, labels)]))

    def encode_each(
        self, views: Iterable[tuple[UInt8[Tensor, "h w 3"], Int32[Tensor, "depth h w"]]]
    ) -> Iterator[Float32[Tensor, "r d"]]:
        """As in `Encoder`: crops of several views fill a batch; raises as `encode`."""
        seen: dict[int, _Seen] = {}

        def crops() -> Iterator[list[tuple[int, int]]]:
            for number, (image, labels) in enumerate(views):
                there = labels.to(self.device)
                seen[number] = _Seen(image.to(self.device), there, region_boxes(there))
                yield [(number, region) for region in range(len(seen[number].boxes))]

        def encode(batch: Sequence[tuple[int, int]]) -> Tensor:
            cut = []
            for number, crops_of_view in groupby(batch, itemgetter(0)):
                image, labels, boxes = seen[number]
                regions = torch.tensor([region for _, region in crops_of_view], device=self.device)
                cut.append(masked_crops(image, labels, regions, boxes[regions], self.network.size, self.fill))
            return self._image_rows(torch.cat(cut))

        for number, rows in enumerate(self._crops.across(encode, crops())):
            del seen[number]
            none = torch.empty(0, cast(Any, model_config(self.model))["embed_dim"])
            yield torch.stack(rows) if len(rows) > 0 else none

    def text(self, prompts: Sequence[str]) -> Float32[Tensor, "q d"]:
        """One unit row per prompt; raises as `encode`, and ValueError for an empty prompt or none."""
        check_prompts(prompts)
        templates = _templates(self.template)
        tokens = self.network.tokenizer([template(prompt) for prompt in prompts for template in templates])
        rows = torch.cat(list(self._texts(self._text_rows, tokens.to(self.device))))
        return normalize(rows.unflatten(0, (len(prompts), len(templates))).mean(dim=1), dim=1)

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
        """The model with its weights, loaded at the first use; raises as `encode`."""
        return load_clip(self.model, self.pretrained, self.device)

    @cached_property
    def _crops(self) -> Batches:
        return Batches(_BATCH[torch.device(self.device).type])

    @cached_property
    def _texts(self) -> Batches:
        return Batches(_BATCH[torch.device(self.device).type])


class _Seen(NamedTuple):
    """A view, on the device, whose regions wait for a batch."""

    image: UInt8[Tensor, "h w 3"]
    labels: Int32[Tensor, "depth h w"]
    boxes: Int64[Tensor, "r 4"]


def _templates(template: str) -> Sequence[Callable[[str], str]]:
    if template == ENSEMBLE:
        return open_clip_part("zero_shot_metadata").SIMPLE_IMAGENET_TEMPLATES
    return [lambda text: template.replace("{}", text)]
