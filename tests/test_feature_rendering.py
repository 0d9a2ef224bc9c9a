"""What the 3D-side lift and a joint least-squares reconstruction of the feature images (appendix B) do differently.

One small scene, both solved exactly: a front sheet of class a, partly transparent, before a wall of class b.
"""

import torch

from normlift_ns import GaussianScene, lift, rasterize_evidence
from tests.random_scenes import dense, orbit_camera, unit_rows

WIDTH, HEIGHT = 32, 32


def two_layers() -> GaussianScene:
    axis = torch.linspace(-0.8, 0.8, 4, dtype=torch.float64)
    wall = torch.nn.functional.pad(torch.cartesian_prod(axis, axis), (0, 1), value=0.5)
    means = torch.cat([wall[:8] * torch.tensor([1, 1, -1]), wall])  # the sheet covers half of the wall
    quaternions = torch.tensor([[1.0, 0, 0, 0]]).double().repeat(24, 1)
    opacities = torch.tensor([0.7] * 8 + [0.9] * 16).double()
    return GaussianScene(means, quaternions, torch.full((24, 3), 0.2).double(), opacities)


def test_least_squares_renders_better_and_leaves_the_sphere():
    scene = two_layers()
    cameras = [orbit_camera(angle, WIDTH, HEIGHT) for angle in (-0.2, 0.0, 0.2)]
    pixels = torch.arange(WIDTH * HEIGHT, dtype=torch.int32).view(HEIGHT, WIDTH)
    evidence = rasterize_evidence(scene, cameras, [pixels] * 3)  # every pixel a region: E is A
    A = dense(evidence.rows, evidence.num_regions).T
    classes = unit_rows(2, 16, 0)
    in_front = A[:, :8].sum(1) > A[:, 8:].sum(1)
    B = torch.where(in_front[:, None], classes[0], classes[1])  # what a mask with one vector per region says

    lifted = lift(evidence, B)
    f = lifted.scalars.norm[:, None] * lifted.directions()
    joint = torch.linalg.lstsq(A, B, driver="gelsd").solution

    def residual(u: torch.Tensor) -> float:
        return float((A @ u - B).norm() / B.norm())

    def alignment(u: torch.Tensor) -> torch.Tensor:
        return (torch.nn.functional.normalize(u, dim=1) * (A.T @ B)).sum(1)

    assert residual(joint) < 0.9 * residual(f)  # least squares reproduces the feature images better
    # Back-projection is optimal for every single Gaussian; least squares is not.
    gain = alignment(f) - alignment(joint)
    assert (gain >= -1e-9).all()
    assert gain.max() > 0.05 * lifted.scalars.weight.max()
    assert (f.norm(dim=1) <= 1).all() and joint.norm(dim=1).max() > 1.2
    # Coupled solving pushes the hidden wall away from the sheet's class; each Gaussian's own evidence never does.
    hidden = slice(8, 16)
    wall = torch.nn.functional.normalize(joint[hidden], dim=1) @ classes[0]
    assert wall.min() < (lifted.directions()[hidden] @ classes[0]).min() - 0.1
