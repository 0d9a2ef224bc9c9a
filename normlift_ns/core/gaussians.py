"""Inputs of the rasterizer: a trained Gaussian scene and the cameras of its images."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Bool, Float, Float64, Int64
from torch import Tensor
from torch.nn.functional import normalize

from normlift_ns.core.arguments import check_arguments
from normlift_ns.core.device import TensorRecord
from normlift_ns.errors import InputError
from normlift_ns.options import Primitive

MIN_OPACITY = 1 / 255
"""Opacity below which Gaussians are not drawn with the default `RasterSettings.min_alpha`."""
SH_C0 = 0.28209479177387814
"""sqrt(1 / (4 pi)), the spherical harmonic of degree 0."""
MAX_SCALE = 4.8517e8
"""Largest scale in world units: e^20 with a margin for rounding. The projected covariance of Gaussians with larger
scales may overflow float32."""
MAX_MEAN = 1e18
"""Largest absolute coordinate of a mean in world units; squared distances must fit into float32."""
QUATERNION_RANGE = (1e-18, 1e18)
"""Valid range of the largest absolute component of a quaternion. Outside it, the squared length may not be a normal
float32 number, and the rotation may become NaN or the identity."""


@check_arguments
@dataclass(frozen=True)
class GaussianScene(TensorRecord):
    """N Gaussians with activated parameters, the input of the rasterizer.

    Parameters may be NaN, infinite or outside the limits of `drawable`, because training can produce such values.
    Gaussians with such parameters keep their rows but are never drawn, and `Evidence.num_excluded` counts them. They
    have no evidence, no direction of their own and a reliability of 0. Exports omit Gaussians with parameters that are
    not finite.

    Raises:
        ValueError: If a shape, type or device is wrong, a scale is negative, or an opacity is outside 0..1.

    >>> import torch
    >>> from normlift_ns import GaussianScene
    >>> means, quats = torch.tensor([[0.0, 0, 2], [0, 0, torch.nan]]), torch.tensor([[1.0, 0, 0, 0]]).expand(2, 4)
    >>> log_scales, logits = torch.zeros(2, 3), torch.zeros(2)  # as splatfacto trains them
    >>> scene = GaussianScene(means, quats, scales=log_scales.exp(), opacities=logits.sigmoid())
    >>> scene.scales[0].tolist(), scene.opacities.tolist(), scene.drawable.tolist()
    ([1.0, 1.0, 1.0], [0.5, 0.5], [True, False])
    """

    means: Float[Tensor, "n 3"]
    """Centers in world units."""
    quats: Float[Tensor, "n 4"]
    """Rotations as quaternions (w, x, y, z), which need not be normalized."""
    scales: Float[Tensor, "n 3"]
    """Standard deviations along the three axes in world units, >= 0; linear, not logarithms."""
    opacities: Float[Tensor, " n"]
    """Opacities in 0..1, not logits."""
    primitive: Primitive = "3dgs"
    """Kind of Gaussians. "2dgs": flat Gaussians of 2D Gaussian Splatting, drawn without their third scale."""

    def __post_init__(self) -> None:
        for name in ("quats", "scales", "opacities"):
            if (device := getattr(self, name).device) != self.means.device:
                raise InputError(
                    f"GaussianScene.{name} is on {device}, but means are on {self.means.device}; use one device"
                )
        if bool((self.scales < 0).any()):
            raise InputError(
                "GaussianScene.scales has negative values, expected linear scales; apply exp() to `scales` of a "
                "splatfacto checkpoint"
            )
        if bool(((self.opacities < 0) | (self.opacities > 1)).any()):
            raise InputError(
                "GaussianScene.opacities has values outside 0..1, expected activated opacities; apply sigmoid() to "
                "`opacities` of a splatfacto checkpoint"
            )

    def __len__(self) -> int:
        return self.means.shape[0]

    def select(self, rows: Int64[Tensor, " m"] | Bool[Tensor, " n"] | slice) -> GaussianScene:
        """Return a scene of the selected Gaussians, without gradients."""
        tensors = {name: getattr(self, name).detach()[rows] for name in ("means", "quats", "scales", "opacities")}
        return replace(self, **tensors)

    @cached_property
    def drawable(self) -> Bool[Tensor, " n"]:
        """Mask of the Gaussians that can be drawn.

        Their parameters are finite and within limits for float32. The limits are the same for all precisions and
        backends.
        """
        length = self.quats.float().abs().amax(dim=1)  # the length up to a factor of 2
        low, high = QUATERNION_RANGE
        small = (self.means.float().abs() <= MAX_MEAN).all(dim=1) & (self.scales.float() <= MAX_SCALE).all(dim=1)
        return small & (length >= low) & (length <= high) & self.opacities.isfinite()


def facing_pose(eye: Float[Tensor, " 3"], target: Float[Tensor, " 3"], up: Float[Tensor, " 3"]) -> Float[Tensor, "4 4"]:
    """Return the `world_to_camera` of a camera at `eye` that faces `target`. All tensors are float64."""
    forward = normalize(target - eye, dim=0)
    right = torch.linalg.cross(forward, up)
    if float(right.norm()) < 1e-6:  # straight up or down: choose any roll
        right = torch.linalg.cross(forward, torch.eye(3, dtype=torch.float64)[forward.abs().argmin()])
    right = normalize(right, dim=0)
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ eye
    return pose


@check_arguments
@dataclass(frozen=True)
class Camera:
    """A pinhole camera in the OpenCV convention: x right, y down, z forward, pixel centers at half integers.

    Raises:
        ValueError: If a shape is wrong, a value is not finite, or the pose is not rigid. Also if `K` does not have the
            form below with fx, fy > 0, or the width or height is not in 1..2**20.

    >>> import torch
    >>> from normlift_ns import Camera
    >>> pose = torch.eye(4)
    >>> pose[2, 3] = 2.0  # the world origin lies two units in front of the camera
    >>> camera = Camera(torch.tensor([[100.0, 0, 80], [0, 100, 60], [0, 0, 1]]), pose, width=160, height=120)
    >>> x, y, depth = (camera.K @ (camera.world_to_camera @ torch.tensor([0.5, 0.25, 0.0, 1.0]))[:3]).tolist()
    >>> x / depth, y / depth, depth
    (105.0, 72.5, 2.0)
    """

    K: Float[Tensor, "3 3"]
    """[[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels."""
    world_to_camera: Float[Tensor, "4 4"]
    """Rigid transform p_camera = world_to_camera @ p_world."""
    width: int
    """Image width in pixels."""
    height: int
    """Image height in pixels."""

    def __post_init__(self) -> None:
        for name in ("K", "world_to_camera"):
            if not bool((value := getattr(self, name)).isfinite().all()):
                raise InputError(f"Camera.{name} must be finite, got {value.tolist()}")
        (fx, skew, _), (zero, fy, _), last = self.K.tolist()
        if fx <= 0 or fy <= 0 or skew != 0 or zero != 0 or last != [0, 0, 1]:
            raise InputError(
                f"Camera.K must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with fx, fy > 0, got {self.K.tolist()}"
            )
        pose = self.world_to_camera.double()
        rotation = pose[:3, :3]
        deviation = (rotation @ rotation.T - torch.eye(3, dtype=torch.float64, device=pose.device)).abs().max().item()
        if deviation > 1e-3 or torch.linalg.det(rotation).item() < 0 or pose[3].tolist() != [0, 0, 0, 1]:
            raise InputError(
                "Camera.world_to_camera must be a rotation and a translation without scale or reflection, got "
                f"{self.world_to_camera.tolist()}"
            )
        if not (1 <= self.width <= 2**20 and 1 <= self.height <= 2**20):
            size = f"width {self.width}, height {self.height}"
            raise InputError(f"Camera size must be 1x1 to 1048576x1048576 pixels, got {size}")

    def camera_to_world(self) -> Float64[Tensor, "4 4"]:
        """Return the camera-to-world matrix in nerfstudio's OpenGL convention: x right, y up, z backward."""
        pose = self.world_to_camera.double()
        return pose.inverse() * pose.new_tensor([1.0, -1, -1, 1])

    @check_arguments
    def downscaled(self, factor: float) -> Camera:
        """Return the camera of an image whose width and height are multiplied by `factor` and rounded.

        Args:
            factor: Positive number. Values above 1 count as 1.

        >>> K = torch.tensor([[100.0, 0, 80], [0, 100, 60], [0, 0, 1]])
        >>> camera = Camera(K, torch.eye(4), width=160, height=120)
        >>> small = camera.downscaled(0.25)
        >>> small.width, small.height, small.K[0].tolist()
        (40, 30, [25.0, 0.0, 20.0])
        """
        if factor <= 0:
            raise InputError(f"factor must be positive, got {factor}")
        width, height = (max(1, round(min(1.0, factor) * side)) for side in (self.width, self.height))
        scale = self.K.new_tensor([[width / self.width], [height / self.height], [1.0]])
        return Camera(self.K * scale, self.world_to_camera, width, height)

    @check_arguments
    def project(
        self, points: Float[Tensor, "n 3"]
    ) -> tuple[Int64[Tensor, " n"], Int64[Tensor, " n"], Float[Tensor, " n"], Bool[Tensor, " n"]]:
        """Return the pixel row, pixel column and depth of every point, and a mask of the points in the image.

        Pixels of points outside the image are clamped to its border.
        """
        pose = self.world_to_camera.to(points)
        seen = points @ pose[:3, :3].T + pose[:3, 3]
        depth = seen[:, 2]
        pixel = (seen @ self.K.to(points).T)[:, :2] / depth[:, None].clamp(min=1e-9)
        inside = (depth > 0) & (pixel >= 0).all(1) & (pixel[:, 0] < self.width) & (pixel[:, 1] < self.height)
        column, row = (pixel[:, i].long().clamp(0, size - 1) for i, size in enumerate((self.width, self.height)))
        return row, column, depth, inside
