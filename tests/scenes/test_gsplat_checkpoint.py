from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from normlift_ns.scenes.formats.gsplat_checkpoint import read_gsplat
from tests.scenes.made import random_splat, rows_of, write_gsplat


def test_one_file_and_its_ranks_are_read_alike(tmp_path: Path) -> None:
    splat = random_splat(101)
    alone = read_gsplat(write_gsplat(tmp_path / "alone.pt", splat))
    for rank, rows in enumerate((slice(0, 40), slice(40, 70), slice(70, None))):
        write_gsplat(tmp_path / f"ckpt_29999_rank{rank}.pt", rows_of(splat, rows))
    write_gsplat(tmp_path / "ckpt_6999_rank0.pt", random_splat(5), step=6999)
    together = read_gsplat(tmp_path / "ckpt_29999_rank1.pt")
    assert [file.name for file in together.files] == [f"ckpt_29999_rank{r}.pt" for r in range(3)]
    assert together.step == alone.step == 29999
    for name, value in splat.parameters.items():
        assert torch.equal(alone.splat.parameters[name], value)
        assert torch.equal(together.splat.parameters[name], value)
    assert alone.pose_adjust is None


def test_more_than_ten_ranks_keep_the_order_of_their_numbers(tmp_path: Path) -> None:
    splat = random_splat(24)
    for rank in range(12):
        write_gsplat(tmp_path / f"ckpt_1_rank{rank}.pt", rows_of(splat, slice(2 * rank, 2 * rank + 2)))
    assert torch.equal(read_gsplat(tmp_path / "ckpt_1_rank0.pt").splat.means, splat.means)


def test_a_rank_that_is_missing_is_named(tmp_path: Path) -> None:
    for rank in (0, 2):
        write_gsplat(tmp_path / f"ckpt_7_rank{rank}.pt", random_splat())
    with pytest.raises(FileNotFoundError, match="up to 2, but not rank 1"):
        read_gsplat(tmp_path / "ckpt_7_rank0.pt")


def test_ranks_of_two_trainings_are_refused(tmp_path: Path) -> None:
    write_gsplat(tmp_path / "ckpt_7_rank0.pt", random_splat())
    write_gsplat(tmp_path / "ckpt_7_rank1.pt", random_splat(degree=1))
    with pytest.raises(ValueError, match="different spherical harmonics"):
        read_gsplat(tmp_path / "ckpt_7_rank0.pt")
    write_gsplat(tmp_path / "ckpt_7_rank1.pt", random_splat(), step=3)
    with pytest.raises(ValueError, match="ranks of different steps: 3, 29999"):
        read_gsplat(tmp_path / "ckpt_7_rank0.pt")


class _Payload:
    def __reduce__(self):
        return (print, ("run",))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"step": 1, "pipeline": {}}, "no checkpoint of gsplat: .* config.yml with --load-config"),
        ([1, 2], "no checkpoint of gsplat: expected `splats` in it, found list"),
        ({"splats": {"means": torch.zeros(2, 3)}}, "has no quats, scales, opacities, sh0, shN"),
        ({"splats": {"means": _Payload()}}, "holds Python objects"),
    ],
)
def test_other_content_is_refused(tmp_path: Path, content: object, message: str, capfd) -> None:
    torch.save(content, tmp_path / "a.pt")
    with pytest.raises(ValueError, match=message):
        read_gsplat(tmp_path / "a.pt")
    assert "run" not in capfd.readouterr().out


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("means", torch.full((200, 3), torch.nan), "means are NaN"),
        ("means", torch.zeros(200, 2), r"means is torch.float32 \(200, 2\)"),
        ("means", torch.zeros(200, 3, dtype=torch.int64), "means is torch.int64"),
        ("quats", torch.zeros(100, 4), r"quats is torch.float32 \(100, 4\)"),
        ("sh0", torch.zeros(200, 3), r"sh0 has shape \(200, 3\)"),
        ("shN", torch.zeros(200, 7, 3), r"harmonics have shape \(200, 7, 3\)"),
    ],
)
def test_tensors_that_fit_no_splat_are_refused(tmp_path: Path, name: str, value: torch.Tensor, message: str) -> None:
    path = write_gsplat(tmp_path / "a.pt", random_splat())
    content = torch.load(path)
    content["splats"][name] = value
    torch.save(content, path)
    with pytest.raises(ValueError, match=message):
        read_gsplat(path)


def test_a_network_of_appearances_is_refused_by_name(tmp_path: Path) -> None:
    path = write_gsplat(tmp_path / "a.pt", random_splat(), app_module={"embeds.weight": torch.zeros(3, 16)})
    with pytest.raises(ValueError, match=r"holds `app_module`: a network of appearances \(--app_opt\)"):
        read_gsplat(path)


def test_moved_poses_are_read_or_refused(tmp_path: Path) -> None:
    moves = torch.randn(4, 9)
    path = write_gsplat(tmp_path / "a.pt", random_splat(), pose_adjust={"embeds.weight": moves, "identity": moves[0]})
    found = read_gsplat(path).pose_adjust
    assert found is not None
    assert np.allclose(found, moves)
    for wrong in ({}, {"embeds.weight": torch.zeros(4, 6)}, {"embeds.weight": torch.full((4, 9), torch.nan)}):
        write_gsplat(path, random_splat(), pose_adjust=wrong)
        with pytest.raises(ValueError, match="`pose_adjust` is not what gsplat's --pose_opt writes"):
            read_gsplat(path)
