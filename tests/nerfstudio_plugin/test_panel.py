"""The panel inside nerfstudio's own Viewer, its hooks called as the viewer calls them."""

from __future__ import annotations

import re
import socket
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from threading import Event, Lock, Thread
from typing import Any

import numpy as np
import pytest
import torch
from nerfstudio.configs.base_config import ViewerConfig
from nerfstudio.configs.method_configs import all_methods
from nerfstudio.utils.eval_utils import eval_setup
from nerfstudio.viewer.utils import parse_object
from nerfstudio.viewer.viewer import Viewer
from nerfstudio.viewer.viewer_elements import ViewerClick, ViewerElement
from plyfile import PlyData

from normlift_ns.asking import answer
from normlift_ns.front_door import open_scene as load_scene
from normlift_ns.method_configs.normlift import normlift_method
from normlift_ns.nerfstudio_plugin.config import rerooted
from normlift_ns.options import SourceOptions
from normlift_ns.question import Question
from normlift_ns.runs.question import load_question
from normlift_ns.text_encoders import ENCODER_KEYS
from normlift_ns.viewer.session import MOST_PROMPTS
from tests.nerfstudio_plugin.conftest import lifted_field, write
from tests.nerfstudio_plugin.stock_run import StockRun

QUESTION = Question(("left",), torch.eye(8)[:1])
NAMES = {"left": 0, "right": 1, "up": 2}


class Words:
    """Encodes left and right as the two directions of `lifted_field`, up as one that nothing has."""

    def __init__(self) -> None:
        self.asked: list[list[str]] = []

    def rows(self, prompts: Any) -> torch.Tensor:
        self.asked.append(list(prompts))
        unknown = [p for p in prompts if p.split()[0] not in NAMES]
        if unknown:
            raise ValueError(f"I do not know {unknown[0]!r}")
        return torch.eye(8)[[NAMES[p.split()[0]] for p in prompts]]


@pytest.fixture(scope="module")
def lifted(stock: StockRun, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """config.yml of a lifted run with one query."""
    run = load_scene(stock.config)
    encoder = {key: getattr(SourceOptions(encoder="colour"), key) for key in ENCODER_KEYS}
    field = lifted_field(run)
    field = replace(field, manifest={**field.manifest, "encoder": encoder})
    return write(run, field, question=QUESTION, output_dir=tmp_path_factory.mktemp("panel")) / "config.yml"


@pytest.fixture(scope="module")
def opened(lifted: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Any, Viewer]]:
    """The pipeline of the run, and the viewer that shows it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(all_methods, "normlift", normlift_method.config)
        pipeline = eval_setup(lifted, update_config_callback=lambda loaded: rerooted(loaded, lifted))[1]
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    config, folder = ViewerConfig(websocket_host="127.0.0.1", websocket_port=port), tmp_path_factory.mktemp("viewer")
    viewer = Viewer(config, folder / "log" / "viewer.log", folder, pipeline, train_lock=Lock())
    yield pipeline, viewer
    viewer.viser_server.stop()


@pytest.fixture
def pipeline(opened: tuple[Any, Viewer], tmp_path: Path) -> Any:
    """The pipeline as loaded; what the panel writes goes to a folder of the test."""
    model = opened[0].model
    model.config.semantics = tmp_path / "run" / "normlift"
    model.config.semantics.mkdir(parents=True)
    model.normlift._encoder.clear()
    model.normlift.show_4_part.value = "everything"
    model.attach(model.field, QUESTION)
    return opened[0]


@pytest.fixture
def panel(pipeline: Any) -> Any:
    panel = pipeline.model.normlift
    panel._encoder.append(Words())
    return panel


def ask(panel: Any, prompts: str, negatives: str = "") -> None:
    panel.ask_1_prompts.value, panel.ask_2_negatives.value = prompts, negatives
    press(panel.ask_5_query)


def press(button: Any) -> None:
    """What viser does when the button is pressed."""
    for action in button.gui_handle._impl.update_cb:
        action(None)


def outputs(pipeline: Any, index: int = 0) -> dict[str, torch.Tensor]:
    return pipeline.model.get_outputs_for_camera(pipeline.datamanager.train_dataset.cameras[index : index + 1])


def chosen(pipeline: Any) -> torch.Tensor:
    """The Gaussians of the selection that is rendered."""
    display = pipeline.model._display
    return display.values[:, display.num_prompts + 1] > 0


def test_the_viewer_finds_the_elements_in_order(panel: Any, pipeline: Any) -> None:
    found = [(path, element) for path, element in parse_object(pipeline, ViewerElement, "Custom Elements")]
    assert {path.rsplit("/", 1)[0] for path, _ in found} == {"Custom Elements/model/normlift"}
    assert [element.name for _, element in found] == [
        "Prompts", "Negatives", "Relevancy", "Refined", "Query", "Clear", "Click: more like this", "",
        "Prompt shown", "Threshold", "Minimum reliability", "Draw", "Overlay colours", "Export selection",
        "Save queries in run",
    ]  # fmt: skip
    assert not any(element.disabled or getattr(element.gui_handle, "disabled", False) for _, element in found)


def test_the_stored_question_is_shown_without_an_encoder(pipeline: Any) -> None:
    panel = pipeline.model.normlift
    assert panel._encoder == []
    assert panel.ask_1_prompts.value == "left"
    assert panel.show_2_threshold.value == 0.5
    expected = answer(pipeline.model.field, pipeline.model.means, QUESTION).selected[:, 0]
    assert torch.equal(chosen(pipeline), expected)
    assert f"**{int(expected.sum())}** of 60 Gaussians selected" in panel.ask_8_status.content
    assert not any("normlift" in name for name in pipeline.state_dict())


def test_a_query_replaces_what_is_shown(panel: Any, pipeline: Any) -> None:
    ask(panel, " left ; right;; ")
    assert panel.answer.texts == ("left", "right")
    assert list(outputs(pipeline))[4:7] == ["relevancy_0", "relevancy_1", "reliability"]
    assert panel.show_1_prompt.options == ["all prompts", "0: left", "1: right"]
    both = answer(pipeline.model.field, pipeline.model.means, Question(("a", "b"), torch.eye(8)[:2])).selected
    assert torch.equal(chosen(pipeline), both.any(dim=1))
    panel.show_1_prompt.value = "1: right"
    panel.show_1_prompt.cb_hook(panel.show_1_prompt)
    assert torch.equal(chosen(pipeline), both[:, 1])
    assert panel.answer.question.rule == "cosine"
    ask(panel, "left", "right")
    assert (panel.answer.question.rule, panel.answer.texts) == ("lerf", ("left",))
    assert panel._encoder[0].asked[-2:] == [["left"], ["right"]]
    assert panel.show_1_prompt.value == "all prompts"


def test_threshold_and_reliability_select_anew(panel: Any, pipeline: Any) -> None:
    counts = []
    for threshold in (-0.2, 0.5, 0.8, 0.99):
        panel.show_2_threshold.value = threshold
        panel.show_2_threshold.cb_hook(panel.show_2_threshold)
        counts.append(int(chosen(pipeline).sum()))
        assert panel.answer.question.threshold == threshold
        assert f"**{counts[-1]}** of 60" in panel.ask_8_status.content
    assert counts == sorted(counts, reverse=True)
    assert counts[0] > counts[-1]
    panel.show_2_threshold.value = 0.5
    panel.show_3_reliability.value = float(pipeline.model.field.scalars.reliability.median())
    panel.show_3_reliability.cb_hook(panel.show_3_reliability)
    assert (pipeline.model.field.scalars.reliability[chosen(pipeline)] >= panel.show_3_reliability.value).all()
    assert 0 < int(chosen(pipeline).sum()) < counts[1]
    ask(panel, "right")
    assert panel.answer.question.min_reliability == panel.show_3_reliability.value


def test_the_threshold_stays_for_another_query_of_the_same_form(panel: Any) -> None:
    panel.show_2_threshold.value = 0.7
    ask(panel, "right")
    assert panel.answer.question.threshold == 0.7
    panel.ask_3_rule.value = "margin"
    ask(panel, "right", "left")
    assert panel.answer.question.threshold == panel.show_2_threshold.value == 0.02


def test_refined_and_unrefined(panel: Any, pipeline: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    field = pipeline.model.field
    moved = field.source.clone()
    moved[:30] = moved[30:]
    monkeypatch.setattr(pipeline.model, "_field", replace(field, source=moved))
    ask(panel, "left; right")
    panel.show_1_prompt.value = "0: left"
    refined = chosen(pipeline)
    panel.ask_4_refined.value = False
    panel.ask_4_refined.cb_hook(panel.ask_4_refined)
    assert panel.show_1_prompt.value == "0: left"
    assert not torch.equal(chosen(pipeline), refined)
    assert torch.equal(panel.answer.relevancy, field.relevancy(torch.eye(8)[:2], refined=False))


@pytest.mark.parametrize(
    ("prompts", "message"),
    [
        ("", "Type what to look for"),
        (" ; ;", "Type what to look for"),
        ("banana", "I do not know"),
        ("x" * 10_000, "I do not know"),
        (";".join(["left"] * (MOST_PROMPTS + 1)), "65 prompts; ask for 64 at most"),
    ],
)
def test_what_cannot_be_asked_leaves_nothing_stale(panel: Any, pipeline: Any, prompts: str, message: str) -> None:
    assert chosen(pipeline).any()
    ask(panel, prompts)
    shown = panel.ask_8_status.content
    assert message.replace(";", "&#59;").replace("'", "&#39;") in shown
    assert len(shown) < 3000
    assert panel.answer is None
    assert not chosen(pipeline).any()
    assert "relevancy_0" not in outputs(pipeline)
    ask(panel, "left")
    assert chosen(pipeline).any()


def test_a_form_without_its_negatives_says_so(panel: Any, pipeline: Any) -> None:
    panel.ask_3_rule.value = "lerf"
    ask(panel, "left", "")
    assert "compares with negative prompts" in panel.ask_8_status.content
    assert panel.answer is None


def test_clear(panel: Any, pipeline: Any) -> None:
    panel.ask_6_clear.cb_hook(panel.ask_6_clear)
    assert panel.ask_1_prompts.value == "left"
    assert panel.answer is None
    assert not chosen(pipeline).any()
    assert panel.ask_8_status.content == "No query yet."


def test_fifty_prompts_and_markup(panel: Any, pipeline: Any) -> None:
    ask(panel, "; ".join(["left", "right"] * 25))
    assert sum(name.startswith("relevancy_") for name in outputs(pipeline)) == 50
    ask(panel, "left {alert(1)} <img src=x onerror=alert(1)> | `x` ![](http://a)\n# b; right")
    (row,) = [line for line in panel.ask_8_status.content.splitlines() if "alert" in line]
    text = row.split(" | ")[1]
    assert not set(re.sub(r"&#\d+;", "", text)) & set("{}<>|`![]()#\n=&")
    assert row.count("|") == 5


class Slow(Words):
    """Reads texts once it is let."""

    def __init__(self) -> None:
        super().__init__()
        self.reading, self.go_on = Event(), Event()

    def rows(self, prompts: Any) -> torch.Tensor:
        self.reading.set()
        assert self.go_on.wait(20)
        return super().rows(prompts)


@pytest.fixture
def slow(pipeline: Any, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[Slow, list[str]]]:
    """An encoder that takes its time, loaded at the first query, and the devices it was loaded on."""
    encoder, loaded = Slow(), []
    monkeypatch.setattr(
        "normlift_ns.nerfstudio_plugin.panel.encoder_of", lambda _, device, __: loaded.append(device) or encoder
    )
    yield encoder, loaded
    encoder.go_on.set()


def test_the_picture_stays_live_while_the_encoder_loads(
    pipeline: Any, opened: tuple[Any, Viewer], slow: tuple[Slow, list[str]]
) -> None:
    panel, lock, (encoder, loaded) = pipeline.model.normlift, opened[1].train_lock, slow
    before = chosen(pipeline)
    panel.ask_1_prompts.value = "right"
    asking = Thread(target=press, args=[panel.ask_5_query])
    asking.start()
    assert encoder.reading.wait(20)
    assert lock is not None
    assert lock.acquire(timeout=1)  # as the viewer does to render
    assert torch.equal(chosen(pipeline), before)
    assert "relevancy_0" in outputs(pipeline)
    lock.release()
    assert "Reading the prompts" in panel.ask_8_status.content
    panel.show_2_threshold.value = 0.6  # the panel can be used, and still says what it waits for
    panel.show_2_threshold.cb_hook(panel.show_2_threshold)
    assert panel.answer.texts == ("left",)
    assert "Reading the prompts" in panel.ask_8_status.content
    lock.acquire()
    encoder.go_on.set()
    time.sleep(0.2)
    assert panel.answer.texts == ("left",)  # the answer waits for the picture
    lock.release()
    asking.join(20)
    assert panel.answer.texts == ("right",)
    assert panel.answer.question.threshold == 0.6
    assert not torch.equal(chosen(pipeline), before)
    assert "Reading the prompts" not in panel.ask_8_status.content
    assert loaded == [str(pipeline.model.device)]


def test_an_answer_that_comes_too_late_is_not_shown(pipeline: Any, slow: tuple[Slow, list[str]]) -> None:
    panel, (encoder, loaded) = pipeline.model.normlift, slow
    threads = []
    for prompts in ("right", "banana", "left; up"):
        panel.ask_1_prompts.value = prompts
        threads.append(Thread(target=press, args=[panel.ask_5_query]))
        threads[-1].start()
        assert encoder.reading.wait(20)
        time.sleep(0.1)
    encoder.go_on.set()
    for thread in threads:
        thread.join(20)
    assert panel.answer.texts == ("left", "up")
    assert "banana" not in panel.ask_8_status.content
    assert len(loaded) == 1
    encoder.go_on.clear()
    encoder.reading.clear()
    panel.ask_1_prompts.value = "right"
    asking = Thread(target=press, args=[panel.ask_5_query])
    asking.start()
    assert encoder.reading.wait(20)
    panel.ask_6_clear.cb_hook(panel.ask_6_clear)
    encoder.go_on.set()
    asking.join(20)
    assert panel.answer is None
    assert panel.ask_8_status.content == "No query yet."


@pytest.mark.parametrize("part", ["without the selection", "the selection alone"])
def test_hide_and_isolate(panel: Any, pipeline: Any, part: str) -> None:
    before = outputs(pipeline)["accumulation"]
    panel.show_4_part.value = part
    panel.show_4_part.cb_hook(panel.show_4_part)
    assert torch.equal(pipeline.model._display.drawn, chosen(pipeline) == (part == "the selection alone"))
    assert float(outputs(pipeline)["accumulation"].sum()) < float(before.sum())
    ask(panel, "up")  # selects nothing
    assert (pipeline.model._display.drawn.sum() == 0) == (part == "the selection alone")
    assert all(value.isfinite().all() for value in outputs(pipeline).values())


def test_a_click_selects_what_is_alike(panel: Any, pipeline: Any, opened: tuple[Any, Viewer]) -> None:
    viewer = opened[1]
    panel.ask_7_click.cb_hook(panel.ask_7_click)
    assert "Click on something" in panel.ask_8_status.content
    assert viewer.viser_server.scene._scene_pointer_cb is not None
    pose = pipeline.datamanager.train_dataset.cameras.camera_to_worlds[0]
    origin, forward = pose[:, 3], -pose[:, 2]
    field = pipeline.model.field
    met = pipeline.model.in_sight(origin, forward).where(field.valid(), 0.0).argmax()
    panel._clicked(ViewerClick(tuple(origin.tolist()), tuple(forward.tolist()), (0.5, 0.5)))
    assert viewer.viser_server.scene._scene_pointer_cb is None
    assert f"Clicked Gaussian {int(met)}," in panel.ask_8_status.content.replace("&#44;", ",")
    similar = field.directions() @ field.directions(met[None])[0]
    assert torch.equal(chosen(pipeline), (similar > 0.9) & field.valid())
    assert chosen(pipeline)[met]
    panel.ask_like(origin, -forward)
    assert "nothing with semantics" in panel.ask_8_status.content
    assert chosen(pipeline)[met]
    ask(panel, "left")
    assert panel.answer.question.threshold == 0.5  # not that of the click


def test_export_writes_the_selection_beside_the_field(panel: Any, pipeline: Any) -> None:
    folder = pipeline.model.config.semantics.parent / "exports"
    ask(panel, "left /../../x; right")
    for name in ("left________x_right", "left________x_right_2"):
        panel.write_1_export.cb_hook(panel.write_1_export)
        vertices = PlyData.read(folder / f"{name}.ply")["vertex"]
        rows = np.load(folder / f"{name}_rows.npy")
        assert np.array_equal(rows, chosen(pipeline).nonzero().squeeze(1).cpu())
        means = np.stack([vertices[axis] for axis in "xyz"], axis=1)
        assert np.array_equal(means, pipeline.model.means.detach().cpu().numpy()[rows])
    assert len(list(folder.iterdir())) == 4
    ask(panel, "up")
    panel.write_1_export.cb_hook(panel.write_1_export)
    assert "Nothing is selected" in panel.ask_8_status.content
    assert len(list(folder.iterdir())) == 4


def test_save_stores_the_question(panel: Any, pipeline: Any) -> None:
    folder = pipeline.model.config.semantics
    ask(panel, "left; right", "up")
    panel.show_2_threshold.value = 0.625
    panel.show_2_threshold.cb_hook(panel.show_2_threshold)
    panel.write_2_save.cb_hook(panel.write_2_save)
    stored = load_question(folder)
    assert stored is not None
    assert (stored.texts, stored.negatives, stored.rule) == (("left", "right"), ("up",), "lerf")
    assert stored.threshold == 0.625
    assert torch.equal(answer(pipeline.model.field, pipeline.model.means, stored).selected, panel.answer.selected)
    panel.ask_6_clear.cb_hook(panel.ask_6_clear)
    panel.write_2_save.cb_hook(panel.write_2_save)
    assert "No query yet" in panel.ask_8_status.content


def test_elements_wait_for_a_field(stock: StockRun, registered: None, pipeline: Any) -> None:
    """As in a training: the viewer starts before there is anything to ask."""
    from normlift_ns.nerfstudio_plugin.model import NormLiftModel, NormLiftModelConfig  # noqa: PLC0415

    model = NormLiftModel(NormLiftModelConfig(num_random=60), scene_box=None, num_train_data=3)  # type: ignore[arg-type]
    panel = model.normlift
    assert all(e.disabled for e in vars(panel).values() if isinstance(e, ViewerElement) and e.name)
    assert "at the end of the training" in panel.ask_8_status.content
    model.attach(pipeline.model.field)
    assert not any(e.disabled for e in vars(panel).values() if isinstance(e, ViewerElement))
    assert panel.ask_8_status.content == "No query yet."


def test_an_answer_to_a_prompt_is_fast(panel: Any, pipeline: Any) -> None:
    ask(panel, "left")
    start = time.perf_counter()
    ask(panel, "right")
    assert time.perf_counter() - start < 0.1
