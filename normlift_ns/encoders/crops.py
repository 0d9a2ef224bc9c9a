"""Encoders that embed masked square crops of regions with a joint image-text network.

As in LangSplat, pixels outside a region are filled, and the image is cropped to the bounding box of the region. The
crop is then padded with black to a centered square and resized bilinearly. LangSplat fills with black. LaGa and Splat
Feature Solver fill with white, and also pad with black. LangSplat's boxes come from SAM and omit the last row and
column of a mask; the boxes of this module include them.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Sequence
from functools import cached_property
from itertools import groupby
from operator import itemgetter
from typing import Any, NamedTuple, Protocol

import torch
from jaxtyping import Float, Float32, Int32, Int64, UInt8
from torch import Tensor
from torch.nn.functional import normalize

from normlift_ns.core.device import AdaptiveBatches
from normlift_ns.encoders.base import resize_image
from normlift_ns.encoders.text_files import check_prompts, check_template, prompt_templates
from normlift_ns.options import CropFill

_GPU_BATCH, _BATCH = 128, 8
"""Largest number of crops or texts per batch on a GPU, and on a CPU."""


class JointNetwork(Protocol):
    """A joint image-text network with loaded weights. Its embeddings are on its device and not normalized."""

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of the images that `images` embeds, in pixels."""
        ...

    @property
    def patch_size(self) -> tuple[int, int]:
        """Height and width of a patch, in pixels."""
        ...

    def images(self, pixels: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b d"]:
        """Embed images of size `size` with values in 0..255, on the device of the network."""
        ...

    def patches(self, pixels: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b r d"]:
        """Embed all patches of images in row-major order.

        Args:
            pixels: Images with values in 0..255 and sides that are multiples of `patch_size`, on the device.
        """
        ...

    def texts(self, texts: Sequence[str]) -> Float[Tensor, "b d"]:
        """Embed texts."""
        ...


class NetworkEncoder(ABC):
    """Base class of encoders (`DenseEncoder`) that embed masked crops or patches with a joint network.

    Weights are loaded at first use, in half precision on a GPU and in float32 on a CPU. Vectors are normalized in
    float32. Subclasses are frozen dataclasses that identify and load a network.
    """

    fill: CropFill
    """Color of the pixels outside a region."""
    device: str
    """Device of the network; results are always on the CPU."""
    template: str
    """Prompt template with the placeholder {}, or "ensemble" for the mean over open_clip's seven templates."""

    def __post_init__(self) -> None:
        check_template(self.template)
        self._check_names()

    @abstractmethod
    def _check_names(self) -> None:
        """Check the name of the network without loading or downloading anything."""

    @property
    def identity(self) -> dict[str, Any]:
        """Settings that change image features. Files are identified by their content, not by their path."""
        return self._identity

    @cached_property
    @abstractmethod
    def _identity(self) -> dict[str, Any]:
        """Value of `identity`. Subclasses must override it."""

    @property
    def why_not_dense(self) -> str | None:
        """See `DenseEncoder.why_not_dense`."""
        return None

    @cached_property
    @abstractmethod
    def network(self) -> JointNetwork:
        """The network with its weights, loaded at first use. Raises the same errors as `encode`."""

    @abstractmethod
    def _width(self) -> int:
        """Return the embedding dimension D."""

    def _prepare(self, prompt: str, text: str) -> str:
        """Return the form of `text` that the tokenizer expects. `text` is a template filled with `prompt`."""
        return text

    def encode(self, image: UInt8[Tensor, "h w 3"], labels: Int32[Tensor, "depth h w"]) -> Float32[Tensor, "r d"]:
        """Return one unit vector per region; see `Encoder.encode`.

        Raises:
            FileNotFoundError: If the weights cannot be downloaded.
            ValueError: If the weights are damaged or belong to another architecture.
            MemoryError: If the memory of the device is too small for a single crop.
        """
        return next(self.encode_each([(image, labels)]))

    def encode_each(
        self, views: Iterable[tuple[UInt8[Tensor, "h w 3"], Int32[Tensor, "depth h w"]]]
    ) -> Iterator[Float32[Tensor, "r d"]]:
        """Yield the features of several views, whose crops share batches. Raises the same errors as `encode`."""
        pending: dict[int, _PendingView] = {}

        def crop_ids() -> Iterator[list[tuple[int, int]]]:
            for number, (image, labels) in enumerate(views):
                device_labels = labels.to(self.device)
                pending[number] = _PendingView(image.to(self.device), device_labels, region_boxes(device_labels))
                yield [(number, region) for region in range(len(pending[number].boxes))]

        def encode(batch: Sequence[tuple[int, int]]) -> Tensor:
            crops = []
            for number, crops_of_view in groupby(batch, itemgetter(0)):
                image, labels, boxes = pending[number]
                regions = torch.tensor([region for _, region in crops_of_view], device=self.device)
                crops.append(masked_crops(image, labels, regions, boxes[regions], self.network.size, self.fill))
            return self._image_rows(torch.cat(crops))

        for number, rows in enumerate(self._crops.map_across(encode, crop_ids())):
            del pending[number]
            yield torch.stack(rows) if len(rows) > 0 else torch.empty(0, self._width())

    def patches(self, image: UInt8[Tensor, "h w 3"], rows: int, columns: int) -> Float32[Tensor, "r d"]:
        """Return one unit vector per patch; see `DenseEncoder.patches`."""
        height, width = self.network.patch_size
        pixels = resize_image(image.to(self.device), rows * height, columns * width)
        return normalize(self.network.patches(pixels)[0].float(), dim=1).cpu()

    def text(self, prompts: Sequence[str]) -> Float32[Tensor, "q d"]:
        """Return one unit vector per prompt.

        Raises:
            ValueError: If `prompts` or a prompt is empty, or the network ignores all characters of a prompt.
            FileNotFoundError, ValueError, MemoryError: For the same reasons as `encode`.
        """
        check_prompts(prompts)
        templates = prompt_templates(self.template)
        texts = [self._prepare(prompt, template(prompt)) for prompt in prompts for template in templates]
        rows = torch.cat(list(self._texts(self._text_rows, texts)))
        return normalize(rows.unflatten(0, (len(prompts), len(templates))).mean(dim=1), dim=1)

    @torch.no_grad()
    def _image_rows(self, crops: Float[Tensor, "b 3 y x"]) -> Float32[Tensor, "b d"]:
        return normalize(self.network.images(crops).float(), dim=1).cpu()

    @torch.no_grad()
    def _text_rows(self, texts: Sequence[str]) -> Float32[Tensor, "b d"]:
        return normalize(self.network.texts(texts).float(), dim=1).cpu()

    @cached_property
    def _crops(self) -> AdaptiveBatches:
        return _batches(self.device)

    @cached_property
    def _texts(self) -> AdaptiveBatches:
        return _batches(self.device)


def _batches(device: str) -> AdaptiveBatches:
    return AdaptiveBatches(_GPU_BATCH if torch.device(device).type == "cuda" else _BATCH)


class _PendingView(NamedTuple):
    """A view whose regions are not all encoded yet. Its tensors are on the device of the network."""

    image: UInt8[Tensor, "h w 3"]
    labels: Int32[Tensor, "depth h w"]
    boxes: Int64[Tensor, "r 4"]


def region_boxes(labels: Int32[Tensor, "depth h w"]) -> Int64[Tensor, "r 4"]:
    """Return the bounding box (x0, y0, x1, y1) of each region, in pixels and with inclusive ends."""
    depth, y, x = (labels >= 0).nonzero(as_tuple=True)
    region = labels[depth, y, x].long()
    count = int(region.max()) + 1 if len(region) > 0 else 0
    ends = ((x, "amin"), (y, "amin"), (x, "amax"), (y, "amax"))
    columns = [x.new_zeros(count).scatter_reduce(0, region, at, reduce, include_self=False) for at, reduce in ends]
    return torch.stack(columns, dim=1)


def masked_crops(
    image: UInt8[Tensor, "h w 3"],
    labels: Int32[Tensor, "depth h w"],
    regions: Int64[Tensor, " b"],
    boxes: Int64[Tensor, "b 4"],
    size: tuple[int, int],
    fill: CropFill,
) -> Float[Tensor, "b 3 size_y size_x"]:
    """Return masked crops of regions, with values in 0..255; see the module docstring.

    Args:
        labels: Region ids. A region consists of all pixels that have its id at any depth.
        boxes: Boxes of these regions from `region_boxes`.
        size: Height and width of the crops, in pixels.
    """
    x0, y0, x1, y1 = boxes.T
    width, height = x1 - x0 + 1, y1 - y0 + 1
    side = torch.maximum(width, height)
    rows = _bilinear_samples(side, (side - height) // 2, height, y0, size[0])
    columns = _bilinear_samples(side, (side - width) // 2, width, x0, size[1])
    outside = 255.0 if fill == "white" else 0.0
    crops = torch.zeros(len(regions), *size, 3, device=image.device)
    for y, row_weight, row_inside in rows:
        for x, column_weight, column_inside in columns:
            at = y[:, :, None], x[:, None, :]
            inside = torch.zeros(len(regions), *size, dtype=torch.bool, device=image.device)
            for layer in labels:
                inside |= layer[at] == regions[:, None, None]
            pixels = torch.where(inside[:, :, :, None], image[at].float(), outside)
            weight = (row_weight * row_inside)[:, :, None] * (column_weight * column_inside)[:, None, :]
            crops += weight[:, :, :, None] * pixels
    return crops.permute(0, 3, 1, 2)


def _bilinear_samples(
    side: Tensor, margin: Tensor, length: Tensor, start: Tensor, size: int
) -> list[tuple[Tensor, Tensor, Tensor]]:
    """Return positions and weights for the bilinear interpolation of each square along one axis.

    The result has two entries, for the pixels before and after each sample. An entry contains the positions in the
    image, the weights, and a mask. The mask is True for pixels inside the box, and False for pixels in the margin.
    """
    center = (torch.arange(size, device=side.device) + 0.5) * (side[:, None].double() / size) - 0.5
    center = center.clamp(min=0)
    low = center.long()
    high = torch.minimum(low + 1, side[:, None] - 1)
    fraction = (center - low).float()
    samples = []
    for position, weight in ((low, 1 - fraction), (high, fraction)):
        inside = position - margin[:, None]
        within = (inside >= 0) & (inside < length[:, None])
        samples.append((start[:, None] + torch.minimum(inside.clamp(min=0), length[:, None] - 1), weight, within))
    return samples
