"""Splats of a lifted run in other formats than PLY: Gaussians, labels and rows are those of the run."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from normlift_ns import open_run
from normlift_ns.cli import export
from normlift_ns.data.gltf import _open_gltf, _read_accessor
from normlift_ns.data.open_splat import _read
from normlift_ns.errors import InputError
from tests.cli.conftest import run_entry, said


def test_every_format_has_the_gaussians_of_the_run(lifted: Path, tmp_path: Path, monkeypatch, capsys) -> None:
    given = ("--load-config", lifted, "--output-dir", tmp_path, "--output-filename", "a.glb", "--select", "selection")
    assert run_entry(monkeypatch, export.entrypoint, *given, "--exporters", "spz", "spz4", "compressed_ply") == 0
    assert said(capsys).count("contains rounded numbers") == 3
    run = open_run(lifted)
    answer = run.ask_stored()
    scene, trained = run.scene, run.scene.parameters
    files = {
        "a.glb": 1e-6, "a_spz.spz": 1e-5, "a_spz4.spz": 1e-5, "a_compressed_ply.ply": 0.02,
        "b.spz": 1e-5, "c.compressed.ply": 0.02, "d.glb": 1e-6,
    }  # fmt: skip
    for name in files:
        if name[0] != "a":
            rows = run.export(tmp_path / name, answer)
            assert np.array_equal(rows, np.load(tmp_path / f"{Path(name).stem}_rows.npy"))
    with pytest.raises(InputError, match=r"e\.sog is not written: .* \.glb, \.spz"):
        run.export(tmp_path / "e.sog", answer)
    with pytest.raises(FileExistsError):
        run.export(tmp_path / "b.spz", answer)
    run.export(tmp_path / "b.spz", answer, overwrite=True)
    for name, limit in files.items():
        stem = Path(name).stem
        rows, names = np.load(tmp_path / f"{stem}_rows.npy"), (tmp_path / f"{stem}_names.json").read_text()
        assert set(rows) <= set(answer.mask.nonzero()[:, 0].tolist())
        assert json.loads(names)["class_id"] == {"1": "red", "2": "yellow"}
        file = _read(tmp_path / name)
        assert file.rasterize_mode in (None, scene.rasterize_mode)
        assert len(file.splat) == len(rows) > 100
        assert float((file.splat.means - trained["means"][rows]).abs().max()) <= limit
        opacities = scene.gaussians.opacities[rows]
        assert float((file.splat.activated.opacities - opacities).abs().max()) < 0.002


def test_a_glb_file_has_labels_and_their_names(lifted: Path, tmp_path: Path) -> None:
    run = open_run(lifted)
    answer = run.ask("red", "sky blue")
    rows = run.export(tmp_path / "a.glb", answer=answer)
    gltf = _open_gltf(tmp_path / "a.glb")
    (mesh,) = gltf.document.meshes
    attributes = mesh.primitives[0].attributes

    def column(name: str) -> np.ndarray:
        return _read_accessor(gltf, attributes[name], name, 1)[:, 0]

    assert np.array_equal(column("_RELIABILITY"), run.field.scalars.reliability.numpy()[rows])
    assert np.array_equal(column("_RELEVANCY_1"), answer.relevancy[:, 1].numpy()[rows])
    assert mesh.extras["class_id"] == {"1": "red", "2": "sky blue"}
    assert mesh.extras["rasterize_mode"] == run.scene.rasterize_mode
    ids = column("_CLASS_ID")
    assert set(ids) == {0.0, 1.0, 2.0}
    counts = {number: about["gaussians"] for number, about in mesh.extras["instance_id"].items()}
    found, sizes = np.unique(column("_INSTANCE_ID"), return_counts=True)
    assert {str(int(i)): n for i, n in zip(found, sizes) if i > 0}.keys() == counts.keys()
    assert torch.equal(_read(tmp_path / "a.glb").splat.means, run.scene.parameters["means"][rows])
