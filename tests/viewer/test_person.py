"""A person before a page that is not there: every widget does what it says, and pages are apart."""

from __future__ import annotations

import contextlib
import json
import threading
import time
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from msgspec import structs

from normlift_ns import Camera, GaussianScene
from normlift_ns.insight.floaters import find_floaters
from normlift_ns.runs.files import FIELD_FOLDER
from normlift_ns.runs.question import load_question
from normlift_ns.viewer.links import View, read_link, write_link
from normlift_ns.viewer.people import People
from normlift_ns.viewer.records import make_records
from normlift_ns.viewer.shared import Run
from tests.session.worlds import BLOCK, cubes, read, rows
from tests.viewer.test_reasons import FakeVotes


class Widget:
    """A handle of viser's, without a browser."""

    def __init__(self, label: str, value: Any) -> None:
        self.label, self._value, self.disabled, self.visible, self.content = label, value, False, True, ""
        self.options, self.removed, self._told, self.order = (), False, [], 0.0
        self._impl = SimpleNamespace(value="")

    @property
    def value(self) -> Any:
        return self._value

    @value.setter
    def value(self, value: Any) -> None:
        self._value = value
        for tell in self._told:
            tell(None)

    def on_update(self, tell: Callable[[Any], None]) -> None:
        self._told.append(tell)

    on_click = on_update

    def press(self, value: Any = True) -> None:
        self.value = value

    def remove(self) -> None:
        self.removed = True

    def __enter__(self) -> None: ...

    def __exit__(self, *_: object) -> None: ...


class Gui:
    """All widgets of a page, by their labels."""

    def __init__(self) -> None:
        self.made: list[Widget] = []

    def __getattr__(self, name: str) -> Callable[..., Widget]:
        def add(label: str, *rest: Any, **options: Any) -> Widget:
            first = 0 if name in ("add_text", "add_vector3") else 3 if name == "add_slider" else 1
            widget = Widget(label, options.get("initial_value", rest[first] if len(rest) > first else None))
            widget.options = rest[0] if name in ("add_dropdown", "add_button_group") else ()
            widget.content, widget.visible = label, options.get("visible", True)
            self.made.append(widget)
            return widget

        return add

    def __getitem__(self, label: str) -> Widget:
        return next(w for w in self.made if w.label == label and not w.removed)

    def says(self) -> str:
        return "\n".join(w.content for w in self.made if w.visible and not w.removed)

    def rows(self) -> list[Widget]:
        """The buttons of the found objects."""
        return [w for w in self.made if w.options == ("go to", "only", "hide", "export") and w.visible]


class FakePage:
    """A page that keeps what it is told."""

    def __init__(self, number: int) -> None:
        self.number, self.gui, self.clicked = number, Gui(), None
        self.camera = SimpleNamespace(
            position=np.zeros(3), look_at=np.ones(3), up_direction=np.array([0.0, 0, 1]), fov=1.0
        )
        self.drawn: np.ndarray | None = None
        self.files: dict[str, bytes] = {}
        self.token = self.link = ""
        self.box: np.ndarray | None = None
        self.gone = self.behind = False

    def together(self) -> Any:
        return contextlib.nullcontext()

    def draw(self, buffer: np.ndarray) -> None:
        self.drawn = buffer

    def outline(self, corners: np.ndarray | None) -> None:
        self.box = corners

    def up(self, direction: np.ndarray) -> None: ...

    def listen(self) -> None: ...

    def become(self, token: str) -> None:
        self.token = token

    def address(self, fragment: str) -> None:
        self.link = fragment

    def download(self, name: str, content: bytes) -> None:
        self.files[name] = content

    def on_click(self, clicked: Any) -> None:
        self.clicked = clicked

    def click(self, origin: tuple, direction: tuple) -> None:
        """Clicks on the scene once that waits for it."""
        self.until(lambda: self.clicked is not None)
        assert self.clicked is not None
        self.clicked(origin, direction)

    def hello(self, token: str, link: str = "") -> None:
        self.gui["Session"].press(json.dumps({"token": token, "link": link}))

    def ask(self, line: str) -> None:
        self.gui["Prompts"].value = line
        self.gui["Ask"].press()

    def until(self, true: Callable[[], bool]) -> None:
        deadline = time.monotonic() + 60
        while not true():
            assert time.monotonic() < deadline, self.gui.says()
            time.sleep(0.01)

    def says(self, text: str) -> None:
        self.until(lambda: text in self.gui.says())

    def draws(self, count: int) -> None:
        self.until(lambda: self.drawn is not None and len(self.drawn) == count)


@pytest.fixture
def run(tmp_path) -> Run:
    space = cubes()
    n = len(space)
    camera = Camera(torch.tensor([[50.0, 0, 8], [0, 50, 6], [0, 0, 1]]), torch.eye(4), 16, 12)
    gaussians = GaussianScene(
        space.means, torch.eye(4)[:1].expand(n, 4), torch.full((n, 3), 0.3), torch.full((n,), 0.9)
    )
    parameters = {
        "means": space.means, "quats": gaussians.quats, "scales": gaussians.scales.log(),
        "opacities": gaussians.opacities.logit()[:, None], "features_dc": torch.zeros(n, 3),
        "features_rest": torch.zeros(n, 0, 3),
    }  # fmt: skip
    scene: Any = SimpleNamespace(
        gaussians=gaussians, parameters=parameters, has_harmonics=True, rasterize_mode="classic",
        train=SimpleNamespace(cameras=[camera]),
    )  # fmt: skip
    (tmp_path / FIELD_FOLDER).mkdir()
    return Run(tmp_path, scene, space, make_records(scene), lambda: SimpleNamespace(rows=read))


@pytest.fixture
def crowd(run) -> Iterator[People]:
    people = People(run)
    yield people
    for number in list(people._here):
        people.go(number)


def opened(crowd: People, number: int, token: str, link: str = "") -> FakePage:
    page = FakePage(number)
    crowd.come(page)  # type: ignore[arg-type]
    page.hello(token, link)
    page.until(lambda: page.drawn is not None)
    return page


def test_everything_by_buttons(crowd, run):
    page = opened(crowd, 0, "one")
    page.draws(4 * BLOCK)
    page.ask("red, zebra; blue")
    page.says(f"**{3 * BLOCK}** of {4 * BLOCK} Gaussians selected")
    assert "unknown" in page.gui.says()
    page.until(lambda: page.gui["Draw"].value == "overlay")
    page.until(lambda: not page.gui["Ask"].disabled)
    page.gui["Prompt"].press("1: red")
    page.says(f"**{2 * BLOCK}** of")
    page.gui["Selection"].press("Hide")
    page.draws(2 * BLOCK)
    page.ask("blue")
    page.says(f"**{BLOCK}** of")
    page.gui["Selection"].press("Hide")
    page.draws(BLOCK)
    page.gui["Selection"].press("Only")
    page.draws(BLOCK)
    for count in (BLOCK, 2 * BLOCK, 2 * BLOCK, 4 * BLOCK):
        page.gui["History"].press("Undo")
        page.draws(count)
    page.gui["Threshold"].press(0.9999)
    page.until(lambda: page.gui["Threshold"].value == 0.9999)
    page.gui["History"].press("Redo")
    page.ask("green")
    page.says("**0** of")
    page.gui["Selection"].press("Only")
    page.says("The screen would be blank")
    assert page.drawn is not None
    page.ask("zebra")
    page.says("zebra")
    page.ask(" ; ")
    page.says("Type what to look for")


def test_the_histogram_and_the_suggested_threshold(crowd, run):
    page = opened(crowd, 0, "one")
    page.ask("red, blue")
    page.says(f"**{3 * BLOCK}** of")
    page.until(lambda: page.gui.says().count("data:image/svg+xml") == 2)
    page.gui["Prompt"].press("2: blue")
    page.until(lambda: page.gui.says().count("data:image/svg+xml") == 1)
    page.gui["Threshold"].press(0.9)
    page.gui["Suggested"].press()
    page.until(lambda: page.gui["Threshold"].value == pytest.approx(0.6, abs=1e-6))
    page.gui["History"].press("Undo")
    page.until(lambda: page.gui["Threshold"].value == 0.9)
    page.gui["History"].press("Clear")
    page.until(lambda: "data:image/svg+xml" not in page.gui.says())
    page.gui["Suggested"].press()
    page.says("no threshold to suggest")


def test_clear_leaves_no_minimum_reliability_behind(crowd, run):
    page = opened(crowd, 0, "one")
    page.gui["Reliability"].press(1.0)  # before the first question, which takes it over
    page.ask("blue")
    page.says("**0** of")
    page.gui["History"].press("Clear")
    page.until(lambda: page.gui["Reliability"].value == 0.0)
    page.ask("blue")
    page.says(f"**{BLOCK}** of")


def test_floaters_are_selected_hidden_and_brought_back(crowd, run):
    page = opened(crowd, 0, "one")
    page.ask("blue")
    page.says(f"**{BLOCK}** of")
    vars(run)["floaters"] = rows(0, 3)
    page.gui["Select likely floaters"].press()
    page.says("then press Hide")
    page.says(f"**{2 * BLOCK}** of")
    page.gui["Selection"].press("Hide")
    page.draws(2 * BLOCK)
    page.gui["History"].press("Undo")
    page.draws(4 * BLOCK)
    page.gui["History"].press("Undo")
    page.says(f"**{BLOCK}** of")
    vars(run)["floaters"] = rows()
    page.gui["Select likely floaters"].press()
    page.says("There are no likely floaters")
    page.until(lambda: not page.gui["Ask"].disabled)
    del vars(run)["floaters"]
    assert torch.equal(run.floaters, find_floaters(run.scene.gaussians, run.space.field.scalars).mask)


def test_why_is_told_and_belongs_to_the_selection(crowd, run):
    page = opened(crowd, 0, "one")
    page.ask("blue")
    page.says(f"**{BLOCK}** of")
    page.gui["Why?"].press()
    page.says("opened without the photographs")
    object.__setattr__(run, "votes", FakeVotes)
    page.gui["Why?"].press()
    page.says("These weigh most")
    assert page.gui.says().count("data:image/jpeg") == 3
    page.until(lambda: not page.gui["Why?"].disabled)
    page.gui["Selection"].press("Hide")
    page.draws(3 * BLOCK)
    assert "These weigh most" in page.gui.says()
    page.ask("red")
    page.until(lambda: "These weigh most" not in page.gui.says())
    page.ask("green")
    page.says("**0** of")
    page.gui["Why?"].press()
    page.says("nothing is selected")


def test_a_box_cuts_and_is_drawn(crowd, run):
    page = opened(crowd, 0, "one")
    page.ask("red")
    page.says(f"**{2 * BLOCK}** of")
    page.gui["Select"].press()
    place = run.records.units.to_browser(run.space.means[5].numpy())
    page.click(tuple(place + np.array([0, 0, 5.0])), (0.0, 0.0, -1.0))
    page.says(f"**{BLOCK}** of")
    page.gui["Place"].press("Around")
    page.until(lambda: page.box is not None)
    page.says(f"**{BLOCK}** of")
    page.until(lambda: page.gui["Size"].value == pytest.approx((3, 3, 3), rel=2e-3))
    page.gui["Size"].value = (3.01, 3.01, 1.5)
    page.gui["Keep"].press("Inside")
    page.says(f"**{BLOCK // 2}** of")
    page.gui["Place"].press("None")
    page.until(lambda: page.box is None)
    page.says(f"**{BLOCK}** of")
    page.gui["History"].press("Clear")
    page.says("Type what to look for")


def test_clicks_are_armed_cancelled_and_asked_again(crowd, run):
    page = opened(crowd, 0, "one")
    place = run.records.units.to_browser(run.space.means[BLOCK + 5].numpy())
    ray = (tuple(place + np.array([0, 0, 5.0])), (0.0, 0.0, -1.0))
    page.gui["Select"].press()
    page.says("Click on an object")
    page.gui["Cancel"].press()
    page.until(lambda: page.clicked is None)
    page.gui["Select"].press()
    page.click(*ray)
    page.says(f"**{BLOCK}** of")
    assert page.clicked is None
    page.says("selected by hand** object 1")
    page.gui["Take away"].press()
    page.click(*ray)
    page.says("Click on more objects")
    page.gui["Cancel"].press()
    page.gui["More like this"].press()
    page.click(*ray)
    page.says("like click 1")
    page.says(f"**{BLOCK}** of")
    page.gui["Save prompts in run"].press()
    page.says("stores one prompt")
    again = opened(crowd, 1, "another")
    again.until(lambda: again.gui["Prompts"].value == "like click 1")
    again.gui["Ask"].press()
    again.says(f"**{BLOCK}** of")
    again.ask("red")
    again.says(f"**{2 * BLOCK}** of")
    again.gui["Save prompts in run"].press()
    again.says("stores 2 prompts")
    stored = load_question(run.folder / FIELD_FOLDER)
    assert stored is not None
    assert stored.texts == ("like click 1", "red")


def test_objects_have_buttons(crowd, run):
    page = opened(crowd, 0, "one")
    page.ask("red")
    page.until(lambda: len(page.gui.rows()) == 2)
    first = page.gui.rows()[0]
    before = page.camera.position
    first.press("go to")
    page.until(lambda: page.camera.position is not before)
    np.testing.assert_allclose(run.records.units.to_scene(page.camera.look_at), [1.5, 1.5, 1.5], atol=1e-6)
    assert not np.array_equal(page.camera.position, before)
    first.press("hide")
    page.draws(3 * BLOCK)
    page.until(lambda: len(page.gui.rows()) == 1)  # the other one moved up
    first.press("export")
    page.until(lambda: "red_1.ply" in page.files)
    assert page.files["red_1.ply"].startswith(b"ply")
    first.press("only")
    page.draws(BLOCK)
    page.gui["Selection"].press("Unhide")
    page.draws(4 * BLOCK)


def test_every_page_has_its_own_question_and_gets_it_back(crowd):
    one, two = opened(crowd, 0, "one"), opened(crowd, 1, "two")
    one.ask("red")
    two.ask("blue")
    one.says(f"**{2 * BLOCK}** of")
    two.says(f"**{BLOCK}** of")
    one.gui["Selection"].press("Hide")
    one.draws(2 * BLOCK)
    one.camera.position = np.array([1.0, 2, 3])
    crowd.go(0)
    back = opened(crowd, 2, "one")
    back.draws(2 * BLOCK)
    back.says(f"**{2 * BLOCK}** of")
    assert back.gui["Prompts"].value == "red"
    np.testing.assert_allclose(back.camera.position, [1, 2, 3])
    back.gui["History"].press("Undo")
    back.draws(4 * BLOCK)
    copy = opened(crowd, 3, "one")  # the tab was duplicated
    assert copy.token not in ("", "one")
    copy.ask("blue")
    copy.says(f"**{BLOCK}** of")
    assert f"**{2 * BLOCK}** of" in back.gui.says()


def test_a_link_carries_question_and_camera(crowd, run):
    page = opened(crowd, 0, "one")
    page.ask("red, blue")
    page.says(f"**{3 * BLOCK}** of")
    page.gui["Threshold"].press(0.25)
    page.until(lambda: page.gui["Threshold"].value == 0.25)
    page.camera.position = np.array([1.0, 2, 3])
    page.gui["Link"].press()
    page.until(lambda: page.link != "")
    link = read_link(page.link)
    assert link is not None
    assert (link.prompts, link.threshold) == ("red, blue", 0.25)
    other = opened(crowd, 1, "two", page.link)
    other.says(f"**{3 * BLOCK}** of")
    np.testing.assert_allclose(other.camera.position, [1, 2, 3])
    other.until(lambda: other.gui["Threshold"].value == 0.25)
    broken = opened(crowd, 2, "three", page.link[:-7])
    broken.says("copy it again")
    nowhere = View((1, 2, 3), (1, 2, 3), (0, 0, 1), 1.0)
    blind = opened(crowd, 3, "four", write_link(structs.replace(link, view=nowhere)))
    blind.says(f"**{3 * BLOCK}** of")
    assert not np.array_equal(blind.camera.position, blind.camera.look_at)  # it stays where a page begins


def test_a_page_that_is_gone_before_its_panel_is_made_leaves_nothing(crowd):
    page = FakePage(0)
    page.gone = True
    crowd.come(page)
    assert crowd._here == {}


def test_a_slow_page_gets_the_last_picture_and_not_all_of_them(crowd):
    page = opened(crowd, 0, "one")
    page.ask("red")
    page.says(f"**{2 * BLOCK}** of")
    page.draws(4 * BLOCK)
    drawn, draw = [], page.draw
    page.draw = lambda buffer: drawn.append(len(buffer)) or draw(buffer)  # type: ignore[method-assign]
    page.behind = True
    page.gui["Selection"].press("Hide")
    page.gui["Selection"].press("Unhide")
    page.gui["Selection"].press("Only")
    time.sleep(0.3)
    assert drawn == []
    page.behind = False
    page.draws(2 * BLOCK)
    assert len(drawn) <= 2


def test_a_held_key_goes_back_to_what_was_before_and_stops_no_question(crowd, run):
    page = opened(crowd, 0, "one")
    reading, go = threading.Event(), threading.Event()

    def slow(texts):
        reading.set()
        assert go.wait(60)
        return read(texts)

    def held(what: str) -> None:
        page.gui["Session"].press(json.dumps({"token": "one", "held": what}))

    object.__setattr__(run, "texts", lambda: SimpleNamespace(rows=slow))
    page.ask("red")
    assert reading.wait(60)
    held("Add")
    page.says("Click on objects")
    held("")
    page.until(lambda: page.clicked is None and "Click on" not in page.gui.says())
    assert page.gui["Ask"].disabled
    go.set()
    page.says(f"**{2 * BLOCK}** of")
    page.gui["Select"].press()
    page.says("Click on an object&#46;")
    held("Take away")
    page.says("Click on objects")
    held("")
    page.says("Click on an object&#46;")
    assert page.clicked is not None


def test_the_nearest_match_of_what_is_not_there_is_gone_to(crowd, run):
    page = opened(crowd, 0, "one")
    person, place = crowd._here[0], (1.0, 2.0, 3.0)
    person._panel.judge("", [SimpleNamespace(text="zebra", nearest=place), SimpleNamespace(text="red", nearest=None)])
    before = page.camera.position
    page.gui["Go to nearest: zebra"].press()
    page.until(lambda: page.camera.position is not before)
    np.testing.assert_allclose(run.records.units.to_scene(page.camera.look_at), place, atol=1e-6)
    person._panel.judge("", [])
    assert not any(w.label.startswith("Go to") and not w.removed for w in page.gui.made)


def test_a_readonly_page_writes_nothing(crowd, run, monkeypatch):
    monkeypatch.setattr(crowd, "_run", Run(**{**vars(run), "readonly": True}))
    page = opened(crowd, 0, "one")
    assert not any(w.label == "Save prompts in run" for w in page.gui.made)
    page.ask("red")
    page.says(f"**{2 * BLOCK}** of")
    crowd._here[0]._act("Save prompts in run", None)
    page.says("may only look")
    assert load_question(run.folder / FIELD_FOLDER) is None
    page.gui["Download selection"].press()
    page.until(lambda: "red.ply" in page.files)
    assert list((run.folder / FIELD_FOLDER).iterdir()) == []


def test_a_late_answer_is_dropped_and_what_fails_is_told(crowd, run, monkeypatch):
    page = opened(crowd, 0, "one")
    person = crowd._here[0]

    def slow(texts):
        if "blue" in texts:
            page.gui["Cancel"].press()
        return read(texts)

    object.__setattr__(run, "texts", lambda: SimpleNamespace(rows=slow))
    page.ask("red")
    page.says(f"**{2 * BLOCK}** of")
    page.ask("blue")
    page.until(lambda: not page.gui["Ask"].disabled)
    assert person.state.question is not None
    assert person.state.question.texts == ("red",)

    def gone(_):
        raise FileNotFoundError("the weights are gone")

    object.__setattr__(run, "texts", lambda: SimpleNamespace(rows=gone))
    page.ask("green")
    page.says("the weights are gone")
    page.until(lambda: not page.gui["Ask"].disabled)
    page.gui["Session"].press("no greeting")
    page.says("no greeting")
