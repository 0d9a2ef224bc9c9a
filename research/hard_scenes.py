"""Hard cases of the rasterizers, compared with loops over Python floats (tests/rasterization/oracle.py)."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from normlift_ns import Camera, Evidence, GaussianScene, lift, rasterize_evidence
from research.hard_case import Case, Setting
from tests.random_scenes import dense, orbit, orbit_camera, random_labels, random_scene
from tests.rasterization.oracle import compositing_matrix

_TURNED = (0.9, 0.2, -0.3, 0.1)
_PARAMETERS = ("means", "quats", "scales", "opacities")


def gaussians(
    means: Sequence[Sequence[float]],
    scales: Sequence[Sequence[float]],
    opacities: Sequence[float],
    quat: Sequence[float] = (1.0, 0.0, 0.0, 0.0),
) -> GaussianScene:
    """Return a float32 scene of Gaussians with the same rotation."""
    columns = (means, [quat] * len(means), scales, opacities)
    a, b, c, d = (torch.tensor(column, dtype=torch.float32) for column in columns)
    return GaussianScene(a, b, c, d)


def rasterized(
    scene: GaussianScene, views: Sequence[tuple[Camera, Tensor]], backend: str, double: bool, mode: str, device: str
) -> Evidence:
    """Return the evidence of some views with three regions each."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # Gaussians that are not drawn, where a case is about them
        return rasterize_evidence(
            scene.to(device),
            [camera for camera, _ in views],
            [labels for _, labels in views],
            num_regions=[3] * len(views),
            backend=backend,  # type: ignore[arg-type]
            rasterize_mode=mode,  # type: ignore[arg-type]
            dtype=torch.float64 if double else torch.float32,
        ).to("cpu")


def matrix(evidence: Evidence) -> Tensor:
    """Return the evidence as a float64 matrix, [N, 3 regions and one column of unlabeled pixels per view]."""
    views = evidence.num_views
    return torch.cat([dense(evidence.rows, 3 * views), dense(evidence.unlabeled, views)], dim=1)


def exact_matrix(scene: GaussianScene, views: Sequence[tuple[Camera, Tensor]], mode: str) -> Tensor:
    """Return the same matrix from loops over Python floats."""
    labeled, blank = [], []
    for camera, labels in views:
        weights = torch.from_numpy(compositing_matrix(scene, camera, mode == "antialiased")).flatten(0, 1)
        sums = [weights[labels.flatten() == region].sum(dim=0) for region in (0, 1, 2, -1)]
        labeled += sums[:3]
        blank.append(sums[3])
    return torch.stack([*labeled, *blank], dim=1)


def evidence_errors(
    setting: Setting, scene: GaussianScene, views: Sequence[tuple[Camera, Tensor]], mode: str = "classic"
) -> dict[str, float]:
    """Return the largest error of an entry over all backends, relative to the largest entry (absolute if that is below
    1)."""
    exact = exact_matrix(scene, views, mode)
    size = max(1.0, float(exact.max()))

    def worst(double: bool) -> float:
        able = [backend for backend in setting.backends if not double or backend in ("torch", "numba")]
        found = (matrix(rasterized(scene, views, backend, double, mode, setting.device)) for backend in able)
        return max(float((x - exact).abs().nan_to_num(math.inf).max()) / size for x in found)

    return {"evidence": worst(False), "evidence_double": worst(True)}


def _views(count: int, **kwargs: float) -> list[tuple[Camera, Tensor]]:
    cameras = orbit(count, **kwargs)
    return [(camera, random_labels(camera, 3, seed=i)) for i, camera in enumerate(cameras)]


def _worst(*errors: dict[str, float]) -> dict[str, float]:
    return {name: max(x[name] for x in errors) for name in errors[0]}


def ordinary(setting: Setting) -> dict[str, float]:
    scene = random_scene(20 if setting.small else 60, seed=1, dtype=torch.float32, size=0.4)
    views = _views(2, width=37, height=21)
    return _worst(*(evidence_errors(setting, scene, views, mode) for mode in ("classic", "antialiased")))


def opacity_ends(setting: Setting) -> dict[str, float]:
    logits = torch.tensor([-1000.0, -30, -5.6, 0, 30, 1000])
    means = [[0.3 * i - 0.8, 0.1, 0.2 * i] for i in range(6)]
    scene = gaussians(means, [[0.3] * 3] * 6, logits.sigmoid().tolist())
    return evidence_errors(setting, scene, _views(2))


def _needles(setting: Setting, scales: Sequence[Sequence[float]]) -> dict[str, float]:
    views = _views(1)
    single = (gaussians([[0.1, 0.0, 0.0]], [scale], [0.8], _TURNED) for scale in scales)
    return _worst(*(evidence_errors(setting, scene, views) for scene in single))


def needles(setting: Setting) -> dict[str, float]:
    return _needles(setting, [(3.0, 3e-4, 3e-4), (3.0, 3e-6, 3e-6), (0.01, 2.0, 1e-8), (2.0, 2.0, 1e-7)])


def long_needles(setting: Setting) -> dict[str, float]:
    return _needles(setting, [(1e3, 1e-3, 1e-3), (1e4, 1e-3, 0.3), (1e5, 1.0, 1e-9)])


def near_plane(setting: Setting) -> dict[str, float]:
    """Place Gaussians of all sizes behind the camera, at its center, and just in front of and behind the near plane."""
    depths, sizes = (-1.0, 0.0, 0.00999, 0.01001, 0.02, 1.0), (1e-4, 1e-2, 1.0)
    means = [[0.001 * i, 0.0, z] for i, z in enumerate(depths * 3)]
    scene = gaussians(means, [[s] * 3 for s in sizes for _ in depths], [0.3] * 18)
    camera = orbit_camera(0.0, distance=0.0)
    labels = random_labels(camera, 3)
    errors = evidence_errors(setting, scene, [(camera, labels)])
    on = gaussians([[0.0, 0.0, 0.01]], [[1e-3] * 3], [0.5])  # the float32 number next to 0.01
    drawn = [
        float(matrix(rasterized(on, [(camera, labels)], b, False, "classic", setting.device)).sum()) > 0
        for b in setting.backends
    ]
    return {**errors, "wrong": drawn.count(False)}


def enormous(setting: Setting) -> dict[str, float]:
    sizes = (1e2, 1e4, 1e6, math.exp(18), math.exp(20))
    scene = gaussians([[0.1 * i, 0.0, 0.1 * i] for i in range(5)], [[s] * 3 for s in sizes], [0.25] * 5)
    errors = [evidence_errors(setting, scene, _views(1), mode) for mode in ("classic", "antialiased")]
    close = _views(1, distance=1.0, focal=4000.0)
    return _worst(*errors, evidence_errors(setting, scene, close))


def out_of_range(setting: Setting) -> dict[str, float]:
    """Mix Gaussians with parameters that no float32 rasterizer can draw with others, which must not change."""
    others = random_scene(20, seed=1, dtype=torch.float32, size=0.4)
    bad = [
        *(("scales", 1, math.exp(x)) for x in (20.1, 30, 44, 60, 88)),
        *(("means", 2, x) for x in (2e18, 1e30, -1e38, math.inf, math.nan)),
        *(("quats", slice(None), x) for x in (0.0, -0.0, 1e-45, 1e-30, 1e-19, 1e19, 1e38, math.nan)),
        *(("scales", 0, x) for x in (math.inf, math.nan)),
        ("opacities", ..., math.nan),
    ]
    arrays = {name: getattr(others, name)[:1].repeat_interleave(len(bad), 0) for name in _PARAMETERS}
    for row, (name, column, value) in enumerate(bad):
        arrays[name][row, column] = value
    changed: dict[str, Any] = {name: torch.cat([arrays[name], getattr(others, name)]) for name in _PARAMETERS}
    mixed = replace(others, **changed)
    views, wrong = _views(2), 0
    for mode in ("classic", "antialiased"):
        for backend in setting.backends:
            found, alone = (rasterized(x, views, backend, False, mode, setting.device) for x in (mixed, others))
            wrong += abs(found.num_excluded - len(bad)) + int((matrix(found)[: len(bad)] != 0).sum())
            close = 0 if backend != "gsplat" else 1e-5  # which adds with atomics, in any order
            wrong += int(((matrix(found)[len(bad) :] - matrix(alone)).abs() > close).sum())
    return {"wrong": wrong}


def flat_scales(setting: Setting) -> dict[str, float]:
    scales = torch.tensor([[-100.0] * 3, [-200.0] * 3, [-1.0, -1.0, -200.0], [-1.0, -200.0, -200.0]]).exp().tolist()
    scene = gaussians([[0.4 * i - 0.6, 0.03, 0.1 * i] for i in range(4)], scales, [0.9] * 4, _TURNED)
    return _worst(*(evidence_errors(setting, scene, _views(2), mode) for mode in ("classic", "antialiased")))


def coincident(setting: Setting) -> dict[str, float]:
    scene = gaussians([[0.1, 0.2, 0.3]] * 24, [[0.1 + 0.02 * i] * 3 for i in range(24)], [0.2] * 24)
    return evidence_errors(setting, scene, _views(2))


def stack(setting: Setting) -> dict[str, float]:
    """Stack 40 sheets of opacity 0.5; the 14th would leave less than the smallest transmittance."""
    scene = gaussians([[0.0, 0.0, i / 40] for i in range(40)], [[1e3] * 3] * 40, [0.5] * 40)
    return evidence_errors(setting, scene, _views(1, width=20, height=18))


def scene_sizes(setting: Setting) -> dict[str, float]:
    scene, errors, wrong = random_scene(20, seed=2, dtype=torch.float32, size=0.3), [], 0
    for factor in (1e-3, 1e-2, 1.0, 1e3, 1e6):
        scaled = replace(scene, means=scene.means * factor, scales=scene.scales * factor)
        views = _views(2, distance=4 * factor)
        errors.append(evidence_errors(setting, scaled, views))
        seen = float(exact_matrix(scaled, views, "classic").sum())
        wrong += (seen > 0) != (factor > 1e-3)
    return {**_worst(*errors), "wrong": wrong}


def unseen(setting: Setting) -> dict[str, float]:
    """Place Gaussians behind the camera, beyond the far plane and far to the side, and one visible Gaussian."""
    means = [[0.0, 0.0, -9.0], [0.0, 0.0, 1e11], [1e6, 0.0, 0.0], [0.0, -1e17, 0.0], [0.0, 0.0, 0.0]]
    scene, (view,) = gaussians(means, [[0.3] * 3] * 5, [0.9] * 5), _views(1)
    errors, wrong = evidence_errors(setting, scene, [view]), 0
    for backend in setting.backends:
        evidence = rasterized(scene, [view], backend, False, "classic", setting.device).to(setting.device)
        lifted = lift(evidence, torch.eye(3, device=setting.device))
        numbers = torch.stack([lifted.scalars.reliability, lifted.directions().norm(dim=1)]).cpu()
        wrong += int((numbers[:, :4] != 0).sum()) + int((numbers[:, 4] == 0).sum())
    return {**errors, "wrong": wrong}


def nothing_labelled(setting: Setting) -> dict[str, float]:
    scene, views = random_scene(20, seed=1, dtype=torch.float32, size=0.4), _views(2)
    wrong = 0
    for label, observed in ((-1, True), (-2, False)):
        blank = [(camera, torch.full_like(labels, label)) for camera, labels in views]
        for backend in setting.backends:
            evidence = rasterized(scene, blank, backend, False, "classic", setting.device).to(setting.device)
            wrong += evidence.nnz + ((evidence.unlabeled.weight.numel() > 0) != observed)
            for mode in ("ignore", "dilute"):
                lifted = lift(evidence, torch.eye(6, device=setting.device), unlabeled=mode)
                wrong += int((lifted.scalars.reliability != 0).sum()) + int((lifted.directions() != 0).sum())
    return {"wrong": wrong}


SCENES = (
    Case(
        "ordinary",
        "An ordinary scene, for comparison",
        "the bounds of the rule, in both modes of rasterizing",
        "nothing",
        ordinary,
    ),
    Case(
        "opacity_ends",
        "Opacity at both ends: logits of -1000, -30, -5.6, 0, 30, 1000",
        "below 1/255 it is not drawn; 1 is capped at 0.999",
        "an invisible Gaussian has no evidence and takes the direction of its neighbours",
        opacity_ends,
    ),
    Case(
        "needles",
        "Needles and pancakes, aspect 1e4 to 1e8, up to 30 pixels long",
        "float32 loses digits of the determinant: two are asked for",
        "nothing",
        needles,
        {"evidence": 1e-2, "evidence_double": 1e-9},
    ),
    Case(
        "long_needles",
        "Needles of 10,000 to a million pixels",
        "no digit in float32, whose determinant is rounding alone (so does stock gsplat); finite numbers",
        "the needle is drawn too thick, too thin or not at all, here as in the training; `--precision double` is right",
        long_needles,
        {"evidence": 1e3, "evidence_double": 1e-4},
    ),
    Case(
        "near_plane",
        "Behind the camera, and about the near plane at 0.01, of up to 4,000 pixels",
        "drawn from 0.01 on, which is compared in float32",
        "a Gaussian that the camera stands in has no evidence in that view",
        near_plane,
    ),
    Case(
        "enormous",
        "Scales of 100 to e^20, cameras inside, up to 2e12 pixels wide",
        "drawn with their opacity everywhere, though their determinants exceed float32",
        "nothing",
        enormous,
    ),
    Case(
        "out_of_range",
        "NaN, infinity, scales beyond e^20, means beyond 1e18, quaternions shorter than 1e-18 or longer than 1e18",
        "not drawn, counted, and the rest is bit for bit as without them (gsplat's atomics: 1e-5)",
        "the summary says how many are not drawn; they take the direction of their neighbours",
        out_of_range,
    ),
    Case(
        "flat_scales",
        "Scales that underflow to 0: e^-100, e^-200, along one, two or three axes",
        "drawn as dots, lines and sheets blurred to half a pixel; with antialiasing as faint as they are thin",
        "nothing; with antialiasing a dot is invisible and has no evidence",
        flat_scales,
    ),
    Case(
        "coincident",
        "24 Gaussians at one place",
        "drawn in the order of the file",
        "nothing",
        coincident,
    ),
    Case(
        "stack",
        "40 sheets of opacity 0.5 behind each other",
        "the 14th, which would leave 6e-5 of the light, is not drawn",
        "what no light reaches has no evidence",
        stack,
    ),
    Case(
        "scene_sizes",
        "Scenes of size 1e-3 to 1e6",
        "the same at every size, but for the near plane of 0.01: at 1e-3 nothing is drawn, as in stock gsplat",
        "in a scene of size 1e-3 nothing has evidence",
        scene_sizes,
    ),
    Case(
        "unseen",
        "Gaussians behind the camera, beyond 1e10, and far to the side",
        "no evidence: direction 0, R = 0",
        "they take the direction of their neighbours, or stay without",
        unseen,
    ),
    Case(
        "nothing_labelled",
        "No pixel labelled, or all of them masked",
        "no evidence, no direction, R = 0, no NaN",
        "nothing answers a query",
        nothing_labelled,
    ),
)
