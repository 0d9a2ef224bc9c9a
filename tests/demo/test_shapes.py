import math

import numpy as np
import pytest

from normlift_ns.demo import shapes

LOW, HIGH = np.full(3, -1.0), np.full(3, 1.0)


def solids() -> dict[str, tuple[shapes.Distance, float]]:
    return {
        "sphere": (shapes.sphere(0.5), math.pi),
        "box": (shapes.box(1.0, 0.8, 0.6), 2 * (0.8 + 0.6 + 0.48)),
        "cylinder": (shapes.cone(0.3, 0.3, 1.0), math.pi * (0.6 + 2 * 0.09)),
        "frustum": (shapes.cone(0.4, 0.1, 0.4), math.pi * (0.5 * 0.5 + 0.16 + 0.01)),
        "torus": (shapes.torus(0.5, 0.1), 4 * math.pi**2 * 0.05),
        "capsule": (shapes.capsule((0, 0, 0), (0.5, 0, 0), 0.2), math.pi * 0.4 * 0.9),
        "moved": (shapes.place(shapes.box(1.0, 0.8, 0.6), 0.1, -0.2, 0.05, 30), 2 * (0.8 + 0.6 + 0.48)),
        "apart": (shapes.union(shapes.sphere(0.25), shapes.place(shapes.sphere(0.25), 0.6, 0, 0)), math.pi / 2),
    }


def sampled(shape: shapes.Distance, density: float) -> shapes.Array:
    near = shapes.sample_near_surface(shape, LOW, HIGH, density, np.random.default_rng(0))
    return shapes.project_to_surface(shape, near, LOW, HIGH)


def test_surface_points_are_even_and_on_the_surface_and_normals_point_outward():
    for name, (shape, area) in solids().items():
        points = sampled(shape, 5000)
        assert np.abs(shape(points)).max() < shapes.ON_SURFACE, name
        assert len(points) == pytest.approx(5000 * area, rel=0.05), name
        points = sampled(shape, 500)
        normals = shapes.normals(shape, points)
        assert np.linalg.norm(normals, axis=1) == pytest.approx(1), name
        outward, inward = shape(points + 0.01 * normals), shape(points - 0.01 * normals)
        assert (outward > 0.009).mean() > 0.99, name
        assert (inward < -0.009).mean() > 0.85, name  # not near sharp edges


def test_distances():
    origin = np.zeros((1, 3))
    assert shapes.sphere(2)(origin) == pytest.approx(-2)
    assert shapes.cavity(shapes.sphere(2))(origin) == pytest.approx(2)
    assert shapes.box(2, 4, 6)(np.array([[4.0, 6, 0]])) == pytest.approx(5)
    assert shapes.box(2, 4, 6, 0.5)(np.array([[1.5, 0, 0]])) == pytest.approx(0.5)
    assert shapes.cone(1, 1, 2)(np.array([[0, 0, 3.0]])) == pytest.approx(2)
    assert shapes.torus(2, 0.5)(np.array([[0, 1.0, 0]])) == pytest.approx(math.hypot(2, 1) - 0.5)
    assert shapes.place(shapes.box(2, 1, 1), 5, 0, 0, 90)(np.array([[5.0, 1, 0]])) == pytest.approx(0)


def test_cover_tiles_a_plane_with_equal_round_patches():
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.uniform(0, 1, (24_000, 2)), np.zeros((24_000, 1))], axis=1)
    surfels = shapes.fit_surfels(lambda p: p[:, 2], points, rng.choice(len(points), 1000, replace=False))
    assert surfels.normals == pytest.approx(np.tile([0, 0, 1], (1000, 1)))
    assert surfels.means[:, 2] == pytest.approx(0)
    patch_radius = math.sqrt(1 / 1000 / math.pi)
    assert np.median(surfels.radii) == pytest.approx(2.6 * patch_radius / 2, rel=0.1)  # a disc's deviation: radius / 2
    assert np.quantile(surfels.radii, [0.02, 0.98]) == pytest.approx(np.median(surfels.radii), rel=0.4)
    assert surfels.thickness == pytest.approx(1e-3)
