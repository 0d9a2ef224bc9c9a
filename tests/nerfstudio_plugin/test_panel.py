"""The panel inside nerfstudio's own Viewer, its widgets pressed as viser presses them."""

from __future__ import annotations

import html
import io
import re
import shutil
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from threading import Event, Lock, Thread
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from nerfstudio.configs.base_config import ViewerConfig
from nerfstudio.configs.method_configs import all_methods
from nerfstudio.utils.eval_utils import eval_setup
from nerfstudio.viewer.utils import parse_object
from nerfstudio.viewer.viewer import Viewer
from nerfstudio.viewer.viewer_elements import ViewerControl, ViewerElement
from plyfile import PlyData

import normlift_ns as nl
from normlift_ns.asking import answer
from normlift_ns.front_door import open_scene as load_scene
from normlift_ns.insight.floaters import find_floaters
from normlift_ns.method_configs.normlift import normlift_method
from normlift_ns.nerfstudio_plugin.config import rerooted
from normlift_ns.nerfstudio_plugin.insights import reasons_of
from normlift_ns.options import LiftOptions, SourceOptions
from normlift_ns.question import Question
from normlift_ns.runs.question import load_question
from normlift_ns.session import actions
from normlift_ns.session.found import found_objects
from normlift_ns.session.prompts import MOST_PROMPTS
from normlift_ns.session.space import Space
from normlift_ns.session.state import State
from normlift_ns.text_encoders import ENCODER_KEYS
from tests.nerfstudio_plugin.conftest import lifted_field, write
from tests.nerfstudio_plugin.stock_run import StockRun

QUESTION = Question(("left",), torch.eye(8)[:1])
NAMES = {"left": 0, "right": 1, "up": 2}


class Browser:
    """A browser as viser hands it to a callback."""

    def __init__(self, number: int = 0) -> None:
        self.client_id, self.files, self.scene = number, {}, self
        self._scene_pointer_cb: Any = None
        self.camera = SimpleNamespace(
            position=np.zeros(3), look_at=np.ones(3), up_direction=np.array([0.0, 0, 1]), fov=1.0
        )

    def atomic(self) -> Any:
        return nullcontext()

    def on_pointer_event(self, kind: str) -> Any:
        assert kind == "click"

        def keep(action: Any) -> None:
            self._scene_pointer_cb = action

        return keep

    def remove_pointer_callback(self) -> None:
        self._scene_pointer_cb = None

    def send_file_download(self, name: str, content: bytes) -> None:
        self.files[name] = content


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
    model.normlift._asker.encoder.clear()
    opened[1].control_panel._output_render.set_options(["rgb", "overlay"])
    opened[1].control_panel._output_render.value = "rgb"
    for name, value in (("rule", "auto"), ("refined", True), ("reliability", 0.0)):
        getattr(model.normlift._widgets, name).value = value
    model.attach(model.field, QUESTION)
    return opened[0]


@pytest.fixture
def panel(pipeline: Any) -> Any:
    panel = pipeline.model.normlift
    panel._asker.encoder.append(Words())
    return panel


def ask(panel: Any, prompts: str, negatives: str = "") -> None:
    panel._widgets.prompts.value, panel._widgets.negatives.value = prompts, negatives
    press(panel._widgets.ask)


def press(button: Any, browser: Browser | None = None) -> None:
    """What viser does when the button is pressed."""
    for action in button._impl.update_cb:
        action(SimpleNamespace(client=browser or Browser(), target=button))


def said(panel: Any) -> str:
    return html.unescape(panel._widgets.status.content + "\n\n" + panel._widgets.found.content)


def outputs(pipeline: Any, index: int = 0) -> dict[str, torch.Tensor]:
    return pipeline.model.get_outputs_for_camera(pipeline.datamanager.train_dataset.cameras[index : index + 1])


def chosen(pipeline: Any) -> torch.Tensor:
    """The Gaussians of the selection that is rendered."""
    display = pipeline.model._display
    return display.values[:, display.num_prompts + 1] > 0


def test_the_panel_is_the_first_tab(opened: tuple[Any, Viewer], panel: Any) -> None:
    gui = opened[1].viser_server.gui
    group = next(held for held in gui._container_handle_from_id.values() if hasattr(held, "_parent"))._parent
    assert group._labels == ["Search", "Control", "Render", "Export"]
    labels = [held._impl.label for held in group._tabs[0]._children.values() if hasattr(held, "_impl")]
    assert labels[:3] == ["Prompts", "Ask", "Cancel"]
    assert parse_object(opened[0], ViewerElement, "x") == []  # nothing far down in another tab
    assert [element for _, element in parse_object(opened[0], ViewerControl, "x")] == [panel.control]


def test_the_stored_question_is_shown_without_an_encoder(pipeline: Any) -> None:
    panel = pipeline.model.normlift
    assert panel._asker.encoder == []
    assert panel._widgets.prompts.value == "left"
    assert panel._widgets.threshold.value == 0.5
    expected = answer(pipeline.model.field, pipeline.model.means, QUESTION).selected[:, 0]
    assert torch.equal(chosen(pipeline), expected)
    assert f"**{int(expected.sum())}** of 60 Gaussians selected" in said(panel)
    assert not any("normlift" in name for name in pipeline.state_dict())


def test_commas_and_semicolons_separate_and_the_first_answer_switches_to_the_overlay(
    panel: Any, pipeline: Any, opened: tuple[Any, Viewer]
) -> None:
    output = opened[1].control_panel._output_render
    assert output.value == "rgb"
    ask(panel, " left , right;; ")
    assert output.value == "overlay"
    assert panel.answer.texts == ("left", "right")
    assert list(outputs(pipeline))[4:7] == ["relevancy_left", "relevancy_right", "reliability"]
    both = answer(pipeline.model.field, pipeline.model.means, Question(("a", "b"), torch.eye(8)[:2])).selected
    assert torch.equal(chosen(pipeline), both.any(dim=1))
    panel._widgets.shown.value = "2: right"
    panel.act("shown", "2: right")
    assert torch.equal(chosen(pipeline), both[:, 1])
    output.set_options([*outputs(pipeline)])
    output.value = "relevancy_right"
    ask(panel, "left")
    assert output.value == "overlay"  # relevancy_right is no output any more
    output.value = "depth"
    ask(panel, "left", "right")
    assert output.value == "depth"  # what the person chose stays
    assert (panel.answer.question.rule, panel.answer.texts) == ("lerf", ("left",))


def test_an_unknown_word_marks_its_row_and_the_rest_is_answered(panel: Any, pipeline: Any) -> None:
    ask(panel, "left, banana; right")
    assert panel.answer.texts == ("left", "right")
    (row,) = [line for line in said(panel).splitlines() if "banana" in line]
    assert row.startswith("| ⚠ |")
    assert "I do not know" in row
    assert panel._widgets.prompts.value == "left, banana; right"


@pytest.mark.parametrize(
    ("prompts", "message"),
    [
        ("", "Type what to look for"),
        (" , ;", "Type what to look for"),
        ("banana", "I do not know"),
        ("x" * 10_000, "I do not know"),
        (";".join(f"left {i}" for i in range(MOST_PROMPTS + 1)), "65 prompts; ask for 64 at most"),
    ],
)
def test_what_cannot_be_asked_says_why_and_keeps_the_answer_before(panel, pipeline, prompts, message) -> None:
    before = chosen(pipeline)
    ask(panel, prompts)
    assert message in said(panel)
    assert len(said(panel)) < 3000
    assert panel._widgets.prompts.value == prompts
    assert torch.equal(chosen(pipeline), before)
    assert not panel._widgets.ask.disabled
    ask(panel, "right")
    assert message not in said(panel)


def test_threshold_reliability_and_undo(panel: Any, pipeline: Any) -> None:
    counts = []
    for threshold in (-0.2, 0.5, 0.8, 0.99):
        panel.act("Threshold", threshold)
        counts.append(int(chosen(pipeline).sum()))
        assert panel.answer.question.threshold == threshold
        assert f"**{counts[-1]}** of 60" in said(panel)
    assert counts == sorted(counts, reverse=True)
    assert counts[0] > counts[-1]
    panel.act("Undo")  # the drag of a slider is one step
    assert panel._widgets.threshold.value == 0.5
    panel.act("Redo")
    assert panel._widgets.threshold.value == 0.99
    panel.act("Threshold", 0.5)
    least = float(pipeline.model.field.scalars.reliability.median())
    panel.act("Minimum reliability", least)
    assert (pipeline.model.field.scalars.reliability[chosen(pipeline)] >= least).all()
    ask(panel, "right")
    assert panel.answer.question.min_reliability == pytest.approx(least)


def test_the_threshold_stays_for_another_query_of_the_same_rule(panel: Any) -> None:
    panel.act("Threshold", 0.7)
    ask(panel, "right")
    assert panel.answer.question.threshold == 0.7
    panel._widgets.rule.value = "margin"
    ask(panel, "right", "left")
    assert panel.answer.question.threshold == pytest.approx(panel._widgets.threshold.value)
    assert panel.answer.question.threshold != 0.7


def test_poor_evidence_is_said_and_can_be_left_out(panel: Any, pipeline: Any, monkeypatch: Any) -> None:
    field = pipeline.model.field
    reliability = torch.where(torch.arange(60) % 3 == 0, 0.9, 0.5).to(pipeline.model.device)
    poor = replace(field, scalars=replace(field.scalars, reliability=reliability))
    monkeypatch.setattr(pipeline.model, "_field", field)
    pipeline.model.attach(poor, QUESTION)
    share = float((reliability[chosen(pipeline)] < 0.6).float().mean())
    assert f"{share:.0%} of this selection is poorly evidenced (R < 0.6)" in said(panel)
    assert panel._widgets.poor.visible
    press(panel._widgets.poor)
    assert (reliability[chosen(pipeline)] == 0.9).all()
    assert chosen(pipeline).any()
    assert not panel._widgets.poor.visible
    pipeline.model.attach(field, QUESTION)


def test_hides_add_up_stay_and_are_undone(panel: Any, pipeline: Any) -> None:
    ask(panel, "left")
    left = chosen(pipeline)
    before = outputs(pipeline)["accumulation"].sum()
    panel.act("Hide")
    assert torch.equal(pipeline.model._display.drawn, ~left)
    assert outputs(pipeline)["accumulation"].sum() < before
    ask(panel, "right")
    right = chosen(pipeline)
    assert torch.equal(pipeline.model._display.drawn, ~left)  # what is hidden stays hidden
    panel.act("Hide")
    assert torch.equal(pipeline.model._display.drawn, ~left & ~right)
    assert f"{int((left | right).sum())} Gaussians are hidden" in said(panel)
    panel.act("Undo")
    assert torch.equal(pipeline.model._display.drawn, ~left)
    panel.act("Undo")
    assert panel._widgets.prompts.value == "left"
    panel.act("Undo")
    assert pipeline.model._display.drawn is None
    ask(panel, "up")
    assert not chosen(pipeline).any()
    for name in ("Hide", "Only"):  # nothing is hidden, and no screen is blank
        panel.act(name)
        assert "Nothing is selected" in said(panel)
        assert pipeline.model._display.drawn is None
    ask(panel, "left")
    panel.act("Only")
    assert torch.equal(pipeline.model._display.drawn, chosen(pipeline))
    panel.act("All")
    assert pipeline.model._display.drawn is None


def test_clear_leaves_no_settings_behind(panel: Any, pipeline: Any) -> None:
    before = {name: getattr(panel._widgets, name).value for name in ("reliability", "rule", "refined", "negatives")}
    panel._widgets.rule.value, panel._widgets.negatives.value = "cosine", "0.5"
    panel._widgets.refined.value = False
    panel._widgets.reliability.value = 1.0  # before the first question, which takes it over
    ask(panel, "left")
    assert panel.answer.question.min_reliability == 1.0
    panel.act("Clear")
    assert {name: getattr(panel._widgets, name).value for name in before} == before
    ask(panel, "left")
    assert panel.answer.question.min_reliability == 0.0
    assert chosen(pipeline).any()


def test_what_a_person_changes_meanwhile_is_kept(panel: Any) -> None:
    widgets = panel._widgets
    widgets.reliability._impl.value = 0.25  # a browser has changed it; viser has not told it yet
    panel.act("Threshold", 0.7)
    assert widgets.reliability.value == 0.25
    ask(panel, "left")
    assert panel.answer.question.min_reliability == 0.25
    for told in widgets.reliability._impl.update_cb:
        told(SimpleNamespace(client=Browser()))
    assert widgets.reliability.value == panel.answer.question.min_reliability == 0.25


def test_the_next_question_shows_all_its_prompts(panel: Any) -> None:
    ask(panel, "left, right")
    panel._widgets.shown.value = "1: left"
    until(lambda: panel.state.shown == 0)
    ask(panel, "left, right, up")
    assert panel.state.shown is None
    assert panel._widgets.shown.value == "all prompts"


def test_clear_clears_everything(panel: Any, pipeline: Any) -> None:
    ask(panel, "left, banana")
    panel.act("Hide")
    panel.act("More like this", client=(browser := Browser()))
    panel.act("Clear")
    assert panel._widgets.prompts.value == ""
    assert panel.answer is None
    assert not chosen(pipeline).any()
    assert pipeline.model._display.drawn is None
    assert browser._scene_pointer_cb is None
    assert said(panel).strip() == "No query yet."
    panel.act("Undo")
    assert panel.answer.texts == ("left",)


def test_counts_that_differ_say_why(panel: Any, pipeline: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    faint = pipeline.model.gauss_params["opacities"].detach().clone()
    first = int(chosen(pipeline).nonzero()[0])
    faint[first] = -9.0
    splats = ({**pipeline.model.gauss_params, "opacities": faint}, True, "classic")
    monkeypatch.setattr(pipeline.model, "splats", lambda: splats)
    ask(panel, "left, left again")
    count = int(chosen(pipeline).sum())
    assert "1 of them are never drawn nor exported (opacity below 1/255)" in said(panel)
    assert f"{count} of them are selected by several prompts" in said(panel)
    panel.act("Download selection", client=(browser := Browser()))
    assert f"with {count - 1} Gaussians goes to your downloads" in said(panel)
    ((name, content),) = browser.files.items()
    assert name == "left__left_again.ply"
    vertices = PlyData.read(io.BytesIO(content))["vertex"]
    rows = chosen(pipeline)
    rows[first] = False
    means = np.stack([vertices[axis] for axis in "xyz"], axis=1)
    assert np.array_equal(means, pipeline.model.means.detach()[rows].cpu().numpy())
    ask(panel, "up")
    panel.act("Download selection", client=browser)
    assert "Nothing is selected" in said(panel)
    assert len(browser.files) == 1


def test_fifty_prompts_and_markup(panel: Any, pipeline: Any) -> None:
    ask(panel, "; ".join(f"{side} {i}" for i in range(25) for side in ("left", "right")))
    assert sum(name.startswith("relevancy_") for name in outputs(pipeline)) == 50
    assert said(panel).count("■") == 8
    assert "and 42 more" in said(panel)
    ask(panel, "left {alert(1)} <img src=x onerror=alert(1)> | `x` ![](http://a); right")
    (row,) = [line for line in panel._widgets.found.content.splitlines() if "alert" in line]
    text = row.split(" | ")[1]
    assert not set(re.sub(r"&#\d+;", "", text)) & set("{}<>|`![]()#\n=&")
    assert row.count("|") == 5


def until(true: Callable[[], bool]) -> None:
    """Waits for what other threads do."""
    deadline = time.monotonic() + 20
    while not true():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def listed(panel: Any) -> list[Any]:
    """The buttons of the found objects, once they are listed for what is selected."""
    until(lambda: panel._rest._turns.busy == "")
    with panel._lock:  # which is held from then on, until they are shown
        return [group for _, group in panel._widgets.rows._rows if group.visible]


def press_row(group: Any, deed: str, browser: Browser) -> None:
    group._impl.value = deed
    press(group, browser)


def test_found_objects_have_buttons(panel: Any, pipeline: Any) -> None:
    ask(panel, "left; right")
    groups, browser = listed(panel), Browser()
    objects = found_objects(panel.state).objects
    assert len(groups) == len(objects) > 0
    first = objects[0]
    press_row(groups[0], "go to", browser)
    assert browser.camera.look_at == pytest.approx(10 * np.array(first.centre))
    away = np.linalg.norm(browser.camera.position - browser.camera.look_at) / 10
    assert away == pytest.approx(first.extent / np.tan(0.5))
    press_row(groups[0], "export", browser)
    ((name, content),) = browser.files.items()
    assert name == "left_1.ply"
    assert 0 < PlyData.read(io.BytesIO(content))["vertex"].count <= first.size
    press_row(groups[0], "hide", browser)
    assert torch.equal(pipeline.model._display.drawn, ~first.mask)
    assert len(listed(panel)) == len(found_objects(panel.state).objects) < len(objects)
    panel.act("Undo")
    press_row(listed(panel)[0], "only", browser)
    assert torch.equal(pipeline.model._display.drawn, first.mask)
    ask(panel, "up")
    assert listed(panel) == []
    press_row(groups[0], "hide", browser)  # as its page still shows it
    assert pipeline.model._display.drawn is not None
    assert torch.equal(pipeline.model._display.drawn, first.mask)
    assert "Nothing that is drawn is selected" in html.unescape(panel._widgets.rows._remark.content)


def test_the_histogram_has_the_threshold_and_one_is_suggested(panel: Any, pipeline: Any) -> None:
    ask(panel, "left")
    listed(panel)
    assert panel._widgets.histograms.content.count("data:image/svg+xml") == 1
    relevancy = panel.answer.relevancy[panel.answer.valid][:, 0].double()
    top = relevancy.quantile(0.999)
    expected = float(relevancy.quantile(0.5) + 0.6 * (top - relevancy.quantile(0.5)))
    panel.act("Suggested")
    assert panel.answer.question.threshold == pytest.approx(expected, abs=1e-6)
    assert panel._widgets.threshold.value == pytest.approx(expected, abs=1e-6)
    ask(panel, "up, left")
    listed(panel)
    text = html.unescape(panel._widgets.histograms.content)
    assert text.count("data:image/svg+xml") == 2
    assert "up: probably not in this scene. The nearest match at" in text
    panel.act("Clear")
    listed(panel)
    assert panel._widgets.histograms.content == ""
    panel.act("Suggested")
    assert "there is no threshold to suggest" in said(panel)


def test_floaters_are_selected_hidden_and_brought_back(panel: Any, pipeline: Any, monkeypatch: Any) -> None:
    field, scene = pipeline.model.field, pipeline.model.scene()
    expected = find_floaters(scene, field.scalars).mask
    if not expected.any():  # whatever the random scene has, one is far away
        means = scene.means.clone()
        means[7] += 1000
        monkeypatch.setattr(pipeline.model, "scene", lambda: replace(scene, means=means))
        expected = find_floaters(pipeline.model.scene(), field.scalars).mask
    assert 0 < int(expected.sum()) < 30
    press(button(panel, "Select likely floaters"))
    assert torch.equal(chosen(pipeline), expected)
    assert "Look at them, then press Hide" in said(panel)
    panel.act("Hide")
    assert torch.equal(pipeline.model._display.drawn, ~expected)
    panel.act("Undo")
    assert pipeline.model._display.drawn is None
    panel.act("Undo")
    assert panel.state.from_answer
    monkeypatch.setattr(pipeline.model, "scene", lambda: replace(scene, opacities=torch.zeros_like(scene.opacities)))
    press(button(panel, "Select likely floaters"))
    assert "There are no likely floaters" in said(panel)
    assert panel.state.from_answer


def button(panel: Any, label: str) -> Any:
    """A button of the tab that has no name of its own."""
    handles = panel._widgets._gui._gui_input_handle_from_id.values()
    return next(handle for handle in handles if getattr(handle._impl, "label", "") == label)


def test_why_says_what_is_missing(panel: Any, pipeline: Any) -> None:
    ask(panel, "up")
    press(panel._widgets.why)
    assert not panel._widgets.why.disabled
    ask(panel, "left")
    press(panel._widgets.why)  # the panel writes to a folder of the test, where no run is
    assert str(pipeline.model.config.semantics.parent) in said(panel)
    assert "Traceback" not in said(panel)
    assert panel._widgets.reasons.content == ""


def test_why_shows_the_photographs_and_drops_what_is_stale(stock: StockRun, tmp_path: Path, panel: Any) -> None:
    how = {"source": SourceOptions(encoder="colour"), "lift": LiftOptions(storage="evidence")}
    run = nl.lift_run(stock.config, **how, output_dir=tmp_path, timestamp="one")
    reasons = reasons_of(run.folder / "normlift", run.field)
    device = panel.state.space.means.device
    field, means = run.field.to(device), run.scene.gaussians.means.to(device)
    state = actions.select(State(Space(field, means)), field.scalars.weight > 0)
    reasons.find(reasons.start(state), state)
    why = run.why(state.selection.cpu())
    text = html.unescape(reasons.content)
    assert why.words in text
    names = {run.votes.names[vote.view] for vote in (*why.views[:3], *why.most_different[:3])}
    assert all(name in text for name in names)
    assert text.count("data:image/jpeg;base64,") == len(names)
    panel._reasons = reasons
    panel._follow()
    assert panel._widgets.reasons.content == reasons.content
    ask(panel, "left")  # another selection
    assert panel._widgets.reasons.content == ""


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
        "normlift_ns.nerfstudio_plugin.asker.encoder_of", lambda _, device, __: loaded.append(device) or encoder
    )
    yield encoder, loaded
    encoder.go_on.set()


def in_thread(panel: Any, prompts: str) -> Thread:
    panel._widgets.prompts.value = prompts
    asking = Thread(target=press, args=[panel._widgets.ask])
    asking.start()
    return asking


def test_the_button_shows_that_it_works_and_the_picture_stays_live(pipeline, opened, slow) -> None:
    panel, lock, (encoder, loaded) = pipeline.model.normlift, opened[1].train_lock, slow
    before = chosen(pipeline)
    asking = in_thread(panel, "right")
    assert encoder.reading.wait(20)
    assert lock.acquire(timeout=1)  # as the viewer does to render
    assert torch.equal(chosen(pipeline), before)
    lock.release()
    assert panel._widgets.ask.disabled
    assert panel._widgets.cancel.visible
    assert "Reading the prompts" in said(panel)
    panel.act("Threshold", 0.6)  # the panel can be used, and still says what it waits for
    assert panel.answer.texts == ("left",)
    assert "Reading the prompts" in said(panel)
    assert panel._widgets.prompts.value == "right"  # what is typed is nobody else's
    encoder.go_on.set()
    asking.join(20)
    assert panel.answer.texts == ("right",)
    assert "Reading the prompts" not in said(panel)
    assert not panel._widgets.ask.disabled
    assert not panel._widgets.cancel.visible
    assert loaded == [str(pipeline.model.device)]


@pytest.mark.parametrize("end", ["Cancel", "Clear"])
def test_a_stale_answer_is_dropped(pipeline: Any, slow: tuple[Slow, list[str]], end: str) -> None:
    panel, (encoder, _) = pipeline.model.normlift, slow
    asking = in_thread(panel, "right")
    assert encoder.reading.wait(20)
    panel.act(end)
    assert not panel._widgets.ask.disabled
    encoder.go_on.set()
    asking.join(20)
    assert (panel.answer is None) == (end == "Clear")
    assert panel.answer is None or panel.answer.texts == ("left",)
    assert "Reading" not in said(panel)


def test_of_many_questions_the_last_is_shown(pipeline: Any, slow: tuple[Slow, list[str]]) -> None:
    panel, (encoder, loaded) = pipeline.model.normlift, slow
    threads = []
    for prompts in ("right", "banana", "left; up"):
        threads.append(in_thread(panel, prompts))
        assert encoder.reading.wait(20)
        time.sleep(0.1)
    encoder.go_on.set()
    for thread in threads:
        thread.join(20)
    assert panel.answer.texts == ("left", "up")
    assert "banana" not in said(panel)
    assert len(loaded) == 1


def ray(pipeline: Any, opened: tuple[Any, Viewer]) -> SimpleNamespace:
    pose = pipeline.datamanager.train_dataset.cameras.camera_to_worlds[0]
    origin, forward = pose[:, 3] * 10, -pose[:, 2]
    return SimpleNamespace(ray_origin=tuple(origin.tolist()), ray_direction=tuple(forward.tolist()))


def test_a_click_asks_is_saved_and_asked_again(panel: Any, pipeline: Any, opened: tuple[Any, Viewer]) -> None:
    browser, event = Browser(), ray(pipeline, opened)
    panel.act("More like this", client=browser)
    assert "Click on something" in said(panel)
    field = pipeline.model.field
    weights = pipeline.model.in_sight(torch.tensor(event.ray_origin) / 10, torch.tensor(event.ray_direction))
    met = weights.where(field.valid(), 0.0).argmax()
    browser._scene_pointer_cb(event)
    assert browser._scene_pointer_cb is None
    assert panel._widgets.prompts.value == "like click 1"
    similar = field.directions() @ field.directions(met[None])[0]
    assert torch.equal(chosen(pipeline), (similar > 0.9) & field.valid())
    clicked = chosen(pipeline)
    panel.act("Save prompts in run")
    assert "the run stores one prompt" in said(panel)
    ask(panel, "left")
    assert panel.answer.question.threshold == 0.5  # not that of the click
    stored = load_question(pipeline.model.config.semantics)
    pipeline.model.attach(field, stored)  # as after a restart
    assert panel._clicks.known == {}
    ask(panel, "left")
    ask(panel, "like click 1")
    assert torch.equal(chosen(pipeline), clicked)
    panel.act("More like this", client=browser)
    browser._scene_pointer_cb(event)
    assert panel.answer.texts == ("like click 2",)  # the saved one is not replaced
    panel.act("More like this", client=browser)
    event.ray_direction = tuple(-x for x in event.ray_direction)
    browser._scene_pointer_cb(event)
    assert "nothing with semantics" in said(panel)
    assert panel.answer.texts == ("like click 2",)


def test_an_armed_click_can_be_cancelled_and_is_not_used_up_elsewhere(panel, pipeline, opened) -> None:
    browser, other, event = Browser(1), Browser(2), ray(pipeline, opened)
    for name, cancels in (("Cancel", True), ("Clear", True), ("Ask", True), ("Hide", False)):
        ask(panel, "left")
        panel.act("More like this", client=browser)
        assert panel._widgets.cancel.visible
        assert other._scene_pointer_cb is None
        assert opened[1].viser_server.scene._scene_pointer_cb is None
        armed = browser._scene_pointer_cb
        panel.act(name, client=other)
        assert (browser._scene_pointer_cb is None) == cancels
        assert panel._widgets.cancel.visible != cancels
        before = chosen(pipeline)
        if cancels:
            armed(event)  # was on its way
            assert torch.equal(chosen(pipeline), before)
    panel.forget(other)
    assert panel._clicks.armed
    panel.forget(browser)
    assert not panel._clicks.armed
    assert not panel._widgets.cancel.visible


def test_a_browser_that_goes_while_another_one_presses_stops_nobody(panel, opened) -> None:
    """viser tells that it is gone under the lock that `get_clients` takes, which every picture needs."""
    server, browser, held = opened[1].viser_server, Browser(3), Event()
    ask(panel, "left")
    panel.act("More like this", client=browser)

    def go() -> None:
        with server._client_lock:
            held.set()
            time.sleep(0.5)  # meanwhile the other one has the panel's lock, and waits for this one
            server._client_disconnect_cb[-1](browser)

    going, pressing = Thread(target=go, daemon=True), Thread(target=lambda: panel.act("Hide"), daemon=True)
    going.start()
    assert held.wait(10)
    pressing.start()
    for thread in (going, pressing):
        thread.join(timeout=20)
        assert not thread.is_alive()
    until(lambda: not panel._clicks.armed)
    panel.act("Undo")


def test_a_browser_that_comes_or_goes_leaves_no_other_with_an_old_picture(panel, opened, monkeypatch) -> None:
    viewer, drawn = opened[1], []
    there = SimpleNamespace(action=lambda action: drawn.append(action.camera_state))
    monkeypatch.setattr(viewer, "ready", True)
    monkeypatch.setattr(viewer.viser_server, "get_clients", lambda: dict.fromkeys((4, 5, 6), Browser()))
    monkeypatch.setattr(viewer, "get_camera_state", lambda client: client)
    monkeypatch.setattr(viewer, "render_statemachines", {5: there})
    ask(panel, "left")
    drawn.clear()
    panel.act("Hide")
    assert len(drawn) == 1
    panel.act("Undo")


def test_objects_are_selected_added_and_taken_away_by_clicks(panel, pipeline, opened) -> None:
    browser, event = Browser(), ray(pipeline, opened)
    panel.act("Select", client=browser)
    browser._scene_pointer_cb(event)
    one = chosen(pipeline)
    assert one.any()
    panel.act("Drop", client=browser)
    browser._scene_pointer_cb(event)
    assert not (chosen(pipeline) & one).all()
    panel.act("Undo")
    assert torch.equal(chosen(pipeline), one)


def test_the_selection_grows_and_shrinks(panel: Any, pipeline: Any) -> None:
    ask(panel, "left")
    whole = chosen(pipeline)
    slider = panel._widgets.steps
    for steps in (3, -4, -9):
        slider.value = steps
        press(slider)  # viser calls what it calls for a button
        assert torch.equal(chosen(pipeline), panel.state.space.resized(whole, steps, refined=panel.state.refined))
    part = chosen(pipeline)
    assert part.any()
    assert not (part & ~whole).any()
    assert int(part.sum()) < int(whole.sum())
    panel.act("Undo")  # the drag of a slider is one step
    assert slider.value == 0
    assert torch.equal(chosen(pipeline), whole)


def test_nothing_saved_is_replaced_unasked(panel: Any, pipeline: Any) -> None:
    folder = pipeline.model.config.semantics
    ask(panel, "left")
    panel.act("Save prompts in run")
    ask(panel, "right, left")
    panel.act("Save prompts in run")
    stored = load_question(folder)
    assert stored is not None and stored.texts == ("left", "right")
    ask(panel, "up", "left")  # another rule
    assert not panel._widgets.replace.visible
    panel.act("Save prompts in run")
    assert "cannot be saved together" in said(panel)
    assert load_question(folder).texts == ("left", "right")  # type: ignore[union-attr]
    assert panel._widgets.replace.visible
    press(panel._widgets.replace)
    stored = load_question(folder)
    assert stored is not None and (stored.texts, stored.negatives, stored.rule) == (("up",), ("left",), "lerf")
    assert not panel._widgets.replace.visible
    panel.act("Clear")
    panel.act("Save prompts in run")
    assert "No query yet" in said(panel)


def test_refined_and_unrefined(panel: Any, pipeline: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    field = pipeline.model.field
    moved = field.source.clone()
    moved[:30] = moved[30:]
    pipeline.model.attach(replace(field, source=moved), QUESTION)
    ask(panel, "left; right")
    panel.act("shown", "1: left")
    refined = chosen(pipeline)
    panel.act("refined", False)
    assert panel._widgets.shown.value == "1: left"
    assert not torch.equal(chosen(pipeline), refined)
    assert torch.equal(panel.answer.relevancy, field.relevancy(torch.eye(8)[:2], refined=False))
    pipeline.model.attach(field, QUESTION)


def test_a_panel_waits_for_a_field(stock: StockRun, registered: None, pipeline: Any) -> None:
    """As in a training: the viewer starts before there is anything to ask."""
    panel, field = pipeline.model.normlift, pipeline.model.field
    panel.close()
    assert panel._widgets.ask.disabled
    assert "at the end of the training" in said(panel)
    for name in ("Ask", "Hide", "Undo", "Clear", "Save prompts in run", "More like this"):
        panel.act(name, client=Browser())
        assert "at the end of the training" in said(panel)
    pipeline.model.attach(field)
    assert not panel._widgets.ask.disabled
    assert said(panel).strip() == "No query yet."


def test_a_copied_run_points_at_itself(lifted: Path, registered: None) -> None:
    copy = lifted.parent.with_name("copy")
    shutil.copytree(lifted.parent, copy)
    found = {}
    for config in (lifted, copy / "config.yml"):
        with pytest.MonkeyPatch.context() as patch:
            patch.setitem(all_methods, "normlift", normlift_method.config)
            model = eval_setup(config)[1].model
        found[config] = model.config.semantics
        assert model.normlift._folder == model.config.semantics
    assert found == {lifted: lifted.parent / "normlift", copy / "config.yml": copy / "normlift"}
    assert "semantics: normlift" in lifted.read_text() or "- normlift" in lifted.read_text()
