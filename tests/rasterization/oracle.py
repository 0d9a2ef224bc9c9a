"""The rasterizer once more, as loops over Python floats: written from the formulas, sharing no code."""

import math
from collections.abc import Callable

import numpy as np

from normlift_ns import Camera, GaussianScene

TILE, NEAR, FAR, BLUR, CAP, SKIP, STOP = 16, 0.01, 1e10, 0.3, 0.999, 1 / 255, 1e-4


def _rotation(q: list[float]) -> np.ndarray:
    w, x, y, z = (v / math.sqrt(sum(c * c for c in q)) for v in q)
    return np.array(
        [
            [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
        ]
    )


def compositing_matrix(scene: GaussianScene, camera: Camera, antialiased=False, rules="1.4") -> np.ndarray:
    """A [height, width, N] of one view, float64, by the rules of a version of gsplat."""
    cap = 0.99 if rules == "1.6" else CAP
    floor = 0.005 if rules == "1.6" else 0.0
    K, pose = camera.K.double().numpy(), camera.world_to_camera.double().numpy()
    width, height = camera.width, camera.height
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    splats = []
    for j in range(len(scene)):
        if not bool(scene.drawable[j]):
            continue
        x, y, z = pose[:3, :3] @ scene.means[j].double().numpy() + pose[:3, 3]
        if z < NEAR or z > FAR:
            continue
        R = pose[:3, :3] @ _rotation(scene.quats[j].double().tolist())
        covariance = R @ np.diag(scene.scales[j].double().numpy() ** 2) @ R.T
        limit_x = 0.3 * width / (2 * fx)
        limit_y = 0.3 * height / (2 * fy)
        tx = min(max(x / z, -cx / fx - limit_x), (width - cx) / fx + limit_x)
        ty = min(max(y / z, -cy / fy - limit_y), (height - cy) / fy + limit_y)
        J = np.array([[fx / z, 0, -fx * tx / z], [0, fy / z, -fy * ty / z]])
        sharp = J @ covariance @ J.T
        blurred = sharp + BLUR * np.eye(2)
        determinant = np.linalg.det(blurred)
        opacity = float(scene.opacities[j])
        if antialiased:
            opacity *= max(floor, math.sqrt(max(0.0, np.linalg.det(sharp) / determinant)))
        half_trace = 0.5 * np.trace(blurred)
        radius = math.ceil(3 * math.sqrt(half_trace + math.sqrt(max(0.01, half_trace**2 - determinant))))
        across, down = radius, radius
        if rules != "1.4":  # a rectangle that ends where alpha is 1/255
            if opacity < SKIP:
                continue
            sigmas = min(3.33, math.sqrt(2 * math.log(opacity / SKIP)))
            across, down = math.ceil(sigmas * math.sqrt(blurred[0, 0])), math.ceil(sigmas * math.sqrt(blurred[1, 1]))
        u, v = fx * x / z + cx, fy * y / z + cy
        if u + across <= 0 or u - across >= width or v + down <= 0 or v - down >= height:
            continue
        columns = range(math.floor((u - across) / TILE), math.ceil((u + across) / TILE))
        rows = range(math.floor((v - down) / TILE), math.ceil((v + down) / TILE))
        (a, b), (_, c) = np.linalg.inv(blurred).tolist()
        splats.append((z, j, columns, rows, float(u), float(v), a, b, c, opacity))

    def alpha_at(x: float, y: float, u: float, v: float, a: float, b: float, c: float, opacity: float) -> float:
        dx, dy = x - u, y - v
        return min(cap, opacity * math.exp(-0.5 * (a * dx * dx + 2 * b * dx * dy + c * dy * dy)))

    return _composited(np.zeros((height, width, len(scene))), splats, alpha_at)


def compositing_matrix_2d(scene: GaussianScene, camera: Camera) -> np.ndarray:
    """A [height, width, N] of one view of 2D Gaussians, float64: rays meet planes, by the rules of gsplat 1.4."""
    K, pose = camera.K.double().numpy(), camera.world_to_camera.double().numpy()
    width, height = camera.width, camera.height
    splats = []
    for j in range(len(scene)):
        center = pose[:3, :3] @ scene.means[j].double().numpy() + pose[:3, 3]
        if not bool(scene.drawable[j]) or not NEAR <= center[2] <= FAR:
            continue
        axes = (pose[:3, :3] @ _rotation(scene.quats[j].double().tolist()) * scene.scales[j].double().numpy())[:, :2]
        # The points center + a axes[:, 0] + b axes[:, 1] with a^2 + b^2 = 1 project to a conic with this dual.
        columns = K @ np.column_stack([axes, center])
        dual = columns @ np.diag([1, 1, -1]) @ columns.T
        u, v = dual[0, 2] / dual[2, 2], dual[1, 2] / dual[2, 2]
        squares = u * u - dual[0, 0] / dual[2, 2], v * v - dual[1, 1] / dual[2, 2]
        radius = math.ceil(3 * math.sqrt(max(1e-4, *squares)))
        if u + radius <= 0 or u - radius >= width or v + radius <= 0 or v - radius >= height:
            continue
        tiles = [range(math.floor((x - radius) / TILE), math.ceil((x + radius) / TILE)) for x in (u, v)]
        splats.append((center[2], j, *tiles, center, axes, u, v, float(scene.opacities[j])))

    def alpha_at(x: float, y: float, center: np.ndarray, axes: np.ndarray, u: float, v: float, opacity: float) -> float:
        ray = np.linalg.solve(K, [x, y, 1.0])
        a, b, _ = np.linalg.solve(np.column_stack([axes, -ray]), -center)  # where the ray meets the plane
        return min(CAP, opacity * math.exp(-min(a**2 + b**2, 2 * ((x - u) ** 2 + (y - v) ** 2)) / 2))

    return _composited(np.zeros((height, width, len(scene))), splats, alpha_at)


def _composited(weights: np.ndarray, splats: list[tuple], alpha_at: Callable[..., float]) -> np.ndarray:
    splats = sorted(splats, key=lambda splat: splat[:2])
    for row, column in np.ndindex(weights.shape[:2]):
        transmittance = 1.0
        for _, j, columns, rows, *shape in splats:
            if column // TILE not in columns or row // TILE not in rows:
                continue
            alpha = alpha_at(column + 0.5, row + 0.5, *shape)
            if alpha < SKIP:
                continue
            if transmittance * (1 - alpha) <= STOP:
                break
            weights[row, column, j] = alpha * transmittance
            transmittance *= 1 - alpha
    return weights
