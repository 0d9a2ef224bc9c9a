"""What the README shows works."""

import re
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from normlift_ns.core.refine import RefineConfig
from normlift_ns.options import LiftOptions, SourceOptions, SplatOptions
from normlift_ns.scripts import lift
from normlift_ns.scripts.batch import NormLiftBatch
from normlift_ns.scripts.query import NormLiftQuery

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text()


@pytest.mark.slow
def test_the_python_script_runs_on_the_demo(tmp_path, monkeypatch, capsys):
    from normlift_ns.scripts.demo import Demo  # noqa: PLC0415 (nerfstudio takes 20 s)

    monkeypatch.chdir(tmp_path)
    means = Demo().main()
    print(means)
    assert means["before refinement"] >= 0.85
    assert means["after refinement"] >= 0.9
    assert (tmp_path / "demo" / "pictures" / "overview.png").stat().st_size > 10_000
    script, own = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)
    capsys.readouterr()
    names: dict[str, Any] = {}
    exec(compile(script, "README.md", "exec"), names)
    shown = capsys.readouterr().out
    assert "sky blue" in shown
    assert (tmp_path / "demo" / "red.ply").exists()
    assert names["picture"].shape == (240, 320, 3)
    (trained,) = Path("demo/outputs/room/splatfacto").glob("*/config.yml")
    names |= {"labels": np.zeros((240, 320), int), "vectors": np.eye(1, 8), "vector": torch.eye(8)[0]}
    exec(compile(own.replace("outputs/…/splatfacto/…/config.yml", str(trained)), "README.md", "exec"), names)
    assert names["run"].ask("fox")["fox"].fraction > 0.9


FRONT_ENDS = (ROOT / "docs" / "front_ends.md").read_text()


COMMANDS = "".join(re.findall(r"^    ns-normlift(?:-query)? (?:.*\\\n)*.*\n", README, flags=re.MULTILINE))
TABLE = README.split("## Options of ns-normlift")[1].split("## Limits")[0]


SPLATS = "".join(re.findall(r"`ns-normlift [^`]*`", (ROOT / "docs" / "splats.md").read_text()))


SCALE = (ROOT / "docs" / "scale.md").read_text()


@pytest.mark.parametrize("text", [TABLE, COMMANDS, FRONT_ENDS, SPLATS, SCALE])
def test_options_that_are_shown_exist(text):
    named = {flag.removeprefix("--").replace("-", "_") for flag in re.findall(r"--[a-z][a-z0-9-]*", text)} - {"help"}
    commands = (lift.NormLift, LiftOptions, RefineConfig, SourceOptions, SplatOptions, NormLiftQuery, NormLiftBatch)
    assert named <= {f.name for cls in commands for f in fields(cls)}
