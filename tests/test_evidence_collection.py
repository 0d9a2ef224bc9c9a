"""A lift with more views encodes and rasterizes the new ones only. Stored evidence is used again only if it is whole
and that of the same views, rules and backend."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
import torch

from normlift_ns import LiftOptions, evidence_collection
from normlift_ns.core.field import SemanticField
from normlift_ns.encoders.base import RegionFeatures
from normlift_ns.encoders.color import ColorEncoder
from normlift_ns.evidence_collection import RasterConfig, ViewBatch, batch_evidence
from normlift_ns.options import BackendName
from normlift_ns.pipeline import lift_scene
from normlift_ns.segmentation.regions import Superpixels
from tests.random_scenes import Photographs, made_scene, orbit_camera, random_scene, same_evidence

ALL = tuple(range(11))
OLD = (0, 2, 3, 5, 6, 7, 9, 10)
"""New views stand before, between and behind old ones, so that no block of the second lift is one of the first."""


@pytest.fixture
def worked(monkeypatch: pytest.MonkeyPatch) -> dict[str, int]:
    """How many views were encoded and rasterized."""
    counts = dict.fromkeys(("encoded", "rasterized"), 0)
    encode, rasterize = ColorEncoder.encode_each, evidence_collection.rasterize_evidence

    def count(what: str, number: int, given: Any) -> Any:
        counts[what] += number
        return given

    def rasterizing(gaussians: Any, cameras: Any, *more: Any, **options: Any) -> Any:
        return rasterize(gaussians, count("rasterized", len(cameras), cameras), *more, **options)

    def encoding(self: ColorEncoder, views: Any) -> Any:
        return encode(self, (count("encoded", 1, view) for view in views))

    monkeypatch.setattr(ColorEncoder, "encode_each", encoding)
    monkeypatch.setattr(evidence_collection, "rasterize_evidence", rasterizing)
    monkeypatch.setattr(evidence_collection, "_MAX_CHUNK", 4)
    return counts


def lifted(numbers: Sequence[int], cache: Path, mode: str = "classic") -> SemanticField:
    cameras = [orbit_camera(0.3 * number) for number in numbers]
    views = Photographs([f"{number:02}.png" for number in numbers], cameras, seeds=numbers)
    scene = made_scene(random_scene(60, dtype=torch.float32), views, rasterize_mode=mode)
    options = LiftOptions(refine=False, storage="evidence", consensus=False)
    source = RegionFeatures(Superpixels(9), ColorEncoder())
    return lift_scene(scene, source, options, cache, encoder={}).field


def test_more_views_cost_only_the_new_ones(worked: dict[str, int], tmp_path: Path) -> None:
    lifted(OLD, tmp_path / "cache")
    assert worked == dict.fromkeys(worked, len(OLD))
    more = lifted(ALL, tmp_path / "cache")
    assert worked == dict.fromkeys(worked, len(ALL))
    again = lifted(ALL, tmp_path / "cache")
    fewer, repeated = lifted(OLD[::2], tmp_path / "cache"), (2, 1, 2, 9, 4)
    twice = lifted(repeated, tmp_path / "cache")  # a photograph given twice counts twice
    assert worked == dict.fromkeys(worked, len(ALL))
    for found, numbers in ((more, ALL), (again, ALL), (fewer, OLD[::2]), (twice, repeated)):
        expected = lifted(numbers, tmp_path / f"fresh{len(numbers)}").store.evidence
        evidence = found.store.evidence
        assert same_evidence(evidence, expected)
        assert evidence.nnz > 50 * len(numbers)


def test_a_damaged_file_costs_its_views(worked: dict[str, int], tmp_path: Path) -> None:
    lifted(OLD, tmp_path)
    first, _ = sorted((tmp_path / "evidence").iterdir())
    first.write_bytes(first.read_bytes()[:-40] + bytes(40))
    lifted(ALL, tmp_path)
    assert worked["rasterized"] == len(ALL) + 4
    lifted(ALL, tmp_path, "antialiased")
    assert worked["rasterized"] == 2 * len(ALL) + 4
    assert worked["encoded"] == len(ALL)


def evidence_of(shift: int, folder: Path, rules="1.4", backend: BackendName = "numba", cells=2) -> torch.Tensor:
    """Of one view of two regions, whose border is somewhere else for every shift, and cells without a pixel."""
    camera, done = orbit_camera(0.0), []
    labels = (torch.arange(camera.width) >= 18 + shift).int().expand(camera.height, camera.width)
    block = ViewBatch([camera], [labels], [torch.arange(cells).int()[None]], [torch.eye(cells)])
    config, scene = RasterConfig(rules, backend, torch.float32, "classic", 1), random_scene(30, dtype=torch.float32)
    found = batch_evidence(scene, block, folder, config, reuse=True, on_view=lambda: done.append(1))
    assert done == [1]
    return torch.cat([found.rows.offsets.double(), found.rows.column.double(), found.rows.weight.double()])


def test_swapped_files_other_rules_backends_and_cells_are_rasterized_again(worked, tmp_path: Path) -> None:
    expected = [evidence_of(shift, tmp_path) for shift in (0, 4)]
    assert not torch.equal(*expected)
    assert [torch.equal(evidence_of(shift, tmp_path), x) for shift, x in zip((0, 4), expected)] == [True, True]
    assert worked["rasterized"] == 2
    first, second = tmp_path.iterdir()
    content = first.read_bytes()
    first.write_bytes(second.read_bytes())
    second.write_bytes(content)
    assert [torch.equal(evidence_of(shift, tmp_path), x) for shift, x in zip((0, 4), expected)] == [True, True]
    assert worked["rasterized"] == 4
    for changed in (("1.6", "numba"), ("1.4", "torch"), ("1.4", "numba", 3)) * 2:
        evidence_of(0, tmp_path, *changed)
    assert worked["rasterized"] == 7
