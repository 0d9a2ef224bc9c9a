import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from normlift_ns.data.splat import read_ply
from normlift_ns.errors import InputError
from tests.data.scene_files import ply_columns, random_splat, write_ply


def test_every_kind_of_splat_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for degree in range(4):
        splat = random_splat(50, degree)
        columns = ply_columns(splat)
        kinds = {
            "little": {},
            "big": {"byte_order": ">"},
            "doubles": {"columns": {name: column.astype(np.float64) for name, column in columns.items()}},
            "text": {"text": True},
            "several blocks": {},
        }
        for kind, how in kinds.items():
            if kind == "several blocks":
                monkeypatch.setattr("normlift_ns.data.splat._PLY_BLOCK_ROWS", 7)
            found = read_ply(write_ply(tmp_path / "a.ply", **{"columns": columns, **how}))
            assert (found.rasterize_mode, found.splat.degree) == (None, degree)
            for name, value in splat.parameters.items():
                if kind == "text":  # written with the digits of a float32
                    torch.testing.assert_close(found.splat.parameters[name], value, rtol=1e-6, atol=1e-7)
                else:
                    assert torch.equal(found.splat.parameters[name], value), (degree, kind, name)
        monkeypatch.undo()


@pytest.mark.parametrize("text", [False, True])
def test_harmless_oddities_of_headers_are_read(tmp_path: Path, text: bool) -> None:
    splat, path = random_splat(20, 1), tmp_path / "a.ply"
    whole = write_ply(path, ply_columns(splat), text=text).read_bytes()
    for line, mode in (
        ("comment été", None),
        ("comment SplatRenderMode: mip", "antialiased"),
        ("comment splatrendermode:classic", "classic"),
        ("comment SplatRenderMode: odd", None),
        ("obj_info", None),
        ("comment\tobj_info 日本", None),
    ):
        for before in (b"element vertex", b"property float f_dc_1", b"end_header"):
            path.write_bytes(whole.replace(before, line.encode() + b"\n" + before, 1))
            found = read_ply(path)
            assert found.rasterize_mode == mode and len(found.remarks) == ("odd" in line)
            for name, value in splat.parameters.items():
                torch.testing.assert_close(found.splat.parameters[name], value, rtol=1e-6, atol=1e-7)
    path.write_bytes(
        whole.replace(b"comment", b"obj_info", 1).replace(b"\n", b"\r\n", whole.count(b"\n")) if text else whole
    )
    assert len(read_ply(path).splat) == 20


def test_columns_that_change_what_is_drawn(tmp_path: Path) -> None:
    splat, width = random_splat(50, 0), 0.03
    columns, other = ply_columns(splat), np.zeros(50, np.float32)
    found = read_ply(write_ply(tmp_path / "a.ply", {**columns, "filter_3D": other + np.float32(width)}))
    before, after = splat.activated, found.splat.activated
    torch.testing.assert_close(after.scales, (before.scales**2 + width**2).sqrt())
    shrunk = before.opacities * before.scales.prod(dim=1) / after.scales.prod(dim=1)
    torch.testing.assert_close(after.opacities, shrunk)
    assert float((after.opacities / before.opacities).min()) < 0.5
    assert found.rasterize_mode == "antialiased" and "filter_3D" in found.remarks[0]
    same = read_ply(write_ply(tmp_path / "a.ply", {**columns, "filter_3D": other})).splat
    torch.testing.assert_close(same.opacities, splat.opacities)
    with pytest.raises(InputError, match="filter_3D"):
        read_ply(write_ply(tmp_path / "a.ply", {**columns, "filter_3D": other - 1}))
    for name in ("beta", "trbf_center", "motion_0", "scale_t", "shape", "shape_0"):
        with pytest.raises(InputError, match=rf"a\.ply has the parameter {name}, .*--load-ply"):
            read_ply(write_ply(tmp_path / "a.ply", {**columns, name: other}))
    named = read_ply(write_ply(tmp_path / "a.ply", {**columns, "segment_id": other}))
    assert ": segment_id" in named.remarks[0]
    assert torch.equal(named.splat.scales, splat.scales)


def _without(*names: str):
    return lambda columns: {name: value for name, value in columns.items() if name not in names}


def _with(name: str, value: float):
    def change(columns):
        columns[name] = columns[name].copy()
        columns[name][3] = value
        return columns

    return change


def test_what_is_not_a_splat_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "scene.ply"
    for change, message in (
        (_without("opacity"), "vertices lack opacity"),
        (_without("f_rest_44"), r"f_rest_\* \(44\)"),
        (_without("rot_0", "scale_1"), "lack scale_1, rot_0"),
        (_with("x", np.nan), "means .*1 of 200, .* row 3"),
        (_with("f_rest_7", np.inf), "colors that are NaN or infinite"),
        (_with("scale_2", np.nan), "scales that are NaN"),
        (_with("scale_2", 100.0), "scales that are NaN or infinite"),
        (_with("opacity", np.nan), "opacities that are NaN"),
        (lambda c: {**c, **{f"rot_{i}": 0 * c["x"] for i in range(4)}}, "only zero quaternions"),
        (lambda c: {**c, **{f"scale_{i}": np.exp(c[f"scale_{i}"]) for i in range(3)}}, "linear scales"),
        (lambda c: {**c, "opacity": 1 / (1 + np.exp(-c["opacity"]))}, "opacities .between"),
        (_without("f_dc_0", "f_dc_1", "f_dc_2"), "spherical harmonics"),
        (lambda c: {name: value[:0] for name, value in c.items()}, "no Gaussians.* 0 vertex"),
        (lambda c: {**c, "packed_position": c["x"]}, "compressed PLY file.* element .chunk. .* not valid .min_x"),
    ):
        write_ply(path, change(ply_columns(random_splat())))
        with pytest.raises(InputError, match=message) as caught:
            read_ply(path)
        assert str(path) in str(caught.value)
    path.write_bytes(write_ply(path, ply_columns(random_splat())).read_bytes()[:-100])
    with pytest.raises(InputError, match=r"scene\.ply is truncated or damaged"):
        read_ply(path)


def test_scenes_measured_in_millimetres_and_infinite_logits_are_read(tmp_path: Path) -> None:
    splat = random_splat()
    large = replace(splat, means=splat.means * 5000, scales=splat.scales + 9)
    assert bool((large.scales >= 0).all())
    assert len(read_ply(write_ply(tmp_path / "a.ply", ply_columns(large))).splat) == 200
    columns = _with("opacity", np.inf)(_with("scale_0", -np.inf)(ply_columns(splat)))
    found = read_ply(write_ply(tmp_path / "a.ply", columns)).splat.activated
    assert found.opacities[3] == 1
    assert found.scales[3, 0] == 0


_MEASURE = """
import sys
from pathlib import Path
from normlift_ns.data.splat import read_ply
from normlift_ns.progress import peak_gib
before = peak_gib()
splat = read_ply(Path(sys.argv[1])).splat
splat.activated
after = peak_gib()
print(len(splat), float(splat.means[-1, 0]), (after - before) * 2**30 / Path(sys.argv[1]).stat().st_size)
"""


@pytest.mark.slow
def test_large_files_are_read_in_less_than_three_times_their_size(tmp_path: Path) -> None:
    """The peak is that of a process of its own."""
    columns = ply_columns(random_splat(300_000))
    words = [sys.executable, "-c", _MEASURE, str(write_ply(tmp_path / "large.ply", columns))]
    count, last, factor = subprocess.run(words, capture_output=True, text=True, check=True).stdout.split()
    assert (int(count), float(last)) == (300_000, columns["x"][-1])
    assert float(factor) < 3, factor
