"""Encoder with networks of transformers: masked square crops of regions, or patches, compared with text."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, get_args

import torch
from jaxtyping import Float, Float32, Int32, UInt8
from torch import Tensor
from torch.nn.functional import normalize

from normlift_ns.core.disk.digests import file_digest
from normlift_ns.encoders.batches import Batches
from normlift_ns.encoders.clip.crops import CropNetwork, crop_features
from normlift_ns.encoders.hub.families import FAMILIES, Family
from normlift_ns.encoders.hub.folder import Folder, read_folder
from normlift_ns.encoders.hub.network import HubNetwork, load_network
from normlift_ns.encoders.hub.places import check_name, fetch_folder
from normlift_ns.encoders.patches import scaled
from normlift_ns.encoders.texts.prompts import check_prompts
from normlift_ns.encoders.texts.templates import check_template, templates_of
from normlift_ns.errors import InputError
from normlift_ns.options import Fill

_BATCH_SIZE = {"cuda": 128, "cpu": 8}


@dataclass(frozen=True)
class HubEncoder:
    """SigLIP, SigLIP 2 or MetaCLIP 2 features of masked crops. The weights are loaded at their first use, in half
    precision on a GPU and in float32 elsewhere. Vectors are normalized in float32.

    Raises:
        ValueError: If the model is neither a folder nor a hub name, the fill is unknown, or the template has no
            placeholder for the text.
        FileNotFoundError: If the folder does not exist.
    """

    kind: str
    """siglip, siglip2 or metaclip2."""
    model: str
    """Folder, or name on the hub."""
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
        check_name(self.model, self.family)

    @property
    def family(self) -> Family:
        """The family of the network."""
        return FAMILIES[self.kind]

    @property
    def identity(self) -> dict[str, Any]:
        """Settings of the image features. The network is identified by the content of its files, which are downloaded
        if missing."""
        return {"kind": self.kind, "weights": self._digest, "fill": self.fill}

    @property
    def why_not_dense(self) -> None:
        """None, because all networks of these families have patches."""

    def encode(self, image: UInt8[Tensor, "h w 3"], labels: Int32[Tensor, "depth h w"]) -> Float32[Tensor, "r d"]:
        """Return one unit row per region; see `Encoder.encode`.

        Raises:
            FileNotFoundError: If the network cannot be downloaded.
            ValueError: If the folder is damaged or of another architecture.
            MemoryError: If not even one crop fits into the memory of the device.
        """
        return next(self.encode_each([(image, labels)]))

    def encode_each(
        self, views: Iterable[tuple[UInt8[Tensor, "h w 3"], Int32[Tensor, "depth h w"]]]
    ) -> Iterator[Float32[Tensor, "r d"]]:
        """Yield the features of several views; their crops share batches. Raises as `encode`."""
        network = CropNetwork(lambda: self.network.size, self._image_rows, lambda: self.network.width)
        return crop_features(views, network, self._crops, self.fill, self.device)

    def patches(self, image: UInt8[Tensor, "h w 3"], rows: int, columns: int) -> Float32[Tensor, "r d"]:
        """Return one unit row per patch, see `DenseEncoder.patches`; formulas in `hub.network`."""
        side = self.network.patch
        pixels = scaled(image.to(self.device), rows * side, columns * side)
        return normalize(self.network.patches(pixels)[0].float(), dim=1).cpu()

    def text(self, prompts: Sequence[str]) -> Float32[Tensor, "q d"]:
        """Return one unit row per prompt; raises as `encode`, and ValueError if `prompts` or a prompt is empty."""
        check_prompts(prompts)
        templates = templates_of(self.template)
        texts = [self.family.read(template(prompt)) for prompt in prompts for template in templates]
        empty = [i for i, text in enumerate(texts) if not text.strip()]
        if len(empty) > 0:
            raise InputError(
                f"text {prompts[empty[0] // len(templates)]!r} has no letters or digits, and {self.family.title} "
                "ignores everything else; use words"
            )
        rows = torch.cat(list(self._texts(self._text_rows, texts)))
        return normalize(rows.unflatten(0, (len(prompts), len(templates))).mean(dim=1), dim=1)

    def _image_rows(self, crops: Float[Tensor, "b 3 y x"]) -> Float32[Tensor, "b d"]:
        return normalize(self.network.images(crops).float(), dim=1).cpu()

    def _text_rows(self, texts: Sequence[str]) -> Float32[Tensor, "b d"]:
        return normalize(self.network.texts(texts).float(), dim=1).cpu()

    @cached_property
    def _folder(self) -> Folder:
        return read_folder(fetch_folder(self.model, self.family), self.family)

    @cached_property
    def _digest(self) -> str:
        return file_digest(*self._folder.files)

    @cached_property
    def network(self) -> HubNetwork:
        """The network with its weights, loaded at its first use; raises as `encode`."""
        return load_network(self._folder, self.family, self.device)

    @cached_property
    def _crops(self) -> Batches:
        return Batches(_BATCH_SIZE[torch.device(self.device).type])

    @cached_property
    def _texts(self) -> Batches:
        return Batches(_BATCH_SIZE[torch.device(self.device).type])
