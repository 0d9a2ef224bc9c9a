"""Kernels are compiled, or read from their cache, while photographs are read and networks look at them."""

from __future__ import annotations

from contextlib import suppress
from threading import Thread

import torch

from normlift_ns.core.gaussians import Camera, GaussianScene
from normlift_ns.core.lift import lift
from normlift_ns.core.neighbors import nearest_neighbors
from normlift_ns.core.refine import refine
from normlift_ns.options import BackendName, LiftOptions, RasterizeMode
from normlift_ns.raster.rasterize import rasterize_evidence
from normlift_ns.raster.settings import RasterSettings

_GAUSSIANS, _REGIONS, _DIMENSION = 4096, 4, 512


def rehearse(
    gaussians: GaussianScene,
    camera: Camera,
    options: LiftOptions,
    *,
    rasterize_mode: RasterizeMode,
    settings: RasterSettings,
    backend: BackendName,
    dtype: torch.dtype,
) -> Thread:
    """Lifts random features onto some of the Gaussians, in a thread, and forgets them.

    What fails there fails again where it is wanted, and is told then.
    """
    arrays = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities)
    some = GaussianScene(*(array[:_GAUSSIANS] for array in arrays))

    def work() -> None:
        with suppress(Exception), torch.no_grad():  # as the docstring says
            evidence = rasterize_evidence(
                some, [camera], [_quarters(camera)], num_regions=[_REGIONS], backend=backend,
                rasterize_mode=rasterize_mode, settings=settings, dtype=dtype, weight_power=options.weight_power,
            )  # fmt: skip
            features = torch.eye(_REGIONS, _DIMENSION, dtype=dtype, device=some.means.device)
            lifted = lift(evidence, features, beta=options.beta, unlabeled=options.unlabeled)
            if options.refine and len(some) > options.vote.k:
                neighbors = nearest_neighbors(some.means, options.vote.k)
                own, reliability = lifted.scalars.own_evidence, lifted.scalars.reliability
                refine(some.means, lifted.directions, reliability, options.vote, own=own, neighbors=neighbors)

    thread = Thread(target=work, name="rehearsal", daemon=True)
    thread.start()
    return thread


def _quarters(camera: Camera) -> torch.Tensor:
    """Labels of the four quarters of an image."""
    x, y = torch.arange(camera.width), torch.arange(camera.height)
    return (2 * (y[:, None] * 2 // camera.height) + x * 2 // camera.width).int()
