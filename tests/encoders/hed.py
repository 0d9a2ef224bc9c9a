"""HED in numpy and float64, from the arrays of a Keras file; and such files of tiny networks."""

import io
from typing import Any

import h5py
import numpy as np
import torch

from normlift_ns.segmentation.edges import EdgeNetwork

MEAN_BGR = (104.00699, 116.66877, 122.67892)


def tiny_network(seed: int = 0) -> EdgeNetwork:
    """A network with few channels, whose edges are neither all 0 nor all 1."""
    torch.manual_seed(seed)
    network = EdgeNetwork((6, 7, 8, 9, 9))
    for _, layer in network.layers():
        torch.nn.init.kaiming_normal_(layer.weight)
    network.fuse.weight.mul_(0.01)
    return network


def keras_file(network: EdgeNetwork) -> io.BytesIO:
    """The weights of a network as Keras writes them."""
    content = io.BytesIO()
    with h5py.File(content, "w") as file:
        for name, layer in network.layers():
            file[f"{name}/vars/0"] = layer.weight.permute(2, 3, 1, 0).numpy()
            file[f"{name}/vars/1"] = layer.bias.numpy()
    return content


def edge_probability(content: bytes, image: np.ndarray) -> np.ndarray:
    """What TensorFlow computes from a file: convolutions and pools with "same" padding, bilinear resizing."""
    with h5py.File(io.BytesIO(content)) as file:
        pixels, sides = image[:, :, ::-1] - np.array(MEAN_BGR), []
        for number in range(1, 6):
            pixels = pool(pixels) if number > 1 else pixels
            layers: Any = file[f"block{number}/layers"]
            for name in sorted((name for name in layers if name.startswith("conv")), key=len):
                pixels = np.maximum(convolve(pixels, layers[name]["vars"]), 0)
            side = convolve(pixels, file[f"dsn{number}/vars"])
            sides.append(enlarge(enlarge(side, image.shape[0]).swapaxes(0, 1), image.shape[1]).swapaxes(0, 1))
        return 1 / (1 + np.exp(-convolve(np.concatenate(sides, axis=2), file["fuse/vars"])[:, :, 0]))


def convolve(pixels: np.ndarray, variables: Any) -> np.ndarray:
    kernel, bias = (variables[i][()].astype(np.float64) for i in "01")
    height, width = pixels.shape[:2]
    padded = np.pad(pixels, [(kernel.shape[0] // 2,) * 2] * 2 + [(0, 0)])
    taps = np.ndindex(kernel.shape[:2])
    return sum(padded[y : y + height, x : x + width] @ kernel[y, x] for y, x in taps) + bias


def pool(pixels: np.ndarray) -> np.ndarray:
    height, width = (size + size % 2 for size in pixels.shape[:2])
    padded = np.full((height, width, pixels.shape[2]), -np.inf)
    padded[: pixels.shape[0], : pixels.shape[1]] = pixels
    return padded.reshape(height // 2, 2, width // 2, 2, -1).max(axis=(1, 3))


def enlarge(values: np.ndarray, size: int) -> np.ndarray:
    """Along the first axis, with pixel centers at halves."""
    position = ((np.arange(size) + 0.5) * len(values) / size - 0.5).clip(0, len(values) - 1)
    low = np.floor(position).astype(int)
    share = (position - low)[:, None, None]
    return values[low] * (1 - share) + values[np.minimum(low + 1, len(values) - 1)] * share
