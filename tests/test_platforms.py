"""What another system or an environment without nerfstudio lacks is not needed to load anything."""

import json
import re
import shlex
import sys
from pathlib import Path

import pytest

from normlift_ns import open_scene
from normlift_ns.data.splat import SplatParameters
from tests.cli.conftest import SMALL
from tests.data.scene_files import ply_columns, write_ply
from tests.processes import run

ROOT = Path(__file__).resolve().parents[1]


def test_the_short_list_is_that_of_the_page_and_of_the_project():
    page = (ROOT / "docs" / "install.md").read_text("utf8")
    assert "pip install --no-deps" in page and "-r docs/without_nerfstudio.txt" in page
    project = (ROOT / "pyproject.toml").read_text("utf8").split("[project.urls]")[0]
    lines = (ROOT / "docs" / "without_nerfstudio.txt").read_text("utf8").splitlines()
    for line in (line for line in lines if line and "#" not in line):
        assert f'"{line}"' in project, f"{line} is not what pyproject.toml says"
        assert re.split(r"[<>=!~; ]", line)[0] not in ("nerfstudio", "viser")


@pytest.mark.extra
def test_a_short_list_of_packages_suffices_without_nerfstudio(trained, tmp_path, monkeypatch):
    """In an environment of its own that holds the list and nothing else, a splat of a PLY file is lifted and asked."""
    install = (sys.executable, "-m", "uv", "pip", "install", "--quiet", "--python", tmp_path / "v" / "bin" / "python")
    listed = ROOT / "docs" / "without_nerfstudio.txt"
    monkeypatch.chdir(tmp_path)
    run(sys.executable, "-m", "venv", "--without-pip", tmp_path / "v")
    run(*install, "-r", listed)
    run(*install, "--no-deps", ROOT)
    python = tmp_path / "v" / "bin" / "python"
    code = "import importlib.util as u; print([n for n in ('nerfstudio', 'viser') if u.find_spec(n)])"
    assert run(python, "-c", code).strip() == "[]"
    write_ply(tmp_path / "scene.ply", ply_columns(SplatParameters(**open_scene(trained).parameters)))
    room, world = trained.parents[4] / "room", trained.parent / "dataparser_transforms.json"
    places = ("--load-ply", "scene.ply", "--transforms", room / "transforms.json", "--world-transform", world)
    lift = python.with_name("ns-normlift")
    last = run(lift, *places, *SMALL, "--queries", "red", "--quiet").splitlines()[-1]
    ask = shlex.split(last)
    assert ask[0] == "ns-normlift-query"
    run(python.with_name(ask[0]), *ask[1:], "--output-json", "answers.json")
    assert json.loads((tmp_path / "answers.json").read_text())
    run(python.with_name("ns-normlift-export"), *ask[1:3], "--output-dir", "exported")


@pytest.mark.slow
def test_files_for_github_are_valid():
    checker = pytest.importorskip("check_jsonschema", reason="needs check-jsonschema, which make installs")
    forms = {"issue-forms": "ISSUE_TEMPLATE/[!c]*.yml", "issue-config": "ISSUE_TEMPLATE/c*.yml"}
    for kind, files in {"workflows": "workflows/*.yml", **forms}.items():
        found = list(map(str, (ROOT / ".github").glob(files)))
        assert len(found) > 0
        with pytest.raises(SystemExit) as ended:
            checker.main(["--builtin-schema", f"vendor.github-{kind}", *found])
        assert ended.value.code == 0, kind
