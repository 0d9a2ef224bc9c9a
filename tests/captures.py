"""The trained captures and fixtures that stand next to the repository on some machines, never in it.

Gaussians, and cameras as splatfacto sees them (split, transform, undistortion).
"""

from __future__ import annotations

import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from normlift_ns import Camera, GaussianScene

SHARED = Path(__file__).resolve().parents[2] / "shared"


STEPS = {"fox": 11999, "tabletop": 6999}


def trained_state(name: str) -> dict[str, torch.Tensor]:
    """The model's tensors in a splatfacto checkpoint."""
    run = SHARED / "captures" / "outputs" / name / "splatfacto" / "run"
    path = run / "nerfstudio_models" / f"step-{STEPS[name]:09d}.ckpt"
    state = torch.load(path, map_location="cpu", weights_only=True)["pipeline"]
    return {key.removeprefix("_model."): value for key, value in state.items() if key.startswith("_model.")}


def trained_scene(name: str) -> GaussianScene:
    """The activated Gaussians of a splatfacto checkpoint."""
    state = trained_state(name)
    means, quats, scales, opacities = (
        state[f"gauss_params.{key}"] for key in ("means", "quats", "scales", "opacities")
    )
    return GaussianScene(means, quats, scales.exp(), opacities.sigmoid().squeeze(-1))


def base_colors(name: str) -> torch.Tensor:
    """[N, 3] sRGB of a splatfacto checkpoint, the same from all sides."""
    return (0.5 + 0.28209479177387814 * trained_state(name)["gauss_params.features_dc"]).clamp(0, 1)


def training_indices(name: str) -> list[int]:
    """Frames, in order of their names, that nerfstudio's 90 % split trains on."""
    count = len(json.loads((SHARED / "captures" / name / "transforms.json").read_text())["frames"])
    return np.linspace(0, count - 1, math.ceil(count * 0.9), dtype=int).tolist()


def training_cameras(name: str) -> list[Camera]:
    """Cameras of the 90 % training split."""
    cameras = all_cameras(name)
    return [cameras[i] for i in training_indices(name)]


def all_cameras(name: str) -> list[Camera]:
    """Cameras of all frames in order of their names, lens distortion taken out as nerfstudio's full-image data manager
    does it.
    """
    capture = SHARED / "captures" / name
    meta = json.loads((capture / "transforms.json").read_text())
    run = SHARED / "captures" / "outputs" / name / "splatfacto" / "run"
    world = json.loads((run / "dataparser_transforms.json").read_text())
    frames = sorted(meta["frames"], key=lambda frame: frame["file_path"])
    K, width, height = _undistorted_intrinsics(meta)
    cameras = []
    for frame in frames:
        pose = np.array(world["transform"] + [[0, 0, 0, 1]]) @ np.array(frame["transform_matrix"])
        pose[:3, 3] *= world["scale"]
        pose[:, 1:3] *= -1  # OpenGL to OpenCV
        pose = torch.linalg.inv(torch.from_numpy(pose))
        pose[3] = torch.tensor([0.0, 0, 0, 1])
        cameras.append(Camera(K, pose.float(), width, height))
    return cameras


def _undistorted_intrinsics(meta: dict) -> tuple[torch.Tensor, int, int]:
    K = np.array([[meta["fl_x"], 0, meta["cx"]], [0, meta["fl_y"], meta["cy"]], [0, 0, 1]])
    distortion = np.array([meta.get(key, 0.0) for key in ("k1", "k2", "p1", "p2", "k3")])
    if not distortion.any():
        return torch.from_numpy(K).float(), meta["w"], meta["h"]
    K[:2, 2] -= 0.5  # OpenCV's pixel centres are whole numbers
    K, (x, y, width, height) = cv2.getOptimalNewCameraMatrix(K, distortion, (meta["w"], meta["h"]), 0)
    K[:2, 2] += 0.5 - np.array([x, y])
    return torch.from_numpy(K).float(), width, height


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
