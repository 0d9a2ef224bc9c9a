from __future__ import annotations

import torch
from scipy.spatial.transform import Rotation

from normlift_ns import GaussianScene
from normlift_ns.demo.capture import to_dataparser_world
from tests.scenes import random_scene


def test_to_dataparser_world_moves_every_gaussian_rigidly():
    generator = torch.Generator().manual_seed(0)
    scene = random_scene(50, dtype=torch.float32)
    rotation = torch.linalg.qr(torch.randn(3, 3, generator=generator)).Q
    rotation = rotation * torch.det(rotation)
    transform = torch.cat([rotation, torch.tensor([[0.3], [-2.0], [1.0]])], dim=1)
    moved = to_dataparser_world(scene, transform, 0.4)
    assert torch.allclose(moved.means, 0.4 * (scene.means @ rotation.T + transform[:, 3]), atol=1e-6)
    expected = 0.16 * rotation @ covariances(scene) @ rotation.T
    assert torch.allclose(covariances(moved), expected, atol=1e-6)
    assert torch.equal(moved.opacities, scene.opacities)


def covariances(scene: GaussianScene) -> torch.Tensor:
    turned = Rotation.from_quat(scene.quats.roll(-1, dims=1).numpy()).as_matrix()
    half = torch.from_numpy(turned).float() * scene.scales[:, None]
    return half @ half.transpose(1, 2)
