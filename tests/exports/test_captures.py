"""Real captures through every format and back: Gaussians within the precision of the format."""

from pathlib import Path

import pytest
import torch

from normlift_ns.data.open_splat import _read
from normlift_ns.exports import TrainedSplat, exportable_rows
from tests.captures import capture, needs_shared
from tests.data.scene_files import rows_of
from tests.data.test_compressed_formats import angles, write_any

PRECISION = {
    "glb": {"means": 0, "scales": 1e-4, "opacities": 1e-6, "quats": 1e-4},
    "ply": {"means": 0.02, "scales": 0.02, "opacities": 0.002, "quats": 0.005},
    "spz": {"means": 1e-4, "scales": 0.0313, "opacities": 0.002, "quats": 0.005},
    "splat": {"means": 0, "scales": 1e-4, "opacities": 0.004, "quats": 0.03},
}
"""Largest errors of 99 of 100 Gaussians; scales below e^-10 count as that."""


@needs_shared
@pytest.mark.slow
@pytest.mark.parametrize("name", ["fox", *(pytest.param(x, marks=pytest.mark.extra) for x in ("tabletop", "castle"))])
def test_a_capture_comes_back(name: str, tmp_path: Path) -> None:
    trained = TrainedSplat.of(capture(name))
    visible = exportable_rows(trained.columns(), torch.ones(len(trained.parameters["means"]), dtype=torch.bool))
    splat = rows_of(trained.with_harmonics(), torch.from_numpy(visible))  # type: ignore[arg-type]
    for kind, limits in PRECISION.items():
        path, rows = write_any(tmp_path, splat, kind)
        found, expected = _read(path).splat, rows_of(splat, torch.from_numpy(rows))  # type: ignore[arg-type]
        errors = {
            "means": (found.means - expected.means).abs().amax(dim=1),
            "scales": (found.scales.clamp(min=-10) - expected.scales.clamp(min=-10)).abs().amax(dim=1),
            "opacities": (found.opacities.sigmoid() - expected.opacities.sigmoid()).abs()[:, 0],
            "quats": angles(found.quats, expected.quats).float(),
        }
        for what, error in errors.items():
            assert float(error.quantile(0.99)) <= limits[what], (kind, what)
