"""The color encoder: regions are embedded by their mean colors; see `encoders.texts.colours`."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Float32, Int32, UInt8
from torch import Tensor

from normlift_ns.encoders.texts.colours import ColourTexts, embed


@dataclass(frozen=True)
class ColourEncoder(ColourTexts):
    """Encoder that compares mean CIELAB colors with color names; formulas in `texts.colours`. Needs neither weights nor
    a GPU."""

    def encode(self, image: UInt8[Tensor, "h w 3"], labels: Int32[Tensor, "depth h w"]) -> Float32[Tensor, "r d"]:
        from skimage.color import rgb2lab  # noqa: PLC0415 (other encoders do not need it)

        labels = labels.cpu()
        depth, y, x = (labels >= 0).nonzero(as_tuple=True)
        lab, region = torch.from_numpy(rgb2lab(image.numpy()))[y, x], labels[depth, y, x].long()
        pixels = torch.bincount(region)
        total = torch.zeros(len(pixels), 3, dtype=torch.float64).index_add_(0, region, lab.double())
        return torch.from_numpy(embed((total / pixels[:, None]).numpy())).float()

    def encode_each(
        self, views: Iterable[tuple[UInt8[Tensor, "h w 3"], Int32[Tensor, "depth h w"]]]
    ) -> Iterator[Float32[Tensor, "r d"]]:
        return (self.encode(image, labels) for image, labels in views)
