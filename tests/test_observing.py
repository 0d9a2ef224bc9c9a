"""Evidence that was rasterized before is used again only if it is whole and that of the same views."""

from __future__ import annotations

import random
from pathlib import Path

import pytest
import torch

from normlift_ns import Camera, Evidence, GaussianScene, RasterSettings, observing
from normlift_ns.observing import Block, block_evidence
from normlift_ns.options import BackendName
from tests.scenes import generator

N = 30


def scene() -> GaussianScene:
    g = generator(0)
    means = torch.rand(N, 3, generator=g) - 0.5
    return GaussianScene(means, torch.randn(N, 4, generator=g), torch.full((N, 3), 0.05), torch.full((N,), 0.8))


def block(shift: int) -> Block:
    """One view of two regions, whose border is somewhere else for every shift."""
    pose = torch.eye(4)
    pose[2, 3] = 2
    camera = Camera(torch.tensor([[20.0, 0, 12], [0, 20, 9], [0, 0, 1]]), pose, 24, 18)
    labels = (torch.arange(24) >= 8 + shift).int().expand(18, 24)
    return Block([camera], [labels], [torch.arange(2).int()[None]], [torch.eye(2)])


@pytest.fixture
def rasterized(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Grows with every block that is rasterized."""
    calls: list[int] = []
    original = observing.rasterize_evidence

    def counted(*args, **options) -> Evidence:
        calls.append(1)
        return original(*args, **options)

    monkeypatch.setattr(observing, "rasterize_evidence", counted)
    return calls


def evidence_of(shift: int, folder: Path, rules: str = "1.4", backend: BackendName = "numba") -> torch.Tensor:
    settings = RasterSettings.of_gsplat(rules)
    done: list[int] = []
    found = block_evidence(
        scene(), block(shift), folder, rasterize_mode="classic", settings=settings, backend=backend,
        weight_power=1, dtype=torch.float32, reuse=True, done=lambda: done.append(1),
    )  # fmt: skip
    assert done == [1]
    return torch.cat([found.rows.offsets.double(), found.rows.column.double(), found.rows.weight.double()])


def test_swapped_files_are_rasterized_again(rasterized: list[int], tmp_path: Path) -> None:
    expected = [evidence_of(shift, tmp_path) for shift in (0, 4)]
    assert not torch.equal(*expected)
    assert [torch.equal(evidence_of(shift, tmp_path), x) for shift, x in zip((0, 4), expected)] == [True, True]
    assert len(rasterized) == 2
    first, second = tmp_path.iterdir()
    content = first.read_bytes()
    first.write_bytes(second.read_bytes())
    second.write_bytes(content)
    assert [torch.equal(evidence_of(shift, tmp_path), x) for shift, x in zip((0, 4), expected)] == [True, True]
    assert len(rasterized) == 4


def test_other_rules_and_backends_are_rasterized_again(rasterized: list[int], tmp_path: Path) -> None:
    for rules, backend in (("1.4", "numba"), ("1.6", "numba"), ("1.4", "torch")) * 2:
        evidence_of(0, tmp_path, rules, backend)
    assert len(rasterized) == 3


def test_damaged_files_are_rasterized_again(rasterized: list[int], tmp_path: Path) -> None:
    expected = evidence_of(0, tmp_path)
    (path,) = tmp_path.iterdir()
    whole = path.read_bytes()
    for turn, bit in enumerate(random.Random(0).sample(range(8 * len(whole)), 25), 2):
        changed = bytearray(whole)
        changed[bit // 8] ^= 1 << bit % 8
        path.write_bytes(changed)
        assert torch.equal(evidence_of(0, tmp_path), expected)
        assert len(rasterized) == turn


def test_a_file_of_version_0_1_is_rasterized_again(rasterized: list[int], tmp_path: Path) -> None:
    """It has no digest, so nothing tells whether it is whole."""
    expected = evidence_of(0, tmp_path)
    (path,) = tmp_path.iterdir()
    Evidence.load(path, key=path.stem).save(path)  # whole, but without the key
    assert torch.equal(evidence_of(0, tmp_path), expected)
    assert len(rasterized) == 2
