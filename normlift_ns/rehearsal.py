"""Warm-up of GPU kernels in the background, while images are read and networks process them."""

from __future__ import annotations

from contextlib import suppress
from threading import Thread

import torch

from normlift_ns.core.consensus import consensus
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
    """Lift random features onto some of the Gaussians in a thread, and discard the result.

    Errors are suppressed here, because the lift itself will raise them again.
    """
    arrays = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities)
    sample = GaussianScene(*(array[:_GAUSSIANS] for array in arrays))

    def work() -> None:
        with suppress(Exception), torch.no_grad():  # as the docstring says
            evidence = rasterize_evidence(
                sample, [camera], [_quarters(camera)], num_regions=[_REGIONS], backend=backend,
                rasterize_mode=rasterize_mode, settings=settings, dtype=dtype, weight_power=options.weight_power,
            )  # fmt: skip
            features = torch.eye(_REGIONS, _DIMENSION, dtype=dtype, device=sample.means.device)
            if options.consensus:
                consensus(evidence, features)
            lifted = lift(evidence, features, beta=options.beta, unlabeled=options.unlabeled)
            if options.refine and len(sample) > options.vote.k:
                neighbors = nearest_neighbors(sample.means, options.vote.k)
                own, reliability = lifted.scalars.own_evidence, lifted.scalars.reliability
                refine(sample.means, lifted.directions, reliability, options.vote, own=own, neighbors=neighbors)

    thread = Thread(target=work, name="kernel warm-up", daemon=True)
    thread.start()
    return thread


def _quarters(camera: Camera) -> torch.Tensor:
    """Return labels of the four quarters of an image."""
    x, y = torch.arange(camera.width), torch.arange(camera.height)
    return (2 * (y[:, None] * 2 // camera.height) + x * 2 // camera.width).int()
