"""The panel inside nerfstudio's own Viewer, its widgets pressed as viser presses them.

What the actions do to a state is tested in tests/session; here, that each widget does its action and shows the result.
"""

import html
import io
import re
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from threading import Event, Lock, Thread
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from plyfile import PlyData

from normlift_ns.exports import TrainedSplat
from normlift_ns.options import LiftOptions, SourceOptions
from normlift_ns.query.engine import run_query
from normlift_ns.query.question import load_query
from normlift_ns.session import actions
from normlift_ns.session.objects import list_objects
from normlift_ns.session.selection import SelectionContext
from normlift_ns.session.state import State
from normlift_ns.viewer.widgets import Action
from tests.nerfstudio_plugin.conftest import asking, set_up
from tests.nerfstudio_plugin.stock_run import StockRun
from tests.viewer.scenes import free_port, until

NAMES = {"left": 0, "right": 1, "up": 2}


class Browser:
    """A browser as viser hands it to a callback."""

    def __init__(self, number: int = 0) -> None:
        self.client_id, self.files, self.scene = number, {}, self
        self._scene_pointer_cb: Any = None
        up = np.array([0.0, 0, 1])
        self.camera = SimpleNamespace(position=np.zeros(3), look_at=np.ones(3), up_direction=up, fov=1.0)

    def atomic(self) -> Any:
        return nullcontext()

    def on_pointer_event(self, kind: str) -> Any:
        assert kind == "click"
        return lambda action: setattr(self, "_scene_pointer_cb", action)

    def remove_pointer_callback(self) -> None:
        self._scene_pointer_cb = None

    def send_file_download(self, name: str, content: bytes) -> None:
        self.files[name] = content


def encode(prompts: Any) -> torch.Tensor:
    """Encodes left and right as the two directions of `lifted_field`, up as one that nothing has."""
    unknown = [p for p in prompts if p.split()[0] not in NAMES]
    if unknown:
        raise ValueError(f"I do not know {unknown[0]!r}")
    return torch.eye(8)[[NAMES[p.split()[0]] for p in prompts]]


@pytest.fixture(scope="module")
def viewed(stock_lifted: Path, nerfstudio: Any, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Any, Any]]:
    """The pipeline of the run, and the viewer that shows it."""
    from nerfstudio.configs.base_config import ViewerConfig  # noqa: PLC0415
    from nerfstudio.viewer.viewer import Viewer  # noqa: PLC0415

    from normlift_ns.method_configs.normlift import normlift_method  # noqa: PLC0415

    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(nerfstudio.all_methods, "normlift", normlift_method.config)
        pipeline = set_up(stock_lifted)
    config = ViewerConfig(websocket_host="127.0.0.1", websocket_port=free_port())
    folder = tmp_path_factory.mktemp("viewer")
    viewer = Viewer(config, folder / "log" / "viewer.log", folder, pipeline, train_lock=Lock())
    yield pipeline, viewer
    viewer.viser_server.stop()


@pytest.fixture
def viewer(viewed: tuple[Any, Any]) -> Any:
    return viewed[1]


@pytest.fixture
def pipeline(viewed: tuple[Any, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """The pipeline as loaded; what the panel writes goes to a folder of the test."""
    monkeypatch.setattr("normlift_ns.nerfstudio_plugin.panel._DELAY", 0.01)
    model, output = viewed[0].model, viewed[1].control_panel._output_render
    field = model.field
    model.config.semantics = tmp_path / "run" / "normlift"
    model.config.semantics.mkdir(parents=True)
    model.normlift._encoder.clear()
    output.set_options(["rgb", "overlay"])
    output.value = "rgb"
    model.normlift._widgets.rule.value = "auto"
    adjust(model.normlift, refined=True, reliability=0.0)
    model.attach(field, asking("left"))
    yield viewed[0]
    model.attach(field)


@pytest.fixture
def panel(pipeline: Any) -> Any:
    panel = pipeline.model.normlift
    panel._encoder.append(SimpleNamespace(rows=encode))
    return panel


def press(button: Any, browser: Browser | None = None) -> None:
    """What viser does when the button is pressed."""
    for action in button._impl.update_cb:
        action(SimpleNamespace(client=browser or Browser(), target=button))


def ask(panel: Any, prompts: str, negatives: str = "") -> None:
    panel._widgets.prompts.value, panel._widgets.negatives.value = prompts, negatives
    press(panel._widgets.ask)


def adjust(panel: Any, *, refined: bool, reliability: float) -> None:
    """Sets widgets as a browser does, and waits until viser's threads have called what the panel does then."""
    widgets = panel._widgets
    widgets.refined.value, widgets.reliability.value = refined, reliability
    until(lambda: (widgets._values[Action.REFINED], widgets._values[Action.RELIABILITY]) == (refined, reliability))
    with widgets._lock:  # held while the panel acts
        pass


def said(panel: Any) -> str:
    return html.unescape(panel._widgets.status.content + "\n\n" + panel._widgets.prompt_table.content)


def outputs(pipeline: Any) -> dict[str, torch.Tensor]:
    return pipeline.model.get_outputs_for_camera(pipeline.datamanager.train_dataset.cameras[:1])


def chosen(pipeline: Any) -> torch.Tensor:
    """The Gaussians of the selection that is rendered."""
    display = pipeline.model._display
    return display.values[:, display.num_prompts + 1] > 0


def test_the_first_tab_shows_the_stored_question_without_an_encoder(pipeline: Any, viewer: Any) -> None:
    from nerfstudio.viewer.utils import parse_object  # noqa: PLC0415
    from nerfstudio.viewer.viewer_elements import ViewerControl, ViewerElement  # noqa: PLC0415

    panel, handles = pipeline.model.normlift, viewer.viser_server.gui._container_handle_from_id.values()
    group = next(held for held in handles if hasattr(held, "_parent"))._parent
    assert group._labels == ["Search", "Control", "Render", "Export"]
    labels = [held._impl.label for held in group._tabs[0]._children.values() if hasattr(held, "_impl")]
    assert labels[:3] == ["Prompts", "Ask", "Cancel"]
    assert parse_object(pipeline, ViewerElement, "x") == []  # nothing far down in another tab
    assert [element for _, element in parse_object(pipeline, ViewerControl, "x")] == [panel.control]
    assert (panel._encoder, panel._widgets.prompts.value, panel._widgets.threshold.value) == ([], "left", 0.5)
    expected = run_query(pipeline.model.field, pipeline.model.means, asking("left")).selected[:, 0]
    assert torch.equal(chosen(pipeline), expected)
    assert f"**{int(expected.sum())}** of 60" in said(panel)
    assert not any("normlift" in name for name in pipeline.state_dict())


def test_every_control_does_what_it_says(panel: Any, pipeline: Any, viewer: Any) -> None:
    """One walk; the picture follows, and the first answer switches to the overlay."""
    model, widgets, output = pipeline.model, panel._widgets, viewer.control_panel._output_render
    both = run_query(model.field, model.means, asking("left", "right")).selected
    output.set_options(["not set"])  # as before the first picture
    ask(panel, " left , right;; ")
    viewer.control_panel.update_output_options([*outputs(pipeline)])
    assert (panel.answer.texts, output.value) == (("left", "right"), "overlay")
    assert list(outputs(pipeline))[4:7] == ["relevancy_left", "relevancy_right", "reliability"]
    assert torch.equal(chosen(pipeline), both.any(dim=1))
    best = panel.answer.relevancy[panel.answer.valid].amax(dim=0).tolist()
    rows = [[cell.strip() for cell in line.split("|")] for line in widgets.prompt_table.content.splitlines()[-2:]]
    expected = [(text, str(int(n)), f"{peak:.2f}") for text, n, peak in zip(panel.answer.texts, both.sum(dim=0), best)]
    assert [(row[2], row[3], row[4]) for row in rows] == expected
    widgets.shown.value = "2: right"
    until(lambda: panel.state.shown == 1)
    assert torch.equal(chosen(pipeline), both[:, 1])
    output.value = "relevancy_right"
    ask(panel, "left")
    assert (panel.state.shown, widgets.shown.value) == (None, "all prompts")
    assert output.value == "overlay"  # relevancy_right is no output any more
    output.value = "rgb"
    ask(panel, "right")
    assert output.value == "overlay"
    output.value = "depth"
    ask(panel, "left", "right")
    assert output.value == "depth"  # what the person chose stays
    assert (panel.answer.question.rule, panel.answer.question.negatives) == ("lerf", ("right",))

    ask(panel, "left")
    count = int(chosen(pipeline).sum())
    output.value = "rgb"
    panel.act(Action("Threshold"), 0.99)
    assert output.value == "rgb"  # only answers change it
    assert f"**{int(chosen(pipeline).sum())}** of 60" in said(panel) and int(chosen(pipeline).sum()) < count
    panel.act(Action("Threshold"), 0.6)
    panel.act(Action("Undo"))  # the drag of a slider is one step
    assert int(chosen(pipeline).sum()) == count
    panel.act(Action("Redo"))
    ask(panel, "right")
    assert panel.answer.question.threshold == 0.6  # stays for the same rule
    least = float(model.field.scalars.reliability.median())
    panel.act(Action("Minimum reliability"), least)
    assert (model.field.scalars.reliability[chosen(pipeline)] >= least).all()
    ask(panel, "left")
    assert panel.answer.question.min_reliability == pytest.approx(least)
    panel.act(Action.COLORS, "magma")
    assert pipeline.model._display.colormap == "magma" == panel._colormap

    panel.act(Action("refined"), False)
    assert not panel.answer.question.refined
    panel.act(Action("Undo"))
    panel.act(Action("Threshold"), 0.5)
    whole = chosen(pipeline)
    assert widgets.refined.value and whole.any()
    widgets.steps.value = -4
    press(widgets.steps)  # viser calls what it calls for a button
    until(lambda: panel.state.grow_steps == -4)
    assert torch.equal(chosen(pipeline), panel.state.space.grow_or_shrink(whole, -4, refined=True))
    panel.act(Action("Undo"))
    assert widgets.steps.value == 0
    before = outputs(pipeline)["accumulation"].sum()
    panel.act(Action("Hide"))
    assert torch.equal(model._display.drawn, ~whole) and outputs(pipeline)["accumulation"].sum() < before
    assert f"{int(whole.sum())} Gaussians are hidden" in said(panel)
    panel.act(Action("Show all"))
    assert model._display.drawn is None
    panel.act(Action("Isolate"))
    assert torch.equal(model._display.drawn, whole)
    panel.act(Action("Show all"))
    widgets.reliability._impl.value = 0.25  # a browser has changed it; viser has not told it yet
    panel.act(Action("Threshold"), 0.7)
    assert widgets.reliability.value == 0.25
    ask(panel, "left")
    press(widgets.reliability)
    assert widgets.reliability.value == panel.answer.question.min_reliability == 0.25


def test_clear_leaves_nothing_behind(panel: Any, pipeline: Any) -> None:
    widgets, settings = panel._widgets, ("reliability", "rule", "refined", "negatives")
    before = {name: getattr(widgets, name).value for name in settings}
    widgets.rule.value, widgets.negatives.value = "cosine", "0.5"
    adjust(panel, refined=False, reliability=1.0)  # before the first question, which takes it over
    ask(panel, "left, banana")
    question = panel.answer.question
    assert (question.min_reliability, question.rule, question.refined) == (1.0, "cosine", False)
    panel.act(Action("Minimum reliability"), 0.0)
    panel.act(Action("Hide"))
    panel.act(Action("More like this"), client=(browser := Browser()))
    panel.act(Action("Clear"))
    assert {name: getattr(widgets, name).value for name in settings} == before
    assert (widgets.prompts.value, said(panel).strip()) == ("", "No query.")
    assert panel.answer is pipeline.model._display.drawn is browser._scene_pointer_cb is None
    panel.act(Action("Use suggested"))
    assert "threshold" in said(panel) and not chosen(pipeline).any()
    ask(panel, "right")
    assert panel.answer.question.min_reliability == 0.0 and chosen(pipeline).any()


def test_poor_evidence_is_said_and_can_be_left_out(panel: Any, pipeline: Any) -> None:
    field = pipeline.model.field
    reliability = torch.where(torch.arange(60) % 3 == 0, 0.9, 0.5).to(pipeline.model.device)
    pipeline.model.attach(replace(field, scalars=replace(field.scalars, reliability=reliability)), asking("left"))
    assert "of this selection" in said(panel) and panel._widgets.remove_weak.visible
    press(panel._widgets.remove_weak)
    assert chosen(pipeline).any() and (reliability[chosen(pipeline)] == 0.9).all()
    assert not panel._widgets.remove_weak.visible


def test_counts_that_differ_say_why(panel: Any, pipeline: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    faint = pipeline.model.gauss_params["opacities"].detach().clone()
    first = int(chosen(pipeline).nonzero()[0])
    faint[first] = -9.0
    splats = TrainedSplat({**pipeline.model.gauss_params, "opacities": faint}, True, "classic")
    monkeypatch.setattr(pipeline.model, "splat_parameters", lambda: splats)
    ask(panel, "left, left again")
    rows = chosen(pipeline)
    count = int(rows.sum())
    assert "1 of the selected Gaussians cannot be drawn" in said(panel)
    assert f"{count} of the selected Gaussians match several prompts" in said(panel)
    panel.act(Action("Download selection"), client=(browser := Browser()))
    assert f"Gaussians: {count - 1}." in said(panel)
    rows[first] = False
    vertices = PlyData.read(io.BytesIO(browser.files["left__left_again.ply"]))["vertex"]
    means = np.stack([vertices[axis] for axis in "xyz"], axis=1)
    assert np.array_equal(means, pipeline.model.means.detach()[rows].cpu().numpy())
    ask(panel, "up")
    panel.act(Action("Download selection"), client=browser)
    assert "Nothing is selected" in said(panel) and len(browser.files) == 1


def test_fifty_prompts_markup_and_what_cannot_be_asked(panel: Any, pipeline: Any) -> None:
    ask(panel, "x" * 10_000)
    assert "I do not know" in said(panel) and len(said(panel)) < 3000 and panel.state.answer is None
    ask(panel, "left, banana; right")
    assert (panel.answer.texts, panel._widgets.prompts.value) == (("left", "right"), "left, banana; right")
    (row,) = [line for line in said(panel).splitlines() if "banana" in line]
    assert row.startswith("| ⚠ |") and "I do not know" in row
    ask(panel, "; ".join(f"{side} {i}" for i in range(25) for side in ("left", "right")))
    assert sum(name.startswith("relevancy_") for name in outputs(pipeline)) == 50
    assert said(panel).count("■") == 8 and "42 more" in said(panel)
    ask(panel, "left {alert(1)} <img src=x onerror=alert(1)> | `x` ![](http://a); right")
    (row,) = [line for line in panel._widgets.prompt_table.content.splitlines() if "alert" in line]
    assert not set(re.sub(r"&#\d+;", "", row.split(" | ")[1])) & set("{}<>|`![]()#\n=&")


def listed(panel: Any) -> list[Any]:
    """The buttons of the found objects, once they are listed for what is selected."""
    until(lambda: panel._detail_turns.busy == "")
    with panel._lock:  # which is held from then on, until they are shown
        return [group for _, group in panel._widgets.rows._rows if group.visible]


def press_row(group: Any, deed: str, browser: Browser) -> None:
    group._impl.value = deed
    press(group, browser)


def test_found_objects_have_buttons_and_prompts_histograms(panel: Any, pipeline: Any) -> None:
    ask(panel, "left; right")
    groups, browser = listed(panel), Browser()
    objects = list_objects(panel.state).objects
    assert len(groups) == len(objects) > 0
    assert panel._widgets.histograms.content.count("data:image/svg+xml") == 2
    first, camera = objects[0], browser.camera
    press_row(groups[0], "Go to", browser)
    assert camera.look_at == pytest.approx(10 * np.array(first.center))
    assert np.linalg.norm(camera.position - camera.look_at) == pytest.approx(10 * first.extent / (1.6 * np.tan(0.5)))
    press_row(groups[0], "Export", browser)
    assert 0 < PlyData.read(io.BytesIO(browser.files["left_1.ply"]))["vertex"].count <= first.size
    press_row(groups[0], "Isolate", browser)
    assert torch.equal(pipeline.model._display.drawn, first.mask)
    ask(panel, "up")
    assert listed(panel) == []
    assert "up: probably not here" in html.unescape(panel._widgets.histograms.content)
    press_row(groups[0], "Hide", browser)  # as its page still shows it
    assert torch.equal(pipeline.model._display.drawn, first.mask)
    assert "No visible objects selected" in html.unescape(panel._widgets.rows._summary.content)


def test_why_shows_images_or_what_is_missing_until_stale(stock: StockRun, tmp_path: Path, panel: Any) -> None:
    import normlift_ns as nl  # noqa: PLC0415
    from normlift_ns.nerfstudio_plugin.panel import explanation_of_run  # noqa: PLC0415

    for prompts in ("up", "left"):
        ask(panel, prompts)
        press(panel._widgets.explain_button)
        assert not panel._widgets.explain_button.disabled
    assert str(panel._folder.parent) in said(panel) and "Traceback" not in said(panel)  # no run is there
    assert panel._widgets.reasons.content == ""
    how = {"source": SourceOptions(encoder="color"), "lift": LiftOptions(storage="evidence")}
    run = nl.lift_run(stock.config, **how, output_dir=tmp_path, timestamp="one")
    reasons = explanation_of_run(run.folder / "normlift", run.field)
    device = panel.state.space.means.device
    field, means = run.field.to(device), run.scene.gaussians.means.to(device)
    state = actions.select(State(SelectionContext(field, means)), field.scalars.weight > 0)
    reasons.compute(reasons.start(state), state)
    why = run.why(state.selection.cpu())
    assert why.words in html.unescape(reasons.content)
    panel._reasons = reasons
    panel._update_widgets()
    assert panel._widgets.reasons.content == reasons.content
    ask(panel, "left")  # another selection
    assert panel._widgets.reasons.content == ""


def test_the_button_shows_that_it_works_and_of_many_questions_the_last_is_answered(
    pipeline: Any, viewer: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    reading, go_on, loaded = Event(), Event(), []

    def slowly(prompts: Any) -> torch.Tensor:
        reading.set()
        assert go_on.wait(60)
        return encode(prompts)

    encoder_of = "normlift_ns.nerfstudio_plugin.panel.text_encoder_for"
    monkeypatch.setattr(encoder_of, lambda _, device, __: loaded.append(device) or SimpleNamespace(rows=slowly))
    panel, before = pipeline.model.normlift, chosen(pipeline)
    started, start = [], panel._turns.start
    monkeypatch.setattr(panel._turns, "start", lambda what: (start(what), started.append(what))[0])
    threads = []
    for number, prompts in enumerate(("banana", "right"), 1):
        panel._widgets.prompts.value = prompts
        threads.append(Thread(target=press, args=[panel._widgets.ask]))
        threads[-1].start()
        until(lambda number=number: len(started) == number)
    assert reading.wait(60)
    assert viewer.train_lock.acquire(timeout=10)  # as the viewer does to render
    viewer.train_lock.release()
    assert torch.equal(chosen(pipeline), before)
    assert panel._widgets.ask.disabled and panel._widgets.cancel.visible
    panel.act(Action("Threshold"), 0.6)  # the panel can be used, and still says what it waits for
    assert panel.answer.texts == ("left",) and "Reading the prompts" in said(panel)
    assert panel._widgets.prompts.value == "right"  # what is typed is nobody else's
    go_on.set()
    for thread in threads:
        thread.join(60)
    assert panel.answer.texts == ("right",) and "banana" not in said(panel)
    assert "Reading the prompts" not in said(panel)
    assert not panel._widgets.ask.disabled and not panel._widgets.cancel.visible
    assert loaded == [str(pipeline.model.device)]


def ray(pipeline: Any) -> SimpleNamespace:
    pose = pipeline.datamanager.train_dataset.cameras.camera_to_worlds[0]
    origin, forward = pose[:, 3] * 10, -pose[:, 2]
    return SimpleNamespace(ray_origin=tuple(origin.tolist()), ray_direction=tuple(forward.tolist()))


def test_a_click_asks_is_saved_and_asked_again(panel: Any, pipeline: Any) -> None:
    browser, event, field = Browser(), ray(pipeline), pipeline.model.field
    panel.act(Action("More like this"), client=browser)
    weights = pipeline.model.ray_weights(torch.tensor(event.ray_origin) / 10, torch.tensor(event.ray_direction))
    met = weights.where(field.valid(), 0.0).argmax()
    browser._scene_pointer_cb(SimpleNamespace(ray_origin=None, ray_direction=None))  # not on the scene
    browser._scene_pointer_cb(event)
    assert (browser._scene_pointer_cb, panel._widgets.prompts.value) == (None, "like click 1")
    clicked, threshold = chosen(pipeline), panel.answer.question.threshold
    asked = field.query(panel.state.query.embeddings)[:, 0]
    assert torch.equal(clicked, (asked > threshold) & field.valid()) and clicked.any()
    assert asked[met].item() == pytest.approx(1, abs=1e-3)
    panel.act(Action("Save prompts in run"))
    assert "one prompt" in said(panel)
    ask(panel, "left")
    assert panel.answer.question.threshold != threshold  # of the click
    pipeline.model.attach(field, load_query(pipeline.model.config.semantics))  # as after a restart
    assert panel._session.clicks == {}
    ask(panel, "left")
    ask(panel, "like click 1")
    assert torch.equal(chosen(pipeline), clicked)
    panel.act(Action("More like this"), client=browser)
    browser._scene_pointer_cb(event)
    assert panel.answer.texts == ("like click 2",)  # the saved one is not replaced


def test_an_armed_click_can_be_cancelled_and_is_not_used_up_elsewhere(panel: Any, pipeline: Any, viewer: Any) -> None:
    browser, other, event = Browser(1), Browser(2), ray(pipeline)
    for name, cancels in (("Cancel", True), ("Clear", True), ("Ask", True), ("Hide", False)):
        ask(panel, "left")
        panel.act(Action("More like this"), client=browser)
        assert panel._widgets.cancel.visible
        assert other._scene_pointer_cb is viewer.viser_server.scene._scene_pointer_cb is None
        armed = browser._scene_pointer_cb
        panel.act(Action(name), client=other)
        assert (browser._scene_pointer_cb is None) == cancels
        assert panel._widgets.cancel.visible != cancels
        before = chosen(pipeline)
        if cancels:
            armed(event)  # was on its way
            assert torch.equal(chosen(pipeline), before)
    for gone in (other, browser):
        panel.on_disconnect(gone)
        assert panel._clicks.armed == panel._widgets.cancel.visible == (gone is other)


def test_a_browser_that_goes_while_another_one_presses_stops_nobody(panel: Any, viewer: Any) -> None:
    """viser tells that it is gone under the lock that `get_clients` takes, which every picture needs."""
    browser = Browser(3)
    ask(panel, "left")
    panel.act(Action("More like this"), client=browser)
    going = Thread(target=viewer.viser_server._client_disconnect_cb[-1], args=[browser], daemon=True)
    with panel._lock:  # which the other one has, who waits for the lock of viser
        going.start()
        going.join(timeout=60)
        assert not going.is_alive()
    until(lambda: not panel._clicks.armed)


def test_a_browser_that_comes_or_goes_leaves_no_other_with_an_old_picture(panel: Any, viewer: Any, monkeypatch) -> None:
    drawn: list[Any] = []
    there = SimpleNamespace(action=lambda action: drawn.append(action.camera_state))
    monkeypatch.setattr(viewer, "ready", True)
    monkeypatch.setattr(viewer.viser_server, "get_clients", lambda: dict.fromkeys((4, 5, 6), Browser()))
    monkeypatch.setattr(viewer, "get_camera_state", lambda client: client)
    monkeypatch.setattr(viewer, "render_statemachines", {5: there})
    ask(panel, "left")
    drawn.clear()
    panel.act(Action("Hide"))
    assert len(drawn) == 1 and there.state == "low_move"  # it draws again, whatever becomes of the action


def test_nothing_saved_is_replaced_unasked(panel: Any, pipeline: Any) -> None:
    def stored() -> Any:
        return load_query(pipeline.model.config.semantics)

    replace = panel._widgets.replace
    for prompts, negatives in (("left", ""), ("right, left", ""), ("up", "left")):  # the last of another rule
        ask(panel, prompts, negatives)
        assert not replace.visible
        panel.act(Action("Save prompts in run"))
    assert stored().texts == ("left", "right") and replace.visible
    press(replace)
    assert (stored().texts, stored().negatives, stored().rule) == (("up",), ("left",), "lerf")
    assert not replace.visible


def test_a_panel_waits_for_a_field(pipeline: Any) -> None:
    panel, field = pipeline.model.normlift, pipeline.model.field
    panel.close()
    assert panel._widgets.ask.disabled
    assert "semantics yet" in said(panel)
    for name in ("Ask", "Hide", "Undo", "Clear", "Save prompts in run", "More like this"):
        panel.act(Action(name), client=Browser())
        assert "semantics yet" in said(panel), name
    pipeline.model.attach(field)
    assert not panel._widgets.ask.disabled
    assert said(panel).strip() == "No query."
