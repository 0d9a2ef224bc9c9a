"""Computed shapes and textures of the objects in `research.own_capture` that are not scans.

Lengths are in meters, z is up. Only NumPy is needed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

Picture = np.ndarray
"""Texture [h, w, 3], RGB in 0..1; the first row is v = 1."""


@dataclass(frozen=True)
class Mesh:
    """Triangles with texture coordinates."""

    points: np.ndarray
    """Positions [n, 3]."""
    uv: np.ndarray
    """[m, 2], in 0..1, v upwards."""
    faces: np.ndarray
    """[f, 3, 2] indices of a corner's point and of its texture coordinates."""

    def __add__(self, other: Mesh) -> Mesh:
        faces = other.faces + np.array([len(self.points), len(self.uv)])
        parts = (self.points, other.points), (self.uv, other.uv), (self.faces, faces)
        return Mesh(*(np.concatenate(pair) for pair in parts))

    def turned(self, matrix: ArrayLike) -> Mesh:
        return Mesh(self.points @ np.asarray(matrix).T, self.uv, self.faces)

    def obj(self) -> str:
        """Return the text of an OBJ file."""
        lines = ["v {:.6f} {:.6f} {:.6f}".format(*row) for row in self.points]
        lines += ["vt {:.6f} {:.6f}".format(*row) for row in self.uv]
        lines += ["f " + " ".join(f"{p}/{t}" for p, t in face) for face in self.faces + 1]
        return "\n".join(lines) + "\n"


# Shapes


def smooth(corners: Sequence[Sequence[float]], times: int = 3) -> np.ndarray:
    """Return the points of a smooth curve along corners, with the same ends (Chaikin's corner cutting)."""
    points = np.asarray(corners, float)
    for _ in range(times):
        cut = np.stack([0.75 * points[:-1] + 0.25 * points[1:], 0.25 * points[:-1] + 0.75 * points[1:]], axis=1)
        points = np.concatenate([points[:1], cut.reshape(-1, points.shape[1])[1:-1], points[-1:]])
    return points


def sheet(points: np.ndarray, low: float = 0.0, high: float = 1.0) -> Mesh:
    """Return the surface over a grid of points [rows, columns, 3]; v runs from `low` to `high` by length."""
    rows, columns = points.shape[:2]
    step = np.linalg.norm(np.diff(points, axis=0), axis=2).mean(axis=1)
    v = low + (high - low) * np.concatenate([[0], step.cumsum()]) / step.sum()
    uv = np.stack(np.broadcast_arrays(np.linspace(0, 1, columns)[None], v[:, None]), axis=2).reshape(-1, 2)
    at = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (x.ravel() for x in (at[:-1, :-1], at[:-1, 1:], at[1:, 1:], at[1:, :-1]))
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    return Mesh(points.reshape(-1, 3), uv, np.stack([faces, faces], axis=2))


def lathe(profile: np.ndarray, low: float = 0.0, high: float = 1.0, columns: int = 97) -> Mesh:
    """Return the surface of revolution of a profile of radius and height, from below along the outside."""
    angle = np.linspace(0, 2 * np.pi, columns)
    radius, z = profile[:, :1], np.broadcast_to(profile[:, 1:], (len(profile), columns))
    return sheet(np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=2), low, high)


def tube(path: np.ndarray, radius: np.ndarray, low: float = 0.0, high: float = 1.0, ribs: float = 0.0) -> Mesh:
    """Return a tube along a path of x and z in the plane y = 0, with five ribs of a relative height."""
    along = np.gradient(path, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    angle = np.linspace(0, 2 * np.pi, 41)
    size = np.broadcast_to(radius, len(path))[:, None] * (1 + ribs * np.cos(5 * angle))
    side, up = size * np.cos(angle), size * np.sin(angle)
    x, z = path[:, :1] - along[:, 1:] * up, path[:, 1:] + along[:, :1] * up
    return sheet(np.stack([x, side, z], axis=2), low, high)


def box(size: Sequence[float], center: Sequence[float], repeat: float = 1.0) -> Mesh:
    """Return a box by its edge lengths; its longest edge shows `repeat` copies of the texture."""
    half, faces = np.asarray(size, float) / 2, []
    for axis in range(3):
        for sign in (-1, 1):
            u, v = (axis + 1) % 3, (axis + 2) % 3
            corners = np.zeros((2, 2, 3))
            corners[..., axis] = sign * half[axis]
            corners[..., u] = half[u] * np.array([[-1, 1], [-1, 1]]) * sign
            corners[..., v] = half[v] * np.array([[-1, -1], [1, 1]])
            side = sheet(corners)
            u, v = (v, u) if half[v] > half[u] else (u, v)
            faces.append(Mesh(side.points, (side.points[:, [u, v]] / half.max() + 1) / 2 * repeat, side.faces))
    whole = sum(faces[1:], faces[0])
    return Mesh(whole.points + np.asarray(center, float), whole.uv, whole.faces)


# Textures


def noise(seed: int, shape: tuple[int, int], cells: tuple[int, int]) -> np.ndarray:
    """Return smooth periodic noise with mean 0 and standard deviation about 1, with some cells along each side."""
    knots = np.random.default_rng(seed).standard_normal(cells)
    for axis in (0, 1):
        at = np.arange(shape[axis]) * cells[axis] / shape[axis]
        low, part = at.astype(int), at % 1
        part = (part * part * (3 - 2 * part)).reshape([-1, 1] if axis == 0 else [1, -1])
        knots = knots.take(low, axis) * (1 - part) + knots.take((low + 1) % cells[axis], axis) * part
    return 1.4 * knots


def grid(height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Return v and u of every pixel."""
    v, u = np.mgrid[(height - 0.5) / height : 0 : height * 1j, 0.5 / width : 1 : width * 1j]
    return v, u


def mixed(first: ArrayLike, second: ArrayLike, share: np.ndarray) -> Picture:
    share = share.clip(0, 1)[..., None]
    return np.asarray(first) * (1 - share) + np.asarray(second) * share


def wood(planks: int = 7) -> Picture:
    """Return planks along u."""
    shape = (1024, 1024)
    v, u = grid(*shape)
    plank = np.floor(v * planks)
    random = np.random.default_rng(7)
    tone, shift = random.uniform(0, 0.45, planks), random.uniform(0, 1, planks)
    wave = v * planks * 9 + 0.8 * noise(1, shape, (28, 5)) + 6 * shift[plank.astype(int)]
    grain = 0.5 + 0.5 * np.sin(2 * np.pi * wave) * 0.5 + 0.18 * noise(2, shape, (512, 16))
    shade = 0.55 * grain + tone[plank.astype(int)] + 0.05 * noise(3, shape, (6, 6))
    picture = mixed((0.74, 0.55, 0.36), (0.44, 0.28, 0.16), shade)
    joint = np.abs(v * planks - np.round(v * planks)) < 0.012
    ends = np.abs((u * 2 + shift[plank.astype(int)]) % 1) < 0.004
    return np.where((joint | ends)[..., None], 0.45 * picture, picture)


def plaster(color: Sequence[float], seed: int, contrast: float = 1.0) -> Picture:
    """Return a plain surface that has just enough structure for a reconstruction."""
    shape = (512, 512)
    rough = 0.02 * noise(seed, shape, (4, 4)) + 0.014 * noise(seed + 1, shape, (24, 24))
    rough += 0.012 * noise(seed + 2, shape, (128, 128))
    return (np.asarray(color) + contrast * rough[..., None]).clip(0, 1)


def speckled(color: Sequence[float], spots: Sequence[float], seed: int, amount: float) -> Picture:
    """Return a glaze with spots."""
    shape = (512, 512)
    cloud = 0.03 * noise(seed, shape, (5, 5))
    return mixed(np.asarray(color), spots, (noise(seed + 1, shape, (90, 90)) - 2.2 + amount) * 3) + cloud[..., None]


def peel(color: Sequence[float], pole: Sequence[float], seed: int) -> Picture:
    """Return the skin of a fruit, with pores, and a pole of another color at the top."""
    shape = (512, 512)
    v, _ = grid(*shape)
    skin = (
        np.asarray(color) * (1 + 0.05 * noise(seed, shape, (6, 6)) + 0.06 * noise(seed + 1, shape, (64, 96)))[..., None]
    )
    return mixed((0, 0, 0), pole, (v - 0.955) * 60) + skin * (1 - ((v - 0.955) * 60).clip(0, 1)[..., None])


def banana_skin() -> Picture:
    shape = (512, 512)
    v, _ = grid(*shape)
    end = np.abs(v - 0.5) * 2
    yellow = mixed((0.93, 0.76, 0.16), (0.66, 0.68, 0.22), (end - 0.72) * 3 + 0.1 * noise(3, shape, (9, 5)))
    spots = noise(4, shape, (70, 30)) - 2.1 + 0.5 * noise(5, shape, (6, 6))
    yellow = mixed((1, 1, 1), (0.45, 0.33, 0.2), spots * 3) * yellow
    return np.where((end > 0.955)[..., None], (0.24, 0.17, 0.09), yellow)


def football() -> Picture:
    """Return a truncated icosahedron on a sphere: twelve black pentagons, twenty white hexagons, gray seams."""
    v, u = grid(1024, 2048)
    around, up = 2 * np.pi * u, np.pi * (v - 0.5)
    ray = np.stack([np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)], axis=2)
    golden = (1 + 5**0.5) / 2
    signs = [(a, b * golden) for a in (-1, 1) for b in (-1, 1)]
    corners = np.array([np.roll((0, a, b), axis) for axis in range(3) for a, b in signs])
    corners /= np.linalg.norm(corners, axis=1, keepdims=True)
    near = corners @ corners.T > 0.4
    triples = [
        (i, j, k) for i in range(12) for j in range(i) for k in range(j) if near[i, j] and near[j, k] and near[i, k]
    ]
    middles = np.array([corners[list(x)].sum(axis=0) for x in triples])
    middles /= np.linalg.norm(middles, axis=1, keepdims=True)
    # The planes of the faces of a truncated icosahedron; the ray leaves it through the nearest one.
    planes = np.concatenate([corners / 2.32744, middles / 2.26728])
    depth = np.sort(ray @ planes.T, axis=2)
    black = (ray @ planes.T).argmax(axis=2) < 12
    picture = np.where(black[..., None], (0.06, 0.06, 0.07), (0.93, 0.93, 0.91))
    seam = ((depth[..., -1] - depth[..., -2]) < 0.006) & ~black
    return np.where(seam[..., None], (0.55, 0.55, 0.55), picture)


# Things


def coffee_mug() -> Mesh:
    wall = [(0, 0), (0.034, 0), (0.04, 0.001), (0.042, 0.012), (0.042, 0.09), (0.0425, 0.098), (0.0395, 0.098)]
    inside = [(0.039, 0.09), (0.0385, 0.012), (0.034, 0.007), (0, 0.007)]
    handle = smooth([(0.040, 0.082), (0.062, 0.084), (0.076, 0.07), (0.074, 0.04), (0.06, 0.024), (0.040, 0.022)])
    return lathe(smooth([*wall, *inside], 2)) + tube(handle, np.full(len(handle), 0.0058))


def teapot() -> Mesh:
    body = [(0, 0), (0.046, 0), (0.05, 0.003), (0.072, 0.022), (0.085, 0.055), (0.076, 0.092), (0.046, 0.112)]
    lid = [(0.040, 0.1125), (0.040, 0.117), (0.030, 0.124), (0.010, 0.128), (0.006, 0.133), (0.012, 0.139)]
    spout = smooth([(0.068, 0.04), (0.1, 0.044), (0.112, 0.085), (0.122, 0.106), (0.138, 0.112)])
    handle = smooth([(-0.066, 0.098), (-0.1, 0.118), (-0.136, 0.1), (-0.13, 0.05), (-0.1, 0.03), (-0.076, 0.034)])
    pot = lathe(smooth([*body, *lid, (0.011, 0.146), (0.004, 0.149), (0, 0.149)], 2))
    return pot + tube(spout, np.linspace(0.02, 0.0085, len(spout))) + tube(handle, np.full(len(handle), 0.0068))


def ball(radius: float) -> Mesh:
    angle = np.linspace(-np.pi / 2, np.pi / 2, 65)
    return lathe(np.stack([radius * np.cos(angle), radius * (1 + np.sin(angle))], axis=1))


def apple() -> Mesh:
    body = [(0, 0.006), (0.01, 0.001), (0.024, 0.001), (0.036, 0.018), (0.042, 0.045), (0.036, 0.066), (0.018, 0.074)]
    stem = smooth([(0, 0.056), (0.0005, 0.068), (0.004, 0.082)])
    return lathe(smooth([*body, (0.006, 0.066), (0, 0.06)]), 0, 0.94) + tube(stem, np.full(len(stem), 0.0016), 0.985, 1)


def banana() -> Mesh:
    """Return a banana that lies on its side."""
    angle = np.linspace(-0.95, 0.95, 65)
    path = 0.105 * np.stack([np.sin(angle), 1 - np.cos(angle)], axis=1)
    radius = 0.0185 * np.interp(
        np.abs(angle), [0, 0.5, 0.72, 0.82, 0.9, 0.94, 0.95], [1, 0.93, 0.7, 0.38, 0.27, 0.26, 0.05]
    )
    return tube(path, radius, ribs=0.05).turned([[1, 0, 0], [0, 0, 1], [0, -1, 0]])


MADE: dict[str, tuple[Callable[[], Mesh], Callable[[], Picture]]] = {
    "coffee mug": (coffee_mug, lambda: speckled((0.72, 0.09, 0.08), (0.25, 0.03, 0.03), 21, 0.5)),
    "teapot": (teapot, lambda: speckled((0.09, 0.2, 0.5), (0.4, 0.52, 0.75), 31, 0.7)),
    "soccer ball": (lambda: ball(0.075), football),
    "orange": (lambda: ball(0.04), lambda: peel((0.93, 0.47, 0.06), (0.3, 0.36, 0.12), 41)),
    "Granny Smith": (apple, lambda: peel((0.5, 0.67, 0.17), (0.3, 0.2, 0.1), 51)),
    "banana": (banana, banana_skin),
}
"""Mesh and texture of each made thing; most names are those of ImageNet's classes."""
