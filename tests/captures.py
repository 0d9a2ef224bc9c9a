"""The trained captures and fixtures that stand beside the repository on some machines, never in it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks.captures import SHARED
from normlift_ns import Camera

needs_shared = pytest.mark.skipif(
    not SHARED.is_dir(), reason="the trained captures (folder shared beside the repository) are absent"
)


def weight_fixtures() -> list[Path]:
    return sorted((SHARED / "fixtures" / "gsplat_weights").glob("*.npz"))


def fixture_view(path: Path) -> tuple[Camera, torch.Tensor, dict[str, np.ndarray]]:
    arrays = dict(np.load(path))
    labels = torch.from_numpy(arrays["labels"].astype(np.int32))
    camera = Camera(torch.from_numpy(arrays["K"]), torch.from_numpy(arrays["w2c"]), labels.shape[1], labels.shape[0])
    return camera, labels, arrays


def clip_vectors() -> torch.Tensor:
    """[1203, 512] unit rows: CLIP ViT-B/32 text embeddings of the LVIS category names, float64."""
    vectors = torch.from_numpy(np.load(SHARED / "clip_vectors" / "lvis_v1_text.npy").astype(np.float64))
    return torch.nn.functional.normalize(vectors, dim=1)
