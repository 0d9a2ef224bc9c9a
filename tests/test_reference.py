"""The reference is that of the code, its examples are true, and the site builds; the commands are held against the code
by tests/scripts/test_help.py."""

from __future__ import annotations

import doctest
import os
import re
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

import normlift_ns
from benchmarks.reference import PAGE, page

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = Path(normlift_ns.__file__).parent


def test_the_page_is_made_of_the_code():
    assert PAGE.read_text("utf8") == page(), "refresh it: python -m benchmarks.reference"


def test_every_public_name_is_in_the_reference():
    shown = re.findall(r"^::: normlift_ns\.[\w.]*?(\w+)$", (PAGE.parent / "api.md").read_text("utf8"), re.MULTILINE)
    assert sorted(shown) == sorted(normlift_ns.__all__)


@pytest.mark.slow
def test_the_site_builds_with_examples_as_code_and_loads_nothing_from_elsewhere(tmp_path):
    words = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(tmp_path)]
    environment = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    built = subprocess.run(words, check=False, capture_output=True, text=True, cwd=ROOT, env=environment)
    assert built.returncode == 0, built.stdout + built.stderr
    for made in tmp_path.glob("*.html"):
        loaded = re.findall(r'<(?:script|img|link)[^>]+(?:src|href)="(https?:[^"]+)"', made.read_text("utf8"))
        assert [url for url in loaded if "github.com/normlift-ns" not in url] == [], made.name
    text = (tmp_path / "api.html").read_text("utf8")
    assert "&gt;&gt;&gt; " not in re.sub(r"<pre.*?</pre>", "", text, flags=re.DOTALL)
    assert text.count("&gt;&gt;&gt;") > 50 and "nearest_neighbors" in text


OPENS_A_RUN = re.compile(r"\b(open_run|open_scene|lift_run)\(config\b")


@pytest.mark.parametrize("opens_a_run", [False, True])
def test_examples(opens_a_run, request, tmp_path, monkeypatch):
    names = {}
    if opens_a_run:  # examples read the run `config` and write to `folder`
        names = {"config": request.getfixturevalue("lifted"), "folder": tmp_path}
        from nerfstudio.utils.rich_utils import CONSOLE  # noqa: PLC0415

        monkeypatch.setattr(CONSOLE, "quiet", True)
    texts = {path: path.read_text("utf8") for path in sorted(PACKAGE.rglob("*.py"))}
    printed: list[str] = []
    for path, text in texts.items():
        if ">>>" not in text or bool(OPENS_A_RUN.search(text)) != opens_a_run:
            continue
        name = ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts).removesuffix(".__init__")
        found = [test for test in doctest.DocTestFinder().find(import_module(name)) if test.examples]
        assert found, f"{path} has no examples"
        for test in found:
            test.globs |= names
            doctest.DocTestRunner(verbose=False).run(test, out=printed.append)
    assert printed == [], "".join(printed)
