"""Examples in docstrings."""

from __future__ import annotations

import doctest
import re
from importlib import import_module
from pathlib import Path

import pytest

import normlift_ns

ROOT = Path(normlift_ns.__file__).parent
FILES = sorted(path for path in ROOT.rglob("*.py") if ">>>" in path.read_text("utf8"))
OPENS_A_RUN = re.compile(r"\b(open_run|open_scene|lift_run)\(config\b")


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_examples(path, request, tmp_path):
    module = import_module(".".join(path.relative_to(ROOT.parent).with_suffix("").parts).removesuffix(".__init__"))
    names = {}
    if OPENS_A_RUN.search(path.read_text("utf8")):  # examples read the run `config` and write to `folder`
        names = {"config": request.getfixturevalue("lifted"), "folder": tmp_path}
        from nerfstudio.utils.rich_utils import CONSOLE  # noqa: PLC0415

        request.getfixturevalue("monkeypatch").setattr(CONSOLE, "quiet", True)
    found = [test for test in doctest.DocTestFinder().find(module) if test.examples]
    assert found
    for test in found:
        printed: list[str] = []
        test.globs |= names
        failed, _ = doctest.DocTestRunner(verbose=False).run(test, out=printed.append)
        assert failed == 0, "".join(printed)
