"""LPIPS metric that is built at its first use."""

from __future__ import annotations

import warnings
from typing import Any

import torch
from torch import Tensor


class LazyLpips(torch.nn.Module):
    """Stand-in for torchmetrics' LearnedPerceptualImagePatchSimilarity, whose constructor downloads weights.

    Args:
        options: keyword arguments of the metric.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__()
        self.options = options
        self.available = True
        """False once loading the weights has failed."""
        self._metric: list[torch.nn.Module] = []  # in a list, which keeps the network out of checkpoints

    def forward(self, image: Tensor, reference: Tensor) -> Tensor:
        """Return the LPIPS of images [B, 3, H, W] in 0..1; NaN, with a single warning, if the weights are missing."""
        if self.available and not self._metric:
            self._build()
        if not self.available:
            return image.new_tensor(torch.nan)
        return self._metric[0].to(image.device)(image, reference)

    def _build(self) -> None:
        from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity  # noqa: PLC0415 (slow)

        try:
            self._metric.append(LearnedPerceptualImagePatchSimilarity(**self.options))
        except (ImportError, OSError) as error:
            self.available = False
            warnings.warn(f"LPIPS is skipped: its weights cannot be downloaded ({error})", stacklevel=2)
