from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from normlift_ns.data.checkpoint import read_gsplat_checkpoint
from normlift_ns.data.open_splat import _held_out, _read
from normlift_ns.data.transforms import CameraFile
from normlift_ns.errors import InputError
from normlift_ns.options import SplatOptions
from tests.data.scene_files import ply_columns, random_splat, rows_of, write_gsplat, write_ply


def test_one_file_and_its_ranks_are_read_alike(tmp_path: Path) -> None:
    splat = random_splat(101)
    alone = read_gsplat_checkpoint(write_gsplat(tmp_path / "alone.pt", splat, step=np.int64(29999)))
    for rank in range(12):  # in the order of numbers, not of names
        rows = slice(8 * rank, 8 * rank + 8 if rank < 11 else None)
        write_gsplat(tmp_path / f"ckpt_29999_rank{rank}.pt", rows_of(splat, rows))
    write_gsplat(tmp_path / "ckpt_6999_rank0.pt", random_splat(5), step=6999)
    together = read_gsplat_checkpoint(tmp_path / "ckpt_29999_rank1.pt")
    assert together.step == alone.step == 29999
    for name, value in splat.parameters.items():
        assert torch.equal(alone.splat.parameters[name], value)
        assert torch.equal(together.splat.parameters[name], value)
    assert alone.pose_adjust is None


def test_ranks_that_are_missing_or_of_two_trainings_are_refused(tmp_path: Path) -> None:
    for rank in (0, 2):
        write_gsplat(tmp_path / f"ckpt_7_rank{rank}.pt", random_splat())
    with pytest.raises(FileNotFoundError, match="not rank 1"):
        read_gsplat_checkpoint(tmp_path / "ckpt_7_rank0.pt")
    write_gsplat(tmp_path / "ckpt_7_rank1.pt", random_splat(degree=1))
    with pytest.raises(InputError, match="spherical harmonics"):
        read_gsplat_checkpoint(tmp_path / "ckpt_7_rank0.pt")
    write_gsplat(tmp_path / "ckpt_7_rank1.pt", random_splat(), step=3)
    with pytest.raises(InputError, match="steps: 3, 29999"):
        read_gsplat_checkpoint(tmp_path / "ckpt_7_rank0.pt")


def test_other_content_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.pt"
    for content, message in (
        ({"step": 1, "pipeline": {}}, "config.yml with --load-config"),
        ([1, 2], "`splats`, found list"),
        (((torch.zeros(3),), 30000), "found tuple.*Inria.*--load-ply"),
        ({"splats": {"means": torch.zeros(2, 3)}}, "quats, scales, opacities, sh0, shN"),
    ):
        torch.save(content, path)
        with pytest.raises(InputError, match=message):
            read_gsplat_checkpoint(path)
    write_gsplat(path, random_splat(), app_module={"embeds.weight": torch.zeros(3, 16)})
    with pytest.raises(InputError, match=r"`app_module`.*--app_opt"):
        read_gsplat_checkpoint(path)
    for name, value, message in (
        ("means", torch.full((200, 3), torch.nan), "means .* NaN"),
        ("means", torch.zeros(200, 2), r"means is torch.float32 \(200, 2\)"),
        ("means", torch.zeros(200, 3, dtype=torch.int64), "means is torch.int64"),
        ("quats", torch.zeros(100, 4), r"quats is torch.float32 \(100, 4\)"),
        ("sh0", torch.zeros(200, 3), r"sh0 has shape \(200, 3\)"),
        ("shN", torch.zeros(200, 7, 3), r"harmonics have shape \(200, 7, 3\)"),
    ):
        content = torch.load(write_gsplat(path, random_splat()))
        content["splats"][name] = value
        torch.save(content, path)
        with pytest.raises(InputError, match=message):
            read_gsplat_checkpoint(path)
    content = torch.load(write_gsplat(path, random_splat()))
    content["splats"]["uncertainty"] = torch.zeros(200)
    torch.save(content, path)
    assert "ignored" in read_gsplat_checkpoint(path).remarks[0]
    assert "uncertainty" in read_gsplat_checkpoint(path).remarks[0]


def test_moved_poses_are_read_or_refused(tmp_path: Path) -> None:
    moves = torch.randn(4, 9)
    path = write_gsplat(tmp_path / "a.pt", random_splat(), pose_adjust={"embeds.weight": moves, "identity": moves[0]})
    assert np.allclose(read_gsplat_checkpoint(path).pose_adjust, moves)
    for wrong in ({}, {"embeds.weight": torch.zeros(4, 6)}, {"embeds.weight": torch.full((4, 9), torch.nan)}):
        write_gsplat(path, random_splat(), pose_adjust=wrong)
        with pytest.raises(InputError, match=r"`pose_adjust` .*--pose_opt"):
            read_gsplat_checkpoint(path)


CONFIG = """antialiased: true
camera_model: pinhole
ckpt: null
data_dir: data/garden
normalize_world_space: false
result_dir: results/garden
steps_scaler: 1.0
strategy: !!python/object:gsplat.strategy.default.DefaultStrategy
  absgrad: false
  refine_scale2d_stop_iter: 0
test_every: 4
with_ut: false
"""


def test_settings_of_the_training_are_read(tmp_path: Path) -> None:
    """As simple_trainer writes cfg.yml next to ckpts/ and ply/; options are stronger."""
    splat = random_splat()
    for folder in ("ckpts", "ply", "other"):
        (tmp_path / folder).mkdir()
    checkpoint = write_gsplat(tmp_path / "ckpts" / "ckpt_29999_rank0.pt", splat)
    ply = write_ply(tmp_path / "ply" / "point_cloud_29999.ply", ply_columns(splat))
    other = write_ply(tmp_path / "other" / "a.ply", ply_columns(splat))
    assert _read(checkpoint).by_gsplat
    config = tmp_path / "cfg.yml"
    config.write_text(CONFIG)
    for path in (checkpoint, ply):
        found = _read(path)
        assert (found.rasterize_mode, found.by_gsplat, found.test_every) == ("antialiased", False, 4)
        assert any("cfg.yml" in text for text in found.remarks)
    assert _read(other).test_every is None
    config.write_text(f"{CONFIG}near_plane: 0.2\nfar_plane: 10000000000.0\n")
    assert _read(ply).clip_planes == (0.2, 1e10)
    config.write_text(CONFIG.replace("true", "false").replace("space: false", "space: true"))
    assert (_read(ply).rasterize_mode, _read(ply).by_gsplat) == ("classic", True)
    config.write_text("antialiased: true\ntest_every: x\n")  # of another program
    assert _read(checkpoint).rasterize_mode is None
    frames = [SimpleNamespace(name=f"{i}.png") for i in range(8)]
    cameras = CameraFile(frames, frozenset(), tmp_path, tmp_path, tmp_path)
    for options, expected in ((SplatOptions(), {"0.png", "4.png"}), (SplatOptions(test_every=5), {"0.png", "5.png"})):
        assert _held_out(options, cameras, 4) == expected


def test_other_primitives_and_damaged_settings_are_refused(tmp_path: Path) -> None:
    path = write_gsplat(tmp_path / "ckpt_29999_rank0.pt", random_splat())
    for old, new, message in (
        ("with_ut: false", "with_ut: true", r"with_ut: true \(3DGUT\)"),
        ("with_ut: false", "with_eval3d: true", r"with_eval3d: true \(3DGUT\)"),
        ("camera_model: pinhole", "camera_model: fisheye", "camera_model: fisheye"),
        ("ckpt: null", "model_type: 2dgs-inria", "model_type: 2dgs-inria"),
        ("ckpt: null", "model_type: 2dgs\nnear_plane: -1", "near_plane '-1', expected a number above 0"),
        ("antialiased: true", "antialiased: maybe", "antialiased 'maybe', expected true or false"),
        ("test_every: 4", "test_every: 1", "test_every '1'"),
        ("ckpt: null", "ckpt: [", "cannot be read as YAML"),
        ("ckpt: null", "ckpt: " + "x" * 300_000, "expected at most"),
    ):
        (tmp_path / "cfg.yml").write_text(CONFIG.replace(old, new))
        with pytest.raises(InputError, match=message) as caught:
            _read(path)
        assert "cfg.yml" in str(caught.value)
