"""What is shipped: a wheel and an sdist with one top-level package, which imports in a clean environment."""

import json
import re
import sys
import sysconfig
import tarfile
import zipfile
from pathlib import Path, PurePosixPath

import pytest

import normlift_ns
from research import licences
from tests.conftest import project
from tests.processes import run

ROOT = Path(__file__).resolve().parents[1]
MODULES = {path.relative_to(ROOT).as_posix() for path in (ROOT / "normlift_ns").rglob("*.py")}


@pytest.fixture(scope="module")
def built(tmp_path_factory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("dist")
    run(sys.executable, "-m", "build", "--no-isolation", "--outdir", folder, ROOT, cwd=folder)
    (wheel,), (sdist,) = folder.glob("*.whl"), folder.glob("*.tar.gz")
    return wheel, sdist


@pytest.mark.slow
def test_wheel_and_sdist_hold_one_package_and_its_readme(built):
    wheel, sdist = built
    names = set(zipfile.ZipFile(wheel).namelist())
    assert {PurePosixPath(name).parts[0] for name in names if ".dist-info/" not in name} == {"normlift_ns"}
    assert {name for name in names if name.endswith(".py")} == MODULES
    assert "normlift_ns/py.typed" in names
    with tarfile.open(sdist) as archive:
        members = {member.name.partition("/")[2] for member in archive if member.isfile()}
    assert members >= MODULES
    beside = {"LICENSE", "MANIFEST.in", "PKG-INFO", "README.md", "pyproject.toml", "setup.cfg", "setup.py"}
    packed = {name for name in members if not name.startswith(("normlift_ns/", "normlift_ns.egg-info/", "web/"))}
    page = {f"normlift_ns/page/{name}" for name in ("index.html", "assets/page.js.gz", "assets/style.css.gz")}
    plain = {name.removesuffix(".gz") for name in page}
    assert page | plain <= members & names and {"web/backend.py", "web/package-lock.json", "web/src/main.js"} <= members
    assert not [name for name in members if "node_modules" in name]
    assert sum(len(zipfile.ZipFile(wheel).read(name)) for name in page) <= 1.6e6
    assert packed == beside and {"xkcd.json", "imagenet_words.json"} <= {
        PurePosixPath(name).name for name in members & names
    }
    assert not [name for name in members | names if "__pycache__" in name or name.startswith(".")]
    # the index shows the README with links that lead somewhere
    (name,) = (name for name in zipfile.ZipFile(built[0]).namelist() if name.endswith("dist-info/METADATA"))
    shown = zipfile.ZipFile(built[0]).read(name).decode()
    files = f"{project()['urls']['Source']}/blob/main/"
    links = re.findall(r"\]\(([^)#]+)", shown)
    assert len(links) > 15 and all(link.startswith("https://") for link in links)
    paths = [link.removeprefix(files).removesuffix("?raw=true") for link in links if link.startswith(files)]
    assert len(paths) > 15 and all((ROOT / path).is_file() for path in paths)
    assert f"({files}docs/own_panels.jpg?raw=true)" in shown and "Description-Content-Type: text/markdown" in shown
    assert f"\nVersion: {normlift_ns.__version__}\n" in shown


def test_every_place_has_the_same_version_and_the_project_has_addresses():
    version = normlift_ns.__version__
    assert f"\nversion: {version}\n" in (ROOT / "CITATION.cff").read_text()
    sections = re.findall(r"^## (\S+)", (ROOT / "CHANGELOG.md").read_text("utf8"), re.MULTILINE)
    assert [name for name in sections if name != "Unreleased"][0] == version  # noqa: RUF015
    assert "Unreleased" not in sections[1:]
    assert {"Source", "Issues", "Changelog"} <= set(project()["urls"])


def check_installed(python: Path, folder: Path) -> None:
    """The commands, the package and the methods of an environment."""
    code = (
        "import torch, normlift_ns as n, pathlib; "
        "scene = n.GaussianScene(torch.zeros(1, 3), torch.ones(1, 4), torch.ones(1, 3), torch.ones(1)); "
        "pose = torch.eye(4); pose[2, 3] = 3; "
        "K = torch.tensor([[20.0, 0, 8], [0, 20, 8], [0, 0, 1]]); "
        "labels = torch.zeros(16, 16, dtype=torch.int32); "
        "e = n.rasterize_evidence(scene, [n.Camera(K, pose, 16, 16)], [labels]); "
        "from importlib.metadata import entry_points as p; "
        "methods = sorted(x.name for x in p(group='nerfstudio.method_configs') if 'normlift' in x.name); "
        "print(pathlib.Path(n.__file__).parent, e.nnz, *methods)"
    )
    where, nnz, *methods = run(python, "-W", "ignore", "-c", code, cwd=folder).split()
    assert str(folder) in where and nnz == "1"
    assert methods == ["normlift", "normlift-lerf-ovs", "normlift-scannet"]
    command = python.with_name("ns-normlift")
    assert run(command, "--version", cwd=folder).strip() == f"normlift_ns {normlift_ns.__version__}"
    assert "--load-ply" in run(command, "--help", cwd=folder)


@pytest.mark.slow
def test_the_wheel_imports_beside_the_packages_of_this_environment(built, tmp_path):
    python = tmp_path / "v" / "bin" / "python"
    run(sys.executable, "-m", "venv", "--without-pip", tmp_path / "v", cwd=tmp_path)
    (packages,) = (tmp_path / "v").glob("lib/python*/site-packages")
    (packages / "beside.pth").write_text(sysconfig.get_paths()["purelib"])
    how = ("--no-deps", "--offline", "--python", python)
    run(sys.executable, "-m", "uv", "pip", "install", *how, built[0], cwd=tmp_path)
    check_installed(python, tmp_path)


@pytest.mark.extra
def test_the_wheel_works_in_a_clean_environment(built, tmp_path):
    """As docs/install.md says; the packages come from an index."""
    run(sys.executable, "-m", "venv", tmp_path / "clean", cwd=tmp_path)
    python = tmp_path / "clean" / "bin" / "python"
    run(sys.executable, "-m", "uv", "pip", "install", "--python", python, built[0], cwd=tmp_path)
    check_installed(python, tmp_path)
    run(python, "-m", "normlift_ns.cli.demo", "--num-gaussians", 3000, "--views", 6, cwd=tmp_path)
    answers = json.loads((tmp_path / "demo" / "answers.json").read_text())
    assert {"tomato red", "pumpkin"} <= {query["text"] for query in answers["queries"]}
    code = "from importlib.metadata import entry_points as e; [p.load() for p in e(group='nerfstudio.method_configs')]"
    run(python, "-W", "ignore", "-c", code, cwd=tmp_path)


def test_the_folder_of_method_configs_is_a_link_for_readers():
    """On a Windows checkout it is a text file, so nothing may import it or name it."""
    link = ROOT / "method_configs"
    assert link.is_symlink() and link.resolve() == ROOT / "normlift_ns" / "method_configs"
    points = project()["entry-points"]["nerfstudio.method_configs"]
    assert all(value.startswith("normlift_ns.method_configs.") for value in points.values())
    for path in [*ROOT.glob("normlift_ns/**/*.py"), *ROOT.glob("research/*.py"), *ROOT.glob("tests/**/*.py")]:
        text = path.read_text()
        assert "\nimport method_configs" not in text and "\nfrom method_configs" not in text, path


def test_every_dependency_and_its_licence_are_listed():
    extras = project()["optional-dependencies"].values()
    named = [*project()["dependencies"], *(x for extra in extras for x in extra)]
    names = {re.split(r"[\s<>=!~;\[]", line)[0].lower().replace("_", "-") for line in named} - {"normlift-ns"}
    rows = [line.split("|")[1:4] for line in licences.PAGE.read_text("utf8").splitlines() if line.startswith("| ")][1:]
    assert {row[0].strip() for row in rows} == names, "refresh the table: python -m research.licences"
    assert all(row[1].strip() not in ("", "see its page") for row in rows)
    assert licences.packages().keys() <= names  # those of the installed metadata, which make refreshes
    assert licences.licence("pytest") == "MIT"
