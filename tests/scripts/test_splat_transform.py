"""The standard converter of splats reads our exports: @playcanvas/splat-transform 3.7.0, with node 22, from npm.

Version 2.7.1, which npm installs on older nodes without a word, hides what version 3 does to signed numbers.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData

from normlift_ns import open_run

VERSION, NODE = "3.7.0", "22"
FOLDER = Path(tempfile.gettempdir()) / f"normlift-splat-transform-{VERSION}"
"""Kept, so that it is downloaded once."""


@pytest.fixture(scope="module")
def converter() -> list[str]:
    """The words that start it."""
    npm = shutil.which("npm")
    if npm is None:
        pytest.skip("npm is absent, which brings the converter")
    package = FOLDER / "node_modules" / "@playcanvas" / "splat-transform" / "package.json"
    node = FOLDER / "node_modules" / "node" / "bin" / "node"
    if not (package.is_file() and node.is_file()):
        FOLDER.mkdir(exist_ok=True)
        (FOLDER / "package.json").write_text('{"private": true}')
        install = [npm, "install", "--no-audit", "--no-fund", f"@playcanvas/splat-transform@{VERSION}", f"node@{NODE}"]
        done = subprocess.run(install, cwd=FOLDER, capture_output=True, text=True, timeout=300, check=False)
        if done.returncode != 0 or not node.is_file():
            pytest.skip(f"npm cannot install the converter: {' '.join((done.stderr + done.stdout).split())[-300:]}")
    assert json.loads(package.read_text())["version"] == VERSION
    binary = json.loads(package.read_text())["bin"]
    start = package.parent / (binary if isinstance(binary, str) else binary["splat-transform"])
    return [str(node), str(start)]


@pytest.mark.extra
@pytest.mark.parametrize("mode", ["classic", "antialiased"])
def test_the_converter_keeps_what_we_say(mode, converter, lifted: Path, tmp_path: Path) -> None:
    node = subprocess.run([converter[0], "--version"], capture_output=True, text=True, check=True).stdout
    assert node.startswith(f"v{NODE}.")
    run = open_run(lifted)
    if mode == "antialiased":
        run.scene.model_config.rasterize_mode = mode  # type: ignore[attr-defined]
    run.export(tmp_path / "a.ply", answer=run.ask("red", "yellow"))
    ours = PlyData.read(tmp_path / "a.ply")
    assert ("SplatRenderMode: mip" in ours.comments) == (mode == "antialiased")
    words = [*converter, str(tmp_path / "a.ply"), str(tmp_path / "b.ply")]
    done = subprocess.run(words, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    theirs = PlyData.read(tmp_path / "b.ply")["vertex"]
    assert theirs.count == ours["vertex"].count
    order = [np.lexsort([table[name] for name in "xyz"]) for table in (theirs, ours["vertex"])]
    for name in {p.name for p in ours["vertex"].properties} - {"nx", "ny", "nz"}:
        found, wanted = (t[name][o].astype(float) for t, o in zip((theirs, ours["vertex"]), order))
        assert np.allclose(found, wanted, rtol=0 if name.endswith("_id") else 1e-5, atol=1e-5), name
    kept = [*converter, str(tmp_path / "a.ply"), "--filter-value", "class_id,eq,1", str(tmp_path / "c.ply")]
    done = subprocess.run(kept, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert PlyData.read(tmp_path / "c.ply")["vertex"].count == int((ours["vertex"]["class_id"] == 1).sum())
