"""Runs that version 0.1 wrote open in stock nerfstudio and in all commands of ours, with the answers that it gave.

version_0_1/ was written by version 0.1: a small demo room in scene/, a run of ns-normlift (runs/scene/normlift/lifted)
and one of ns-train normlift (trained), and what ns-normlift-query answered.
"""

import json
import shutil
from pathlib import Path

import pytest

import normlift_ns as nl
from normlift_ns.cli import evaluate, export, lift, query
from tests.cli.conftest import run_entry
from tests.golden.summary import differences, single_colors, without_news
from tests.nerfstudio_plugin.stock_run import relocate_config

pytestmark = pytest.mark.slow
QUERIES = {"lifted": ("red", "sky blue", "--threshold", 0.4), "trained": ("red", "--threshold", 0.5)}
STORED = {"lifted": ("red", "yellow"), "trained": ("red",)}


@pytest.fixture(params=["lifted", "trained"])
def config(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    shutil.copytree(Path(__file__).with_name("version_0_1"), tmp_path / "old")
    return tmp_path / "old" / "runs" / "scene" / "normlift" / request.param / "config.yml"


@pytest.mark.usefixtures("nerfstudio")
def test_our_commands_answer_as_before(config: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    name, answers = config.parent.name, tmp_path / "answers.json"
    texts = single_colors(tmp_path / "texts.npz")
    flags = ("--load-config", config, "--text-embeddings", texts, "--output-json", answers, "--text", *QUERIES[name])
    assert run_entry(monkeypatch, query.entrypoint, *flags) == 0
    before = json.loads((tmp_path / "old" / f"answers_{name}.json").read_text())
    assert differences(without_news(json.loads(answers.read_text())), before, 1e-5) == []

    assert run_entry(monkeypatch, export.entrypoint, "--load-config", config, "--output-dir", tmp_path / "ply") == 0
    table = json.loads((tmp_path / "ply" / "splat_objects.json").read_text())
    assert tuple(found["text"] for found in table["queries"]) == STORED[name]

    masks = ("--protocol", "masks", "--labels", tmp_path / "old" / "scene" / "instance", "--min-weight", 0.01)
    scored = ("--load-config", config, "--output-path", tmp_path / "eval.json", *masks)
    assert run_entry(monkeypatch, evaluate.entrypoint, *scored) == 0
    assert json.loads((tmp_path / "eval.json").read_text())["method_name"] == "normlift"

    again = ("--encoder", "colour", "--region-count", 16, "--vote-k", 6, "--timestamp", "again")
    assert run_entry(monkeypatch, lift.entrypoint, "--load-config", config, *again) == 0
    lifted = nl.open_run(config.parents[1] / "again" / "config.yml")
    assert lifted.ask("red").texts == ("red",)


@pytest.mark.usefixtures("nerfstudio")
def test_stock_nerfstudio_loads_them(config: Path) -> None:
    from nerfstudio.utils.eval_utils import eval_setup  # noqa: PLC0415

    pipeline = eval_setup(config, update_config_callback=lambda loaded: relocate_config(loaded, config))[1]
    run = nl.open_run(config)
    stored = run.ask_stored()
    assert stored is not None
    assert stored.texts == STORED[config.parent.name]
    assert pipeline.model.field is not None
    assert pipeline.model.normlift.answer.selected.cpu().equal(stored.selected)
    camera = pipeline.datamanager.train_dataset.cameras[:1]
    assert {"overlay", "relevancy_0"} <= set(pipeline.model.get_outputs_for_camera(camera))
