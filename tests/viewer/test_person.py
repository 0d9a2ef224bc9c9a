"""A person before a page that is not there: every widget does what it says, and pages are apart."""

import contextlib
import json
import threading
from collections.abc import Callable, Iterator
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from msgspec import structs

from normlift_ns.analysis.objects import find_floaters
from normlift_ns.io.run_dir import FIELD_FOLDER
from normlift_ns.query.question import load_query
from normlift_ns.viewer import person
from normlift_ns.viewer.person import People
from normlift_ns.viewer.shared import Run, View, read_link, write_link
from normlift_ns.viewer.widgets import Action
from tests.session.worlds import BLOCK, cubes, read, rows
from tests.viewer.scenes import run_of, until
from tests.viewer.test_reasons import FakeVotes


class Widget(contextlib.nullcontext):
    """A handle of viser's, without a browser."""

    enter_result = None

    def __init__(self, label: str, value: Any, **shown: Any) -> None:
        self.label, self._value, self.disabled, self.removed, self._told, self.order = label, value, False, False, [], 0
        self._impl = SimpleNamespace(value="")
        vars(self).update(shown)

    @property
    def value(self) -> Any:
        return self._value

    @value.setter
    def value(self, value: Any) -> None:
        self._value = value
        for tell in self._told:
            tell(SimpleNamespace(client=None))

    def on_update(self, tell: Callable[[Any], None]) -> None:
        self._told.append(tell)

    on_click = on_update

    def press(self, value: Any = True) -> None:
        self.value = value

    def remove(self) -> None:
        self.removed = True


class Gui:
    """All widgets of a page, by their labels."""

    def __init__(self) -> None:
        self.made: list[Any] = []

    def __getattr__(self, name: str) -> Callable[..., Widget]:
        def add(label: str, *rest: Any, **options: Any) -> Widget:
            first = 0 if name in ("add_text", "add_vector3") else 3 if name == "add_slider" else 1
            value = options.get("initial_value", rest[first] if len(rest) > first else None)
            choices = rest[0] if name in ("add_dropdown", "add_button_group") else ()
            limits, visible = rest if name == "add_slider" else (), options.get("visible", True)
            self.made.append(Widget(label, value, content=label, options=choices, range=limits, visible=visible))
            return self.made[-1]

        return add

    def __getitem__(self, label: str) -> Any:
        return next(w for w in self.made if w.label == label and not w.removed)

    def says(self) -> str:
        return "\n".join(w.content for w in self.made if w.visible and not w.removed)

    def rows(self) -> list[Any]:
        return [w for w in self.made if w.options == ("go to", "only", "hide", "export") and w.visible]


class FakePage:
    """A page that keeps what it is told."""

    token = link = ""
    drawn: Any = None
    box: Any = None
    clicked: Any = None
    gone = slow = False
    looks = 0
    together = contextlib.nullcontext

    def __init__(self, number: int) -> None:
        self.number, self.gui = number, Gui()
        self.camera = SimpleNamespace(
            position=np.zeros(3), look_at=np.ones(3), up_direction=np.array([0.0, 0, 1]), fov=1.0
        )
        self.files: dict[str, bytes] = {}
        self.download = self.files.__setitem__
        self.draw, self.outline, self.become, self.address, self.on_click = (
            partial(setattr, self, kept) for kept in ("drawn", "box", "token", "link", "clicked")
        )

    @property
    def behind(self) -> bool:
        self.looks += 1
        return self.slow

    def up(self, direction: np.ndarray) -> None: ...

    def listen(self) -> None: ...

    def click(self, origin: tuple, direction: tuple) -> None:
        """Clicks on the scene once that waits for it."""
        self.until(lambda: self.clicked is not None)
        self.clicked(origin, direction)

    def hello(self, token: str, link: str = "") -> None:
        self.press("Session", json.dumps({"token": token, "link": link}))

    def ask(self, line: str) -> None:
        self.press("Prompts", line)
        self.press("Ask")

    def until(self, true: Callable[[], Any]) -> None:
        until(true, self.gui.says)

    def says(self, text: str) -> None:
        self.until(lambda: text in self.gui.says())

    def selects(self, count: int) -> None:
        self.says(f"**{count}** of {4 * BLOCK} ")

    def asks(self, line: str, count: int) -> None:
        """Asks, and waits for an answer with so many selected."""
        self.ask(line)
        self.selects(count)

    def press(self, label: str, value: Any = True) -> None:
        self.gui[label].press(value)

    def drawings(self, kind: str) -> int:
        return self.gui.says().count(f"data:image/{kind}")

    def draws(self, count: int) -> None:
        self.until(lambda: self.drawn is not None and len(self.drawn) == count)


@pytest.fixture
def run(tmp_path) -> Run:
    return run_of(tmp_path, cubes())


@pytest.fixture
def crowd(run, monkeypatch) -> Iterator[People]:
    monkeypatch.setattr(person, "_FRAME", 0.01)
    people = People(run)
    yield people
    for number in list(people._here):
        people.go(number)


def opened(crowd: People, number: int = 0, token: str = "one", link: str = "") -> FakePage:
    page = FakePage(number)
    crowd.come(page)  # type: ignore[arg-type]
    page.hello(token, link)
    page.until(lambda: page.drawn is not None)
    return page


def ray(run: Run, gaussian: int) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """That of a click on a Gaussian, from above."""
    place = run.records.units.to_browser(run.space.means[gaussian].numpy())
    return tuple(place + np.array([0, 0, 5.0])), (0.0, 0.0, -1.0)


def test_a_page_begins_at_the_first_photograph_with_the_defaults_even_if_it_never_says_its_token(
    crowd, run, monkeypatch
):
    monkeypatch.setattr(person, "_PATIENCE", 0.01)
    crowd.come(page := FakePage(0))  # type: ignore[arg-type]
    page.draws(4 * BLOCK)
    assert {w.label: w.range for w in page.gui.made if w.range} == {
        "Threshold": (-0.2, 1.0, 0.005, 0.5), "Reliability": (0.0, 1.0, 0.01, 0.0), "Grow": (-10, 10, 1, 0),
    }  # fmt: skip
    np.testing.assert_allclose(run.records.units.to_scene(page.camera.position), [0, 0, 0], atol=1e-6)
    ahead = run.records.units.to_scene(page.camera.look_at)
    assert ahead[2] > 0 and ahead[:2] == pytest.approx([0, 0], abs=1e-6)
    assert page.camera.fov == pytest.approx(max(0.3, 2 * np.arctan(12 / 2 / 50)))
    np.testing.assert_array_equal(page.camera.up_direction, [0, -1, 0])


def test_everything_by_buttons(crowd):
    page = opened(crowd)
    page.draws(4 * BLOCK)
    page.asks("red, zebra; blue", 3 * BLOCK)
    assert "unknown" in page.gui.says()
    page.until(lambda: page.gui["Draw"].value == "overlay" and not page.gui["Ask"].disabled)
    page.press("Prompt", "1: red")
    page.selects(2 * BLOCK)
    page.press("Threshold", 0.9999)
    page.press("History", "Undo")
    page.press("History", "Redo")
    page.until(lambda: page.gui["Threshold"].value == 0.9999)
    page.asks("green", 0)
    page.press("Selection", "Only")
    page.says("Nothing is selected")
    assert len(page.drawn) == 4 * BLOCK
    page.press("Reliability", 1.0)
    page.press("History", "Clear")  # leaves no minimum behind
    page.until(lambda: page.gui["Reliability"].value == 0.0)
    page.press("Reliability", 1.0)  # before a question, which takes it over
    page.asks("blue", 0)
    page.press("Reliability", 0.0)
    page.selects(BLOCK)


def test_histograms_floaters_and_reasons_belong_to_what_is_selected(crowd, run):
    page = opened(crowd)
    page.asks("red, blue", 3 * BLOCK)
    page.until(lambda: page.drawings("svg") == 2)
    page.press("Prompt", "2: blue")
    page.until(lambda: page.drawings("svg") == 1)
    page.press("Suggested")
    page.until(lambda: page.gui["Threshold"].value == pytest.approx(0.6, abs=1e-6))
    page.press("History", "Clear")
    page.until(lambda: page.drawings("svg") == 0)

    page.asks("blue", BLOCK)
    page.press("Why?")
    page.says("without the photographs")
    object.__setattr__(run, "votes", FakeVotes)
    page.press("Why?")
    page.until(lambda: page.drawings("jpeg") == 3 and not page.gui["Why?"].disabled)
    vars(run)["floaters"] = rows(0, 3)
    page.press("Select likely floaters")
    page.selects(2 * BLOCK)
    page.until(lambda: page.drawings("jpeg") == 0)
    vars(run)["floaters"] = rows()
    page.press("Select likely floaters")
    page.says("no likely floaters")
    page.until(lambda: not page.gui["Ask"].disabled)
    del vars(run)["floaters"]
    assert torch.equal(run.floaters, find_floaters(run.scene.gaussians, run.space.field.scalars).mask)


def test_a_box_cuts_and_is_drawn(crowd, run):
    page = opened(crowd)
    page.press("Place", "Around")
    page.says("Nothing is selected")
    page.asks("red", 2 * BLOCK)
    page.press("Select")
    page.click(*ray(run, 5))
    page.selects(BLOCK)
    page.press("Place", "Around")
    page.until(lambda: page.box is not None)
    page.selects(BLOCK)
    page.until(lambda: page.gui["Size"].value == pytest.approx((3, 3, 3), rel=2e-3))
    assert page.gui["Centre"].value == pytest.approx((1.5, 1.5, 1.5))
    corners = run.records.units.to_scene(page.box)
    np.testing.assert_allclose(
        (corners.min(axis=0), corners.max(axis=0)), np.repeat([[0.0], [3]], 3, axis=1), atol=0.01
    )
    page.gui["Size"].value = (3.01, 3.01, 1.5)
    for side, count in (("Inside", BLOCK // 2), ("Outside", BLOCK // 2), ("None", BLOCK)):
        page.press("Place" if side == "None" else "Keep", side)
        page.until(lambda side=side: (page.box is None) == (side == "None"))
        page.selects(count)
    page.press("History", "Clear")
    page.says("Ask or Enter")


def test_clicks_are_armed_cancelled_and_asked_again(crowd, run):
    page = opened(crowd)
    place = ray(run, BLOCK + 5)
    page.press("Select")
    page.says("Click on")
    page.press("Cancel")
    page.until(lambda: page.clicked is None)
    page.press("Select")
    page.click(*place)
    page.selects(BLOCK)
    assert page.clicked is None
    page.says("object 1")
    page.press("More like this")
    page.click(*place)
    page.says("like click 1")
    page.selects(BLOCK)
    page.press("Save prompts in run")
    page.says("one prompt")
    page.press("Link")
    page.until(lambda: page.link != "")
    link = read_link(page.link)
    assert link is not None and link.clicks == {"like click 1": BLOCK + 7}  # the uppermost
    again = opened(crowd, 1, "another")
    again.until(lambda: again.gui["Prompts"].value == "like click 1")
    again.press("Ask")
    again.selects(BLOCK)


def test_objects_and_nearest_matches_have_buttons(crowd, run):
    page = opened(crowd)
    page.asks("red", 2 * BLOCK)
    page.until(lambda: len(page.gui.rows()) == 2)
    first, before = page.gui.rows()[0], page.camera.position
    first.press("go to")
    page.until(lambda: page.camera.position is not before)
    np.testing.assert_allclose(run.records.units.to_scene(page.camera.look_at), [1.5, 1.5, 1.5], atol=1e-6)
    assert not np.array_equal(page.camera.position, before)
    first.press("hide")
    page.draws(3 * BLOCK)
    page.until(lambda: len(page.gui.rows()) == 1)  # the other one moved up
    first.press("export")
    page.until(lambda: "red_1.ply" in page.files)
    assert page.files["red_1.ply"].startswith(b"ply") and b"vertex 64\n" in page.files["red_1.ply"]

    panel, place = crowd._here[0]._widgets, (1.0, 2.0, 3.0)
    panel.judge(
        "", [SimpleNamespace(text="zebra", nearest_position=place), SimpleNamespace(text="red", nearest_position=None)]
    )
    before = page.camera.position
    page.press("Go to nearest: zebra")
    page.until(lambda: page.camera.position is not before)
    np.testing.assert_allclose(run.records.units.to_scene(page.camera.look_at), place, atol=1e-6)
    panel.judge("", [])
    assert not any(w.label.startswith("Go to") and not w.removed for w in page.gui.made)


def test_every_page_has_its_own_question_and_gets_it_back(crowd, monkeypatch):
    one, two = opened(crowd), opened(crowd, 1, "two")
    one.asks("red", 2 * BLOCK)
    two.asks("blue", BLOCK)
    one.selects(2 * BLOCK)
    one.press("Selection", "Hide")
    one.draws(2 * BLOCK)
    one.camera.position = np.array([1.0, 2, 3])
    crowd.go(0)
    back = opened(crowd, 2)
    back.draws(2 * BLOCK)
    back.selects(2 * BLOCK)
    assert back.gui["Prompts"].value == "red"
    np.testing.assert_allclose(back.camera.position, [1, 2, 3])
    copy = opened(crowd, 3)  # the tab was duplicated
    assert copy.token not in ("", "one")
    copy.asks("blue", BLOCK)
    back.selects(2 * BLOCK)
    gone = FakePage(4)  # before its panel is made
    gone.gone = True
    crowd.come(gone)  # type: ignore[arg-type]
    assert sorted(crowd._here) == [1, 2, 3]
    monkeypatch.setattr("normlift_ns.viewer.person.MOST_KEPT", 1)
    for number in (3, 1):
        crowd.go(number)
    opened(crowd, 5, "another")
    assert copy.token in crowd._memories and "two" not in crowd._memories  # who came last is remembered


def test_a_link_carries_question_and_camera(crowd):
    page = opened(crowd)
    page.asks("red, blue", 3 * BLOCK)
    page.press("Threshold", 0.25)
    page.until(lambda: page.gui["Threshold"].value == 0.25)
    page.camera.position = np.array([1.0, 2, 3])
    page.press("Link")
    page.until(lambda: page.link != "")
    link = read_link(page.link)
    assert link is not None and (link.prompts, link.threshold, link.look) == ("red, blue", 0.25, "overlay")
    other = opened(crowd, 1, "two", page.link)
    other.selects(3 * BLOCK)
    np.testing.assert_allclose(other.camera.position, [1, 2, 3])
    other.until(lambda: other.gui["Threshold"].value == 0.25)
    broken = opened(crowd, 2, "three", page.link[:-7])
    broken.says("copy it again")
    nowhere = View((1, 2, 3), (1, 2, 3), (0, 0, 1), 1.0)
    blind = opened(crowd, 3, "four", write_link(structs.replace(link, view=nowhere)))
    blind.selects(3 * BLOCK)
    assert not np.array_equal(blind.camera.position, blind.camera.look_at)  # it stays where a page begins
    other_scene = opened(crowd, 4, "five", write_link(structs.replace(link, clicks={"like click 1": 4 * BLOCK})))
    other_scene.says(f"no Gaussian {4 * BLOCK}")


def test_a_slow_page_gets_the_last_picture_and_not_all_of_them(crowd):
    page = opened(crowd)
    page.asks("red", 2 * BLOCK)
    page.draws(4 * BLOCK)
    drawn, draw, state = [], page.draw, lambda: crowd._here[0].state
    page.draw = lambda buffer: drawn.append(len(buffer)) or draw(buffer)
    page.slow = True
    for deed in ("Hide", "Unhide", "Only"):
        page.press("Selection", deed)
    page.until(lambda: int(state().drawn.sum()) == 2 * BLOCK and "Only" in state().action)
    looks = page.looks
    page.until(lambda: page.looks > looks + 2)
    assert drawn == []
    page.slow = False
    page.draws(2 * BLOCK)
    assert len(drawn) <= 2


def test_a_held_key_goes_back_to_what_was_before_and_stops_no_question(crowd, run):
    page = opened(crowd)
    reading, go = threading.Event(), threading.Event()

    def slow(texts):
        reading.set()
        assert go.wait(60)
        return read(texts)

    def held(what: str) -> None:
        page.press("Session", json.dumps({"token": "one", "held": what}))

    object.__setattr__(run, "texts", lambda: SimpleNamespace(rows=slow))
    page.ask("red")
    assert reading.wait(60)
    held("Add")
    page.says("Click on objects")
    held("")
    page.until(lambda: page.clicked is None and "Click on" not in page.gui.says())
    assert page.gui["Ask"].disabled
    go.set()
    page.selects(2 * BLOCK)
    page.press("Select")
    page.says("Click on an object")
    held("Take away")
    page.says("Click on objects")
    held("")
    page.says("Click on an object")
    assert page.clicked is not None


def test_a_readonly_page_writes_nothing(crowd, run, monkeypatch):
    monkeypatch.setattr(crowd, "_run", Run(**{**vars(run), "readonly": True}))
    page = opened(crowd)
    assert not any(w.label == "Save prompts in run" for w in page.gui.made)
    page.asks("red", 2 * BLOCK)
    crowd._here[0].act(Action.SAVE)
    page.says("may only look")
    assert load_query(run.folder / FIELD_FOLDER) is None
    assert list((run.folder / FIELD_FOLDER).iterdir()) == []


def test_a_late_answer_is_dropped_and_what_fails_is_told(crowd, run):
    page = opened(crowd)
    for button in ("Save prompts in run", "Download selection"):
        page.press(button)
        page.says("there is nothing to ")

    cancelled = []

    def slow(texts):
        if "blue" in texts:
            page.press("Cancel")
            cancelled.append(texts)
        return read(texts)

    object.__setattr__(run, "texts", lambda: SimpleNamespace(rows=slow))
    page.asks("red", 2 * BLOCK)
    page.ask("blue")
    page.until(lambda: len(cancelled) > 0 and not page.gui["Ask"].disabled)
    question = crowd._here[0].state.query
    assert question is not None and question.texts == ("red",)

    def gone(_):
        raise FileNotFoundError("the weights are gone")

    object.__setattr__(run, "texts", lambda: SimpleNamespace(rows=gone))
    page.ask("green")
    page.says("the weights are gone")
    page.until(lambda: not page.gui["Ask"].disabled)
    page.press("Session", "no greeting")
    page.says("no greeting")
