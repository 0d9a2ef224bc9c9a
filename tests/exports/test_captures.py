"""Real captures through every format and back: Gaussians within the precision of the format, answers as before."""

from pathlib import Path

import pytest
import torch

import normlift_ns as nl
from normlift_ns.data.open_splat import _read
from normlift_ns.data.splat import SplatParameters
from normlift_ns.exports import TrainedSplat, exportable_rows
from tests.captures import SHARED, needs_shared
from tests.data.scene_files import rows_of
from tests.data.test_compressed_formats import angles, write_any

TEXTS = {
    "fox": ("orange", "crimson", "gray"),
    "tabletop": ("dusty red", "black", "white"),
    "castle": ("sky blue", "dark green", "beige"),
}
OPTIONS = {
    "source": nl.SourceOptions(encoder="color"),
    "lift": nl.LiftOptions(storage="evidence", max_views=3, lift_downscale=4, refine=False),
}
PRECISION = {
    "glb": {"means": 0, "scales": 1e-4, "opacities": 1e-6, "quats": 1e-4},
    "ply": {"means": 0.02, "scales": 0.02, "opacities": 0.002, "quats": 0.005},
    "spz": {"means": 1e-4, "scales": 0.0313, "opacities": 0.002, "quats": 0.005},
    "splat": {"means": 0, "scales": 1e-4, "opacities": 0.004, "quats": 0.03},
}
"""Largest errors of 99 of 100 Gaussians; scales below e^-10 count as that."""


def answers(path: Path, options: nl.SplatOptions, folder: Path, texts: tuple[str, ...]) -> torch.Tensor:
    """Which Gaussians of a splat the prompts select, after lifting it."""
    run = nl.lift_run(nl.open_splat(path, options), output_dir=folder, timestamp="t", check_alignment=False, **OPTIONS)
    return run.ask(*texts, threshold=0.5).selected


@needs_shared
@pytest.mark.slow
@pytest.mark.parametrize("name", ["fox", *(pytest.param(x, marks=pytest.mark.extra) for x in ("tabletop", "castle"))])
def test_a_capture_comes_back(name: str, tmp_path: Path) -> None:
    config = SHARED / "captures" / "outputs" / name / "splatfacto" / "run" / "config.yml"
    trained = TrainedSplat.of(nl.open_scene(config))
    visible = exportable_rows(trained.columns(), torch.ones(len(trained.parameters["means"]), dtype=torch.bool))
    splat = rows_of(trained.with_harmonics(), torch.from_numpy(visible))  # type: ignore[arg-type]
    options = nl.SplatOptions(
        transforms=SHARED / "captures" / name, world_transform=config.parent / "dataparser_transforms.json"
    )
    expected: torch.Tensor | None = None
    for kind, limits in PRECISION.items():
        path, rows = write_any(tmp_path, splat, kind)
        found, theirs = _read(path).splat, rows_of(splat, torch.from_numpy(rows))  # type: ignore[arg-type]
        for what, error in errors(found, theirs).items():
            assert float(error.quantile(0.99)) <= limits[what], (kind, what)
        chosen = answers(path, options, tmp_path / kind, TEXTS[name])
        expected = chosen if expected is None else expected  # GLB, the first, keeps all but the last bits
        both, either = (chosen & expected[rows]).sum(0), (chosen | expected[rows]).sum(0)
        assert min(both / either) >= (0.95 if kind == "splat" else 0.98), kind


def errors(found: SplatParameters, expected: SplatParameters) -> dict[str, torch.Tensor]:
    scales = [splat.scales.clamp(min=-10) for splat in (found, expected)]
    opacities = [splat.opacities[:, 0].sigmoid() for splat in (found, expected)]
    return {
        "means": (found.means - expected.means).abs().amax(dim=1),
        "scales": (scales[0] - scales[1]).abs().amax(dim=1),
        "opacities": (opacities[0] - opacities[1]).abs(),
        "quats": angles(found.quats, expected.quats).float(),
    }
