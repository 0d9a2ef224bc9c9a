"""The trained captures and fixtures that stand next to the repository on some machines, never in it."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from normlift_ns import Camera, GaussianScene, open_scene

SHARED = Path(__file__).resolve().parents[2] / "shared"


def capture(name: str) -> Any:
    """The scene of a trained run."""
    return open_scene(SHARED / "captures" / "outputs" / name / "splatfacto" / "run" / "config.yml")


def trained_state(name: str) -> dict[str, torch.Tensor]:
    """The Gaussians in a splatfacto checkpoint."""
    return {f"gauss_params.{key}": value for key, value in capture(name).parameters.items()}


def trained_scene(name: str) -> GaussianScene:
    """The activated Gaussians of a splatfacto checkpoint."""
    return capture(name).gaussians


def base_colors(name: str) -> torch.Tensor:
    """[N, 3] sRGB of a splatfacto checkpoint, the same from all sides."""
    return (0.5 + 0.28209479177387814 * capture(name).parameters["features_dc"]).clamp(0, 1)


def training_indices(name: str) -> list[int]:
    """Frames, in order of their names, that nerfstudio's 90 % split trains on."""
    scene = capture(name)
    return [sorted(scene.train.names + scene.held_out.names).index(frame) for frame in scene.train.names]


def training_cameras(name: str) -> list[Camera]:
    """Cameras of the 90 % training split, lens distortion taken out."""
    return capture(name).train.cameras


def all_cameras(name: str) -> list[Camera]:
    """Cameras of all frames in order of their names."""
    scene = capture(name)
    found = {frame: camera for part in (scene.train, scene.held_out) for frame, camera in zip(part.names, part.cameras)}
    return [found[frame] for frame in sorted(found)]


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
