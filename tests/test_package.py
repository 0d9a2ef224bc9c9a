"""What is shipped: a wheel and an sdist with one top-level package, which imports in a clean environment."""

import json
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path, PurePosixPath

import pytest
import tomllib

ROOT = Path(__file__).resolve().parents[1]
MODULES = {path.relative_to(ROOT).as_posix() for path in (ROOT / "normlift_ns").rglob("*.py")}


def run(*command: object, cwd: Path, **kwargs) -> str:
    words = [str(word) for word in command]
    done = subprocess.run(words, check=False, capture_output=True, text=True, cwd=cwd, **kwargs)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def built(tmp_path_factory) -> tuple[Path, Path]:
    """The wheel and the sdist."""
    folder = tmp_path_factory.mktemp("dist")
    run(sys.executable, "-m", "build", "--outdir", folder, ROOT, cwd=folder)
    (wheel,), (sdist,) = folder.glob("*.whl"), folder.glob("*.tar.gz")
    return wheel, sdist


@pytest.mark.slow
def test_wheel_and_sdist_hold_one_package(built):
    wheel, sdist = built
    names = set(zipfile.ZipFile(wheel).namelist())
    assert {PurePosixPath(name).parts[0] for name in names if ".dist-info/" not in name} == {"normlift_ns"}
    assert {name for name in names if name.endswith(".py")} == MODULES
    assert "normlift_ns/py.typed" in names
    with tarfile.open(sdist) as archive:
        members = {
            PurePosixPath(*PurePosixPath(member.name).parts[1:]).as_posix() for member in archive if member.isfile()
        }
    assert members >= MODULES
    assert not [name for name in members if name.startswith(("method_configs", "tests", "benchmarks"))]


@pytest.mark.slow
def test_the_wheel_imports_in_a_clean_environment(built, tmp_path):
    run(sys.executable, "-m", "venv", tmp_path / "clean", cwd=tmp_path)
    python = tmp_path / "clean" / "bin" / "python"
    run(sys.executable, "-m", "uv", "pip", "install", "--python", python, built[0], cwd=tmp_path)
    code = (
        "import torch, normlift_ns as n, pathlib; "
        "scene = n.GaussianScene(torch.zeros(1, 3), torch.ones(1, 4), torch.ones(1, 3), torch.ones(1)); "
        "pose = torch.eye(4); pose[2, 3] = 3; "
        "K = torch.tensor([[20.0, 0, 8], [0, 20, 8], [0, 0, 1]]); "
        "labels = torch.zeros(16, 16, dtype=torch.int32); "
        "e = n.rasterize_evidence(scene, [n.Camera(K, pose, 16, 16)], [labels]); "
        "print(pathlib.Path(n.__file__).parent, e.nnz)"
    )
    where, nnz = run(python, "-c", code, cwd=tmp_path).split()
    assert str(tmp_path) in where
    assert nnz == "1"
    assert run(python.with_name("ns-normlift"), "--version", cwd=tmp_path).startswith("normlift_ns ")
    discovered = (
        "from importlib.metadata import entry_points as e; "
        "print([p.load().config.method_name for p in e(group='nerfstudio.method_configs')])"
    )
    methods = run(python, "-W", "ignore", "-c", discovered, cwd=tmp_path).splitlines()[-1]
    assert sorted(eval(methods)) == ["normlift", "normlift-lerf-ovs", "normlift-scannet"]


def test_another_checkout_is_taken_whole(tmp_path):
    """With a second checkout on PYTHONPATH every module comes from there, that of the entry points too."""
    package = tmp_path / "normlift_ns"
    for name in ("", "method_configs"):
        (package / name).mkdir()
        (package / name / "__init__.py").write_text(f"where = {str(tmp_path)!r}\n")
    code = "import normlift_ns, normlift_ns.method_configs as m; print(m.where, normlift_ns.where)"
    assert (
        run(sys.executable, "-c", code, cwd=tmp_path, env={"PYTHONPATH": str(tmp_path)}).split() == [str(tmp_path)] * 2
    )


def test_the_folder_of_method_configs_is_a_link_for_readers():
    """On a Windows checkout it is a text file, so nothing may import it or name it."""
    link = ROOT / "method_configs"
    assert link.is_symlink() and link.resolve() == ROOT / "normlift_ns" / "method_configs"
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    points = project["project"]["entry-points"]["nerfstudio.method_configs"]
    assert all(value.startswith("normlift_ns.method_configs.") for value in points.values())
    for path in [*ROOT.glob("normlift_ns/**/*.py"), *ROOT.glob("benchmarks/*.py"), *ROOT.glob("tests/**/*.py")]:
        text = path.read_text()
        assert "\nimport method_configs" not in text and "\nfrom method_configs" not in text, path


def test_the_type_checker_resolves_method_configs(tmp_path):
    checker = Path(sys.executable).with_name("basedpyright")
    (tmp_path / "use.py").write_text(
        "from normlift_ns.method_configs.normlift import normlift_method\nreveal_type(normlift_method)\n"
    )
    settings = {"include": ["use.py"], "extraPaths": [str(ROOT)]}
    (tmp_path / "pyrightconfig.json").write_text(json.dumps(settings))
    shown = run(checker, "--pythonpath", sys.executable, cwd=tmp_path)
    assert 'is "MethodSpecification"' in shown
