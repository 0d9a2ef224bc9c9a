"""Splats in compressed formats and glTF: round trips within the precision of each, other writers, hostile files."""

import base64
import gzip
import json
import re
import struct
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
import torch
import zstandard
from numpy.lib.recfunctions import repack_fields
from plyfile import PlyData, PlyElement
from scipy.spatial.transform import Rotation

from normlift_ns.data.antimatter import read_antimatter
from normlift_ns.data.compressed_ply import encode_compressed_ply, normalize_quats
from normlift_ns.data.gltf import encode_glb, read_gltf
from normlift_ns.data.open_splat import _format, _read
from normlift_ns.data.splat import SplatParameters, read_ply
from normlift_ns.data.spz import encode_spz, read_spz
from normlift_ns.errors import InputError
from tests.data.scene_files import in_world, ply_columns, random_splat, rows_of, write_ply

N = 700


def write_antimatter(path: Path, splat: SplatParameters) -> Path:
    """As antimatter15's converter writes it, in the order of the rows."""
    rows = np.empty(len(splat), [("means", "<f4", 3), ("scales", "<f4", 3), ("colors", "u1", 4), ("quats", "u1", 4)])
    rows["means"], rows["scales"] = splat.means, splat.scales.exp()
    colors = torch.cat([0.5 + 0.28209479177387814 * splat.features_dc, splat.opacities.sigmoid()], dim=1)
    rows["colors"] = (colors * 255).clip(0, 255)
    rows["quats"] = (normalize_quats(splat.quats) * 128 + 128).clip(0, 255)
    path.write_bytes(rows.tobytes())
    return path


def write_any(path: Path, splat: SplatParameters, kind: str) -> tuple[Path, np.ndarray]:
    """Write a splat, and return its file and the rows in the order of the file."""
    path, rows = path / f"scene.{kind}", np.arange(len(splat))
    if kind in ("spz", "spz4"):
        path.write_bytes(encode_spz(splat, version=3 if kind == "spz" else 4))
    elif kind == "splat":
        write_antimatter(path, splat)
    elif kind == "glb":
        path.write_bytes(encode_glb(splat, {}, {}))
    else:
        encoded = encode_compressed_ply(splat.parameters, "scene.ply")
        path.write_bytes(encoded.data)
        rows = encoded.rows
    return path, rows


def angles(first: torch.Tensor, second: torch.Tensor) -> torch.Tensor:
    cosine = (normalize_quats(first.double()) * normalize_quats(second.double())).sum(dim=1).abs()
    return 2 * cosine.clamp(max=1).acos()


PRECISION = {
    "spz": {"means": 1.2e-6, "scales": 0.0313, "opacities": 0.002, "quats": 0.004, "colors": 0.0131, "rest": 0.0626},
    "glb": {"means": 0, "scales": 1e-5, "opacities": 1e-6, "quats": 1e-6, "colors": 0, "rest": 0},
    "ply": {"means": 0.005, "scales": 0.005, "opacities": 0.002, "quats": 0.004, "colors": 0.014, "rest": 0.0314},
}
"""Largest errors by format, for a scene of a few units."""


@pytest.mark.parametrize("kind", ["spz", "spz4", "glb", "ply"])
@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
def test_a_splat_comes_back_within_the_precision_of_its_format(tmp_path: Path, kind: str, degree: int) -> None:
    made = random_splat(N, degree)
    splat = replace(made, features_rest=made.features_rest.clamp(-1, 1), features_dc=made.features_dc.clamp(-1.7, 1.7))
    path, rows = write_any(tmp_path, splat, kind)
    found = _read(path)
    assert sorted(rows) == list(range(N))
    ours, theirs, limits = found.splat, rows_of(splat, rows), PRECISION[kind[:3]]  # type: ignore[arg-type]
    errors = {
        "means": (ours.means - theirs.means).abs().max(),
        "scales": (ours.scales - theirs.scales).abs().max(),
        "opacities": (ours.opacities.sigmoid() - theirs.opacities.sigmoid()).abs().max(),
        "quats": angles(ours.quats, theirs.quats).max(),
        "colors": (ours.features_dc - theirs.features_dc).abs().max(),
    }
    if degree > 0:
        assert ours.degree == (degree if "spz" in kind else min(degree, 3))
        kept = theirs.features_rest[:, : ours.features_rest.shape[1]]
        errors["rest"] = (ours.features_rest - kept).abs().max()
    for name, error in errors.items():
        assert float(error) <= limits[name], (name, float(error))
    said = [re.search(r"([\d.e-]+) for positions", text) for text in found.remarks]
    if kind in ("spz", "spz4"):  # the message has the true size
        assert float(errors["means"]) <= float(said[0][1]) * 1.05 < 10 * float(errors["means"]) + 1e-6


def test_other_writers_of_the_same_formats_are_read(tmp_path: Path) -> None:
    """glTF with buffers outside and quantized attributes, SPZ in glTF, PLY of the first version."""
    splat = random_splat(50, 1)
    document, binary = _glb(encode_glb(splat, {}, {}))
    document["buffers"][0]["uri"] = "my%20scene.bin"
    (tmp_path / "my scene.bin").write_bytes(binary)
    path = tmp_path / "scene.gltf"
    path.write_text(json.dumps(document))
    assert torch.equal(_read(path).splat.means, splat.means)
    document["buffers"][0]["uri"] = "data:application/octet-stream;base64," + base64.b64encode(binary).decode()
    attributes, quats = _primitive(document)["attributes"], normalize_quats(splat.quats).roll(-1, dims=1)
    packed = (quats * 32767).round().short().numpy().tobytes()
    opacity = (splat.opacities.sigmoid() * 255).round().byte().numpy()
    strided = np.zeros((50, 4), np.uint8)  # rows of four bytes, of which one is used
    strided[:, :1] = opacity
    for name, data, kind, number in (
        ("ROTATION", packed, "VEC4", 5122),
        ("OPACITY", strided.tobytes(), "SCALAR", 5121),
    ):
        document["buffers"].append({"byteLength": len(data), "uri": "data:;base64," + base64.b64encode(data).decode()})
        view = {"buffer": len(document["buffers"]) - 1, "byteLength": len(data)}
        document["bufferViews"].append({**view, "byteStride": 4} if name == "OPACITY" else view)
        accessor = {"bufferView": len(document["bufferViews"]) - 1, "componentType": number, "count": 50, "type": kind}
        document["accessors"].append({**accessor, "normalized": True})
        attributes[f"KHR_gaussian_splatting:{name}"] = len(document["accessors"]) - 1
    path.write_text(json.dumps(document))
    found = _read(path)
    assert float(angles(found.splat.quats, splat.quats).max()) < 2e-3
    assert float((found.splat.opacities.sigmoid() - splat.opacities.sigmoid()).abs().max()) < 0.002

    data = encode_spz(splat)
    _settings(document)["extensions"] = {"KHR_gaussian_splatting_compression_spz_2": {"bufferView": 0}}
    uri = "data:;base64," + base64.b64encode(data).decode()
    document["buffers"] = [{"byteLength": len(data), "uri": uri}]
    document["bufferViews"] = [{"buffer": 0, "byteLength": len(data)}]
    path.write_text(json.dumps(document))
    assert float((read_gltf(path).splat.means - splat.means).abs().max()) < 1e-5

    encoded = encode_compressed_ply(splat.parameters, "a.ply", ("SplatRenderMode: mip",))
    path = tmp_path / "scene.ply"
    path.write_bytes(encoded.data)
    assert read_ply(path).rasterize_mode == "antialiased"
    ply = PlyData.read(str(path))
    names = [name for name in ply["chunk"].data.dtype.names if not name.endswith(("_r", "_g", "_b"))]
    chunks = PlyElement.describe(repack_fields(ply["chunk"].data[names]), "chunk")
    PlyData([chunks, ply["vertex"], ply["sh"]], byte_order="<").write(str(tmp_path / "first.ply"))
    assert float((read_ply(tmp_path / "first.ply").splat.means - splat.means[encoded.rows]).abs().max()) < 0.01


@pytest.mark.parametrize("is_matrix", [False, True])
def test_transforms_of_gltf_nodes_move_the_splat(tmp_path: Path, is_matrix: bool) -> None:
    splat, outer, inner = random_splat(50, 3), Rotation.from_rotvec([0.3, -1.1, 0.4]), Rotation.from_rotvec([2, 1, 0])
    parent = {"rotation": outer.as_quat().tolist(), "scale": [2.5] * 3, "translation": [30, -4, 5], "children": [2]}
    child = {"rotation": inner.as_quat().tolist(), "scale": [0.2] * 3, "translation": [1, 2, 3], "mesh": 0}
    first, second = np.eye(4), np.eye(4)
    first[:3] = np.column_stack([2.5 * outer.as_matrix(), [30, -4, 5]])
    second[:3] = np.column_stack([0.2 * inner.as_matrix(), [1, 2, 3]])
    if is_matrix:
        child = {"matrix": second.T.ravel().tolist(), "mesh": 0}
    document, binary = _glb(encode_glb(splat, {}, {}))
    document["nodes"] = [{"children": [1]}, parent, child]
    document["buffers"][0]["uri"] = "data:;base64," + base64.b64encode(binary).decode()
    path = tmp_path / "scene.gltf"
    path.write_text(json.dumps(document))
    file, expected = _read(path), in_world(splat, first @ second)
    assert "scale 0.5" in file.remarks[0]
    assert float(angles(file.splat.quats, expected.quats).max()) < 1e-5
    for name in ("means", "scales", "features_dc", "features_rest"):
        found = getattr(file.splat, name)
        torch.testing.assert_close(found, getattr(expected, name), rtol=1e-5, atol=1e-5, msg=name)


def _glb(data: bytes) -> tuple[dict[str, Any], bytes]:
    (length,) = struct.unpack_from("<I", data, 12)
    return json.loads(data[20 : 20 + length]), data[28 + length :]


def _with_glb(change: Callable[[dict[str, Any]], object]) -> bytes:
    document, binary = _glb(encode_glb(random_splat(20, 1), {}, {}))
    change(document)
    text = json.dumps(document).encode()
    head = struct.pack("<4sII", b"glTF", 2, 28 + len(text) + len(binary))
    parts = (struct.pack("<I4s", len(text), b"JSON"), text, struct.pack("<I4s", len(binary), b"BIN\0"), binary)
    return head + b"".join(parts)


def _primitive(document: dict[str, Any]) -> dict[str, Any]:
    return document["meshes"][0]["primitives"][0]


def _settings(document: dict[str, Any]) -> dict[str, Any]:
    return _primitive(document)["extensions"]["KHR_gaussian_splatting"]


def test_what_cannot_be_read_is_refused_by_name(tmp_path: Path) -> None:
    splat = random_splat(20, 1)
    spz, spz4 = encode_spz(splat), encode_spz(splat, version=4)
    content = gzip.decompress(spz)

    def changed(data: bytes, at: int, value: bytes) -> bytes:
        return data[:at] + value + data[at + len(value) :]

    zipped = tmp_path / "made.zip"
    for name, data, message in (
        ("a.spz", gzip.compress(b"plain text of another kind"), "not an SPZ file.* gunzip"),
        ("a.spz", gzip.compress(changed(content, 4, b"\1")), "version 1, expected 2, 3 or 4"),
        ("a.spz", gzip.compress(changed(content, 8, b"\0\0\0\0")), "no Gaussians"),
        ("a.spz", gzip.compress(changed(content, 12, b"\7")), "degree 7"),
        ("a.spz", gzip.compress(changed(content, 8, b"\xff\xff\xff\x7f")), "declares 2,147,483,647 Gaussians"),
        ("a.spz", spz[:-30], "truncated or damaged"),
        ("a.spz", spz[:-8], "ends before its checksum"),
        ("a.spz", changed(spz, len(spz) - 8, bytes(4)), "truncated or damaged"),
        ("a.spz", changed(spz4, 15, b"\3"), "table of 3 streams"),
        ("a.spz", changed(spz4, 40, b"\xff\xff"), "stream 0 declares"),
        ("a.spz", spz4[:-9], r"damaged: its stream 5 ends after"),
        ("a.spz", spz4[:8], "header ends after 8 of"),
        ("a.spz", b"<!DOCTYPE html><html>", "HTML page.*Download"),
        ("a.ply", b"version https://git-lfs.github.com/spec/v1\noid sha256:0\n", "git lfs pull"),
        ("a.gltf", b'{"lodLevels": 2}', "schema of glTF.*asset"),
        ("a.glb", _with_glb(lambda d: d["accessors"][2].update(sparse={"count": 1})), "ROTATION in an accessor"),
        ("a.glb", _with_glb(lambda d: _primitive(d)["extensions"].clear()), "found 0 .*any kind: 1.*not a mesh"),
        ("a.glb", _with_glb(lambda d: d["meshes"].append(d["meshes"][0])), "found 2 "),
        ("a.glb", _with_glb(lambda d: d.update(extensionsRequired=["EXT_meshopt_compression"])), "EXT_meshopt"),
        ("a.glb", _with_glb(lambda d: _settings(d).update(kernel="disc")), "disc"),
        ("a.glb", _with_glb(lambda d: _primitive(d)["attributes"].pop("POSITION")), "no attribute POSITION"),
        ("a.glb", _with_glb(lambda d: d["accessors"][0].update(count=10**12)), "rows of POSITION, 1,000,000,000,000,"),
        ("a.glb", _with_glb(lambda d: d["bufferViews"][0].update(byteOffset=-4)), "buffer view"),
        ("a.glb", _with_glb(lambda d: d["buffers"][0].update(uri="../a.bin")), "in the same folder"),
        ("a.glb", _with_glb(lambda d: d["accessors"][3].update(bufferView=0, byteOffset=4)), "damaged|linear scales"),
        ("a.glb", _with_glb(lambda d: d["nodes"][0].update(scale=[1, 1, 2])), "not a similarity.*PLY file"),
        ("a.glb", _with_glb(lambda d: d["nodes"][0].update(scale=[1e300] * 3)), "not finite"),
        ("a.glb", _with_glb(lambda d: d["nodes"][0].update(rotation=[0, 0, 0, 0])), "rotation of a node is zero"),
        ("a.glb", _with_glb(lambda d: d["nodes"][0].update(matrix=[1] * 12)), "nodes.*matrix"),
        ("a.glb", _with_glb(lambda d: d["nodes"][0].update(children=[0])), "its own parent"),
        ("a.glb", _with_glb(lambda d: d["nodes"].append({"mesh": 0})), "several instances"),
        ("a.glb", _with_glb(lambda d: d["nodes"][0].update(extensions={"EXT_mesh_gpu_instancing": {}})), "instances"),
        ("a.glb", b"glTF" + bytes(7), "header does not match"),
        ("a.glb", b"glTF" + bytes(8), "GLB version 0, expected 2"),
        ("a.splat", bytes(33), "33 bytes, expected a positive multiple of 32"),
        ("a.splat", np.full(16, -1, "<f4").tobytes(), "negative scales"),
        ("a.ksplat", bytes(4096), "KSPLAT, .*npx @playcanvas/splat-transform a.ksplat a.ply"),
        ("lod-meta.json", b"{}", "streamed SOG, .*Export a PLY file"),
        ("meta.json", b"{}", "SOG, .*npx @playcanvas/splat-transform meta.json meta.ply"),
        ("a.usdc", b"PXR-USDC", "USDC, .*Export a PLY file"),
    ):  # fmt: skip
        (tmp_path / name).write_bytes(data)
        with pytest.raises(InputError, match=message) as caught:
            _read(tmp_path / name)
        assert str(tmp_path / name) in str(caught.value)
    for names, message in (
        (("meta.json", "means_l.webp"), "SOG, .*splat-transform made.zip made.ply"),
        (("default.usda",), "USDZ, .*Export a PLY file"),
        (("model/scene.ply",), "ZIP archive of model/scene.ply.* extract"),
        ((), "ZIP archive of nothing"),
    ):
        with zipfile.ZipFile(zipped, "w") as archive:
            for name in names:
                archive.writestr(name, b"x")
        with pytest.raises(InputError, match=message):
            _read(zipped)


def test_small_files_that_would_grow_are_refused_or_cost_little(tmp_path: Path) -> None:
    """A stream that goes on after the declared Gaussians is not read; declared sizes are not believed."""
    splat = random_splat(20, 0)
    content = gzip.decompress(encode_spz(splat))
    path = tmp_path / "a.spz"
    path.write_bytes(gzip.compress(content + bytes(10**7)))
    assert len(read_spz(path).splat) == 20
    bomb = zlib.compressobj(9, zlib.DEFLATED, 31)
    head = content[:8] + struct.pack("<I", 2**31 - 1) + content[12:16]
    path.write_bytes(bomb.compress(head + bytes(10**7)) + bomb.flush())
    with pytest.raises(InputError, match="declares 2,147,483,647"):
        read_spz(path)
    spz4 = encode_spz(splat, version=4)
    streams = [zstandard.compress(bytes(10**7))] * 5
    sizes = [9 * 20, 20, 60, 60, 80]
    table = b"".join(struct.pack("<QQ", len(stream), size) for stream, size in zip(streams, sizes))
    path.write_bytes(spz4[:32] + table + b"".join(streams))
    assert len(read_spz(path).splat) == 20


@pytest.mark.parametrize("version", [3, 4])
def test_extensions_of_spz_are_named(tmp_path: Path, version: Literal[3, 4]) -> None:
    splat, path = random_splat(20, 1), tmp_path / "a.spz"
    plain = encode_spz(splat, version=version)
    path.write_bytes(plain)
    expected = read_spz(path)
    record = struct.pack("<III", 0xADBE0003, 4, 6)  # the coordinate system RDF
    content = bytearray(gzip.decompress(plain) if version == 3 else plain)
    content[14] |= 2
    if version == 3:
        path.write_bytes(gzip.compress(bytes(content) + record))
    else:
        content[16:20] = struct.pack("<I", 32 + len(record))
        path.write_bytes(bytes(content[:32]) + record + bytes(content[32:]))
    found = read_spz(path)
    for name, value in expected.splat.parameters.items():
        assert torch.equal(found.splat.parameters[name], value)
    assert [text for text in found.remarks if text not in expected.remarks and "--world-transform" in text] != []


def test_the_first_bytes_tell_the_format(tmp_path: Path) -> None:
    splat = random_splat(20, 0)
    for kind in ("spz", "spz4", "glb", "ply"):
        path, _ = write_any(tmp_path, splat, kind)
        other = path.rename(tmp_path / "renamed.splat")
        assert _format(other) == kind[:3]
    write_ply(tmp_path / "renamed.splat", ply_columns(splat))
    assert _format(tmp_path / "renamed.splat") == "ply"
    assert read_antimatter(write_antimatter(tmp_path / "b.SPLAT", splat)).splat.degree == 0
    assert _format(tmp_path / "b.SPLAT") == "splat"
