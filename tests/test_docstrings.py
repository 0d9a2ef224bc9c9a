"""Examples in docstrings."""

from __future__ import annotations

import doctest
import re
from importlib import import_module
from pathlib import Path

import pytest

import normlift_ns

ROOT = Path(normlift_ns.__file__).parent
OPENS_A_RUN = re.compile(r"\b(open_run|open_scene|lift_run)\(config\b")


@pytest.mark.parametrize("opens_a_run", [False, True])
def test_examples(opens_a_run, request, tmp_path, monkeypatch):
    names = {}
    if opens_a_run:  # examples read the run `config` and write to `folder`
        names = {"config": request.getfixturevalue("lifted"), "folder": tmp_path}
        from nerfstudio.utils.rich_utils import CONSOLE  # noqa: PLC0415

        monkeypatch.setattr(CONSOLE, "quiet", True)
    texts = {path: path.read_text("utf8") for path in sorted(ROOT.rglob("*.py"))}
    printed: list[str] = []
    for path in (
        path for path in texts if ">>>" in texts[path] and bool(OPENS_A_RUN.search(texts[path])) == opens_a_run
    ):
        module = import_module(".".join(path.relative_to(ROOT.parent).with_suffix("").parts).removesuffix(".__init__"))
        found = [test for test in doctest.DocTestFinder().find(module) if test.examples]
        assert found, f"{path} has no examples"
        for test in found:
            test.globs |= names
            doctest.DocTestRunner(verbose=False).run(test, out=printed.append)
    assert printed == [], "".join(printed)
