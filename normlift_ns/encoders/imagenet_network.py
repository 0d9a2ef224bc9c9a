"""Encoder based on EfficientNet-Lite2, with dense features for regions and class vectors for prompts.

The classifier averages 1,280 feature maps over an image and multiplies the mean by one vector per class. The encoder
normalizes the features and averages them over a region, so that all pixels count equally. The cosine of this mean and a
class vector measures how much the region looks like the class. Features are 32 pixels apart, so the image is encoded at
twice its size. The longer side after scaling is limited to about 2,048 pixels.

Convolutions are padded equally on both sides, so that feature (i, j) is centered on pixel (32 i, 32 j). An image with
32 m + 1 rows has m + 1 rows of features, from its first to its last row. TensorFlow, which was used for training, pads
more on one side. Away from the border, the only effect is a shift of the features by three pixels.
"""

from __future__ import annotations

import io
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64, Int32, Int64, UInt8
from torch import Tensor, nn
from torch.nn.functional import normalize, relu6
from torch.nn.utils.fusion import fuse_conv_bn_eval

from normlift_ns.core.device import AdaptiveBatches, prefetch_map, shared_property
from normlift_ns.encoders.base import resize_image
from normlift_ns.encoders.imagenet import find_classes
from normlift_ns.encoders.text_files import check_prompts
from normlift_ns.encoders.weights import IMAGENET
from normlift_ns.segmentation.regions import WORKERS, resample_nearest

WIDTH, CLASSES = 1280, 1000
"""Number of feature channels, and number of classes."""
_STAGES = ((1, 3, 1, 1, 16), (3, 3, 2, 6, 24), (3, 5, 2, 6, 48), (4, 3, 2, 6, 88), (4, 5, 1, 6, 120), (5, 5, 2, 6, 208),
           (1, 3, 1, 6, 352))  # fmt: skip
"""Number of blocks, kernel size, stride of the first block, expansion factor and output channels of each stage of
EfficientNet-Lite2."""
_STEM = 32
_LAYERS = (("conv_stem", "bn0"), ("expand_conv", "bn0"), ("depthwise_conv", "bn1"), ("project_conv", "bn2"),
           ("conv_head", "bn1"))  # fmt: skip
"""Names of convolutions and of the batch normalizations that follow them."""
_EPSILON = 1e-3
_STRIDE = 32
"""Distance between features, in pixels."""
_SCALE, _MAX_SIDE = 2.0, 2048
"""Largest scale factor of images, and approximate limit on their longer side after scaling, in pixels."""


def _convolution(inputs: int, outputs: int, kernel: int = 1, stride: int = 1, groups: int = 1) -> nn.Conv2d:
    return nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2, groups=groups, bias=False)


def _norm(channels: int) -> nn.BatchNorm2d:
    return nn.BatchNorm2d(channels, _EPSILON)


class _Block(nn.Module):
    """An inverted residual block with an optional expansion, a depthwise convolution and a projection."""

    def __init__(self, inputs: int, outputs: int, kernel: int, stride: int, expansion: int) -> None:
        super().__init__()
        inner = inputs * expansion
        self.expands, self.adds = expansion > 1, stride == 1 and inputs == outputs
        if self.expands:
            self.expand_conv, self.bn0 = _convolution(inputs, inner), _norm(inner)
        self.depthwise_conv, self.bn1 = _convolution(inner, inner, kernel, stride, inner), _norm(inner)
        self.project_conv, self.bn2 = _convolution(inner, outputs), _norm(outputs)

    def forward(self, x: Tensor) -> Tensor:
        y = relu6(self.bn0(self.expand_conv(x))) if self.expands else x
        y = relu6(self.bn1(self.depthwise_conv(y)))
        y = self.bn2(self.project_conv(y))
        return x + y if self.adds else y


class EfficientNetLite2(nn.Module):
    """EfficientNet of Tan and Le in TensorFlow's Lite2 variant, with ReLU6 and without squeeze-and-excitation."""

    def __init__(self) -> None:
        super().__init__()
        self.conv_stem, self.bn0 = _convolution(3, _STEM, 3, 2), _norm(_STEM)
        blocks, width = [], _STEM
        for count, kernel, stride, expansion, outputs in _STAGES:
            for number in range(count):
                blocks.append(_Block(width, outputs, kernel, stride if number == 0 else 1, expansion))
                width = outputs
        self.blocks = nn.Sequential(*blocks)
        self.conv_head, self.bn1 = _convolution(width, WIDTH), _norm(WIDTH)
        self.fc = nn.Linear(WIDTH, CLASSES)

    def forward(self, pixels: Float[Tensor, "b 3 y x"]) -> Float[Tensor, "b 1280 rows columns"]:
        """Return the features of images with values in 0..255."""
        x = relu6(self.bn0(self.conv_stem((pixels - 127) / 128)))
        return relu6(self.bn1(self.conv_head(self.blocks(x))))


def load_network(content: bytes, device: str) -> EfficientNetLite2:
    """Load the network from the content of a PyTorch weight file.

    Leading underscores are removed from the parts of parameter names. Batch normalizations are fused into the preceding
    convolutions, which halves the inference time on a CPU. The memory format is channels-last on a CPU. On a GPU, it is
    the default, because cuDNN would spend three seconds compiling channels-last depthwise convolutions.
    """
    state = torch.load(io.BytesIO(content), map_location="cpu", weights_only=True)
    with torch.device("meta"):
        network = EfficientNetLite2()
    names = {".".join(part.removeprefix("_") for part in name.split(".")): value for name, value in state.items()}
    network.load_state_dict(names, assign=True)
    parts: list[Any] = [network.eval().requires_grad_(False), *network.blocks]
    for part in parts:
        for layer, norm in _LAYERS:
            if hasattr(part, layer):
                setattr(part, layer, fuse_conv_bn_eval(getattr(part, layer), getattr(part, norm)))
                setattr(part, norm, nn.Identity())
    return network.to(device) if device.startswith("cuda") else network.to(memory_format=torch.channels_last)


@dataclass(frozen=True)
class ImageNetEncoder:
    """A `DenseEncoder` based on EfficientNet-Lite2; see the module docstring.

    Weights are loaded at first use. ReLU6 can set all features of a region to zero. `RegionFeatures` then treats the
    region as unlabeled.
    """

    device: str = "cpu"

    @property
    def identity(self) -> dict[str, Any]:
        return {"kind": "imagenet", "weights": f"sha256:{IMAGENET.sha256}", "scale": _SCALE, "max_side": _MAX_SIDE}

    @property
    def why_not_dense(self) -> str | None:
        return None

    @shared_property
    def network(self) -> EfficientNetLite2:
        """The network with its weights. Raises the same errors as `PackageFile.read`."""
        return load_network(IMAGENET.read(), self.device)

    def encode(self, image: UInt8[Tensor, "h w 3"], labels: Int32[Tensor, "depth h w"]) -> Float32[Tensor, "r d"]:
        return next(self.encode_each([(image, labels)]))

    def encode_each(
        self, views: Iterable[tuple[UInt8[Tensor, "h w 3"], Int32[Tensor, "depth h w"]]]
    ) -> Iterator[Float32[Tensor, "r d"]]:
        inputs = ((next(self._images(self._feature_maps, image[None])), labels.cpu()) for image, labels in views)
        yield from prefetch_map(lambda view: pool_regions(*view), inputs, WORKERS)

    def patches(self, image: UInt8[Tensor, "h w 3"], rows: int, columns: int) -> Float32[Tensor, "r d"]:
        grid = np.arange(rows * columns, dtype=np.int32).reshape(1, rows, columns)
        return self.encode(image, torch.from_numpy(resample_nearest(grid, *image.shape[:2])))

    def text(self, prompts: Sequence[str]) -> Float32[Tensor, "q d"]:
        """Return one unit vector per prompt, the normalized sum of the unit vectors of all classes that it names.

        The sum weights all these classes equally. The maximum of their cosines would detect a single class better, but
        a query needs one vector.

        Raises:
            InputError: If `prompts` or a prompt is empty, a prompt does not name a class, or the weights are damaged.
            FileNotFoundError: If the weights are not on this machine.
        """
        check_prompts(prompts)
        classes = [find_classes(prompt) for prompt in prompts]
        vectors = normalize(self.network.fc.weight.double(), dim=1).cpu()
        return normalize(torch.stack([vectors[found].sum(0) for found in classes]), dim=1).float()

    @torch.no_grad()
    def _feature_maps(self, images: UInt8[Tensor, "1 h w 3"]) -> Float32[Tensor, "1280 rows columns"]:
        height, width = images.shape[1:3]
        scale = min(_SCALE, _MAX_SIDE / max(height, width))
        size = [max(1, round(scale * side / _STRIDE)) * _STRIDE + 1 for side in (height, width)]
        pixels = resize_image(images[0].to(self.device), *size)
        with torch.backends.cudnn.flags(enabled=True, benchmark=False, deterministic=True, allow_tf32=False):
            return normalize(self.network(pixels)[0], dim=0)

    @cached_property
    def _images(self) -> AdaptiveBatches:
        return AdaptiveBatches(1)


def pool_regions(maps: Float32[Tensor, "d rows columns"], labels: Int32[Tensor, "depth h w"]) -> Float32[Tensor, "r d"]:
    """Return the normalized mean feature of each region, on the CPU, or a zero row if the mean is zero.

    Features are interpolated bilinearly at the pixels. The interpolation weights are first summed per region, so that
    a single matrix product computes all means.
    """
    rows, columns = maps.shape[1:]
    _, y, x = (labels >= 0).nonzero(as_tuple=True)
    region = labels[labels >= 0].long()
    count = int(region.max()) + 1 if len(region) > 0 else 0
    (top, below), (left, right) = _positions(labels.shape[1], rows), _positions(labels.shape[2], columns)
    weights = torch.zeros(count * rows * columns, dtype=torch.float64)
    for i, row_share in ((top, 1 - below), ((top + 1).clamp(max=rows - 1), below)):
        for j, column_share in ((left, 1 - right), ((left + 1).clamp(max=columns - 1), right)):
            cell = region * (rows * columns) + i[y] * columns + j[x]
            weights += torch.bincount(cell, row_share[y] * column_share[x], len(weights))
    pixels = torch.bincount(region, minlength=count).clamp(min=1)
    shares = (weights.reshape(count, rows * columns) / pixels[:, None]).float().to(maps.device)
    return normalize(shares @ maps.flatten(1).T, dim=1).cpu()


def _positions(pixels: int, features: int) -> tuple[Int64[Tensor, " pixels"], Float64[Tensor, " pixels"]]:
    """Return the index of the feature before each pixel along one axis, and the interpolation weight of the next one.

    The first and last features are centered on the first and last pixels of the scaled image.
    """
    place = ((torch.arange(pixels).double() + 0.5) * ((features - 1) * _STRIDE + 1) / pixels - 0.5) / _STRIDE
    place = place.clamp(0, features - 1)
    before = place.long()
    return before, place - before
