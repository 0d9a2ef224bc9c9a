"""LPIPS that is built when it is first asked for."""

from __future__ import annotations

import warnings
from typing import Any

import torch
from torch import Tensor


class LazyLpips(torch.nn.Module):
    """Stands in for torchmetrics' LearnedPerceptualImagePatchSimilarity, whose construction downloads weights.

    Args:
        options: those of the metric.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__()
        self.options = options
        self.available = True
        """False once its weights could not be had."""
        self._metric: list[torch.nn.Module] = []  # in a list: the network stays out of checkpoints

    def forward(self, image: Tensor, reference: Tensor) -> Tensor:
        """LPIPS of images [B, 3, H, W] in 0..1; NaN, and one warning, where its weights cannot be had."""
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
            warnings.warn(f"LPIPS is left out: its weights cannot be downloaded ({error})", stacklevel=2)
