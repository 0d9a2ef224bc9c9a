"""The recipe for Ray of docs/scale.md, with processors in place of GPUs and the stand-in for ns-normlift."""

from __future__ import annotations

import os
import re
import sys
from pathlib import Path

import pytest

from tests.scripts.test_batch import STAND_IN, Batch

ROOT = Path(__file__).parents[2]
COMMAND = f"""#!{sys.executable}
from normlift_ns.scripts.captures import work
from normlift_ns.scripts.start import batch
work.work.__kwdefaults__["program"] = {STAND_IN!r}
batch()
"""


@pytest.mark.extra
def test_the_recipe_for_ray(tmp_path, monkeypatch, capsys):
    ray = pytest.importorskip("ray", reason="ray is not installed; it is no dependency: pip install ray")
    made = Batch(tmp_path, ["0.05"] * 12)
    (recipe,) = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "scale.md").read_text("utf8"), flags=re.DOTALL)
    for before, after in (("num_gpus", "num_cpus"), ('"GPU"', '"CPU"'), ("os.getcwd()", repr(str(tmp_path)))):
        assert recipe.count(before) == 1
        recipe = recipe.replace(before, after)
    command = tmp_path / "bin" / "ns-normlift-batch"
    command.parent.mkdir()
    command.write_text(COMMAND)
    command.chmod(0o755)
    monkeypatch.setenv("PATH", f"{command.parent}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]))
    monkeypatch.setenv("RAY_AUTH_MODE", "disabled")  # it would leave a token in the home folder
    try:
        exec(compile(recipe, "docs/scale.md", "exec"), {"__name__": "recipe"})
    finally:
        ray.shutdown()
    assert "0" in capsys.readouterr().out.splitlines()  # among what the workers say
    options = ("--regions", "sam")
    made.check_lifted_once(*options)
    assert set(made.states(*options)) == {"done"} and sum(made.begun().values()) == 12
