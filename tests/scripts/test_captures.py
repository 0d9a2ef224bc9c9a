"""The commands on the trained captures: full views, from another directory, numbers that a wrong lift would miss."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from benchmarks.captures import SHARED
from normlift_ns import Scene, open_run, render
from normlift_ns.asking import pixel_relevancy
from normlift_ns.scripts import lift, query
from tests.captures import needs_shared
from tests.scripts.conftest import run_entry

pytestmark = [pytest.mark.slow, needs_shared]


def maps(config: Path, texts: list[str], split: str, count: int) -> tuple[Scene, torch.Tensor]:
    """Relevancy of the texts in the first views of a split, [V, H, W, Q]."""
    run = open_run(config)
    scene, relevancy = run.scene, run.ask(*texts).relevancy
    views = getattr(scene, split).cameras[:count]
    return scene, torch.stack(
        [pixel_relevancy(*render(scene.gaussians, c, relevancy, rasterize_mode=scene.rasterize_mode)) for c in views]
    )


def test_fox_is_orange_and_the_curtain_crimson(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    source = SHARED / "captures" / "outputs" / "fox" / "splatfacto" / "run" / "config.yml"
    relative = Path(os.path.relpath(source, tmp_path))
    flags = ("--encoder", "colour", "--output-dir", "lifted", "--timestamp", "t")
    assert run_entry(monkeypatch, lift.entrypoint, "--load-config", relative, *flags) == 0
    config = tmp_path / "lifted" / "fox" / "normlift" / "t" / "config.yml"
    asked = ("--load-config", config, "--text", "orange", "crimson", "--json", "a.json")
    assert run_entry(monkeypatch, query.entrypoint, *asked) == 0
    assert "reliability" in capsys.readouterr().out
    orange, crimson = json.loads((tmp_path / "a.json").read_text())["queries"]
    assert orange["peak"] > 0.5 and crimson["peak"] > 0.6
    _, values = maps(config, ["orange", "crimson"], "train", 1)
    boxes = ((180, 330, 250, 330), (750, 930, 330, 480), (100, 190, 470, 535))
    head, wallpaper, curtain = (values[0, a:b, c:d].mean(dim=(0, 1)).tolist() for a, b, c, d in boxes)
    assert head[0] > 3 * wallpaper[0] and head[0] > 0.2
    assert curtain[1] > 3 * max(head[1], wallpaper[1])


def test_mug_and_bottle_stand_out_from_the_table(tmp_path, monkeypatch):
    captures = SHARED / "captures"
    source = captures / "outputs" / "tabletop" / "splatfacto" / "run" / "config.yml"
    regions = ("--regions", "files", "--regions-dir", captures / "tabletop" / "instance")
    flags = ("--encoder", "colour", *regions, "--output-dir", tmp_path, "--timestamp", "t")
    monkeypatch.chdir(captures)
    assert run_entry(monkeypatch, lift.entrypoint, "--load-config", source.relative_to(captures), *flags) == 0
    run, values = maps(tmp_path / "tabletop" / "normlift" / "t" / "config.yml", ["dusty red", "black"], "held_out", 4)
    masks = [captures / "tabletop" / "instance" / f"{Path(name).stem}.png" for name in run.held_out.names]
    truth = torch.from_numpy(np.stack([np.array(Image.open(mask)).astype(int) for mask in masks]))
    assert len(truth) == 4
    table = truth == 1
    for q, label, threshold in ((0, 11, 0.25), (1, 12, 0.8)):
        thing = truth == label
        found = (values[..., q] > threshold) & (thing | table)
        assert float((found & thing).sum() / (found | thing).sum()) > 0.85, label
