"""A built wheel installs and imports in a clean environment."""

import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


@pytest.mark.slow
def test_wheel_installs_and_imports_in_a_clean_environment(tmp_path):
    def run(*command: object, **kwargs) -> str:
        done = subprocess.run(
            [str(c) for c in command], check=False, capture_output=True, text=True, cwd=tmp_path, **kwargs
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    run(sys.executable, "-m", "build", "--wheel", "--outdir", tmp_path, ROOT)
    (wheel,) = tmp_path.glob("*.whl")
    names = zipfile.ZipFile(wheel).namelist()
    assert "normlift_ns/py.typed" in names
    assert "normlift_ns/method_configs/__init__.py" in names
    assert not [name for name in names if name.startswith(("tests", "benchmarks"))]

    run(sys.executable, "-m", "venv", tmp_path / "clean")
    python = tmp_path / "clean" / "bin" / "python"
    run(sys.executable, "-m", "uv", "pip", "install", "--python", python, wheel)
    code = (
        "import torch, normlift_ns as n, pathlib; "
        "scene = n.GaussianScene(torch.zeros(1, 3), torch.ones(1, 4), torch.ones(1, 3), torch.ones(1)); "
        "pose = torch.eye(4); pose[2, 3] = 3; "
        "K = torch.tensor([[20.0, 0, 8], [0, 20, 8], [0, 0, 1]]); "
        "labels = torch.zeros(16, 16, dtype=torch.int32); "
        "e = n.rasterize_evidence(scene, [n.Camera(K, pose, 16, 16)], [labels]); "
        "print(pathlib.Path(n.__file__).parent, e.nnz)"
    )
    where, nnz = run(python, "-c", code).split()
    assert str(tmp_path) in where
    assert nnz == "1"
