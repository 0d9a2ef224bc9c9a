"""HED in float64, from the arrays of a Keras file; and such files of tiny networks."""

import io
from typing import Any

import h5py
import numpy as np
import torch
from torch.nn.functional import conv2d, interpolate, max_pool2d

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
        pixels, sides = torch.from_numpy(image[:, :, ::-1] - np.array(MEAN_BGR)).permute(2, 0, 1)[None], []
        for number in range(1, 6):
            pixels = max_pool2d(pixels, 2, ceil_mode=True) if number > 1 else pixels
            layers: Any = file[f"block{number}/layers"]
            for name in sorted((name for name in layers if name.startswith("conv")), key=len):
                pixels = convolve(pixels, layers[name]["vars"]).relu()
            side = convolve(pixels, file[f"dsn{number}/vars"])
            sides.append(interpolate(side, image.shape[:2], mode="bilinear"))
        return convolve(torch.cat(sides, dim=1), file["fuse/vars"]).sigmoid()[0, 0].numpy()


def convolve(pixels: torch.Tensor, variables: Any) -> torch.Tensor:
    kernel, bias = (torch.from_numpy(variables[i][()].astype(np.float64)) for i in "01")
    return conv2d(pixels, kernel.permute(3, 2, 0, 1), bias, padding="same")
