"""One person before one page: what each widget does to their history, and what the page shows of it."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any, get_args

import torch

from normlift_ns.crash import explain
from normlift_ns.session import actions
from normlift_ns.session.found import FoundObject, found_objects
from normlift_ns.session.history import History
from normlift_ns.session.prompts import click_name, is_click, join_prompts, pose, read_prompts
from normlift_ns.session.state import State
from normlift_ns.session.turns import Turn, Turns
from normlift_ns.session.verdicts import carried, verdicts
from normlift_ns.session.viewpoint import Spot, clear_viewpoint
from normlift_ns.session.worker import Worker
from normlift_ns.viewer.adapter import Page
from normlift_ns.viewer.blind.stills import Stills
from normlift_ns.viewer.drawing import verdicts_mdx
from normlift_ns.viewer.eye import Eye
from normlift_ns.viewer.links import Link, link_of, read_hello, read_link, write_link
from normlift_ns.viewer.paint import Look, coloured
from normlift_ns.viewer.painter import Painter
from normlift_ns.viewer.panel import Panel
from normlift_ns.viewer.reasons import Reasons
from normlift_ns.viewer.rows import MOST_OBJECTS, OBJECT_DEEDS
from normlift_ns.viewer.shared import Memory, Run

LIKE = "More like this"
_MODES = {"Select": "select", "Add": "add", "Take away": "take away", LIKE: "like"}
_ONCE = ("Select", LIKE)
_SLIDERS = {"threshold": actions.threshold, "min_reliability": actions.min_reliability, "resize": actions.resize}
_DEEDS = {
    "Hide": actions.hide,
    "Only": actions.only,
    "Unhide": actions.show_all,
    "Suggested": actions.suggest,
    "Clear": actions.clear,
    "leave out": actions.leave_out_poor,
}
_PATIENCE = 3.0
"""Seconds to wait for the page's greeting before the scene is drawn without."""
_AROUND = 2.0
"""What is seen around a spot, in the units of a browser."""
_BLIND = "This browser has no WebGL 2 to draw the scene with; the pictures come from the server, and are slower."


class Person:
    """One page, with the memory of the person before it.

    Args:
        remember: the memory for a token and the number of a page, and the token that the page has from now on.
    """

    def __init__(self, run: Run, page: Page, remember: Callable[[str, int], tuple[Memory, str]]) -> None:
        self._run, self._page, self._remember = run, page, remember
        self._memory = Memory(History.of(State(run.space), lean=State.lean))
        self._lock, self._turns, self._eye = threading.RLock(), Turns(), Eye(page, run.records)
        self._reasons = Reasons(run.opened_votes)
        self._deeds, self._asking, self._explaining, self._resting = Worker(), Worker(), Worker(), Worker()
        self._message, self._mode, self._greeted = "", "", False
        self._held: str | None = None
        told = (lambda: self.state, self._drawn, self._rested, lambda error: self._tell(explain(error)[0]))
        self._painter = Painter(page, run.records, *told)
        with page.together():
            self._panel = Panel(page.gui, self._act, run.records.facts, readonly=run.readonly)
        self._eye.begin(run.scene.train.cameras)
        page.listen()
        waiting = threading.Timer(_PATIENCE, self._late)
        waiting.daemon = True
        waiting.start()

    @property
    def state(self) -> State:
        """What is shown now."""
        return self._memory.history.now

    def leave(self) -> None:
        """The page is gone."""
        with suppress(AssertionError):  # viser's, where no camera ever came
            self._memory.view = self._eye.view
        self._memory.line, self._memory.page = self._panel.prompts.value, None
        self._turns.cancel()
        self._reasons.forget()
        self._painter.end()
        for worker in (self._deeds, self._asking, self._explaining, self._resting):
            worker.end()

    def _act(self, name: str, value: Any) -> None:
        """What a widget does, after what was pressed before; returns at once."""
        if name == "Cancel":  # what waits is not wanted any more
            self._deeds.drop()
            self._turns.cancel()
            self._reasons.forget()
        key = name if name in _SLIDERS else ""
        self._deeds.put(lambda: self._told(lambda: self._deed(name, value)), key)

    def _told(self, work: Callable[[], None]) -> None:
        """Does something; whatever goes wrong is told in the panel."""
        try:
            work()
        except Exception as error:  # whatever it is: nothing may stop the viewer
            self._tell(explain(error)[0])

    def _deed(self, name: str, value: Any) -> None:
        if name == "hello":
            self._greet(value)
        elif name == "Ask":
            self._ask()
        elif name == "Select likely floaters":
            self._work("Looking for floaters.", self._select_floaters)
        elif name == "Why?":
            self._explain()
        else:
            with self._lock:
                self._do(name, value)

    def _do(self, name: str, value: Any) -> None:
        """What takes no time, and needs nothing but the state."""
        now, history = self.state, self._memory.history
        if name in _SLIDERS:
            self._show(history.do(_SLIDERS[name](now, value), key=name))
        elif name in _DEEDS:
            self._show(history.do(_DEEDS[name](now)))
            if name == "Clear":
                self._panel.forget()
        elif name in ("Undo", "Redo"):
            self._show(history.undo() if name == "Undo" else history.redo())
        elif name == "shown":
            self._show(history.do(actions.show(now, self._panel.place(value))))
        elif name == "look":
            self._show(history.do(actions.look(now, value)))
        elif name in ("Around", "Inside", "Outside", "None"):
            self._show(history.do(actions.cut(now, self._panel.box(name, now))))
        elif name in _MODES:
            self._arm(name)
        elif name == "nearest":
            self._go_to(Spot(value, _AROUND / self._run.records.units.factor))
        elif name in OBJECT_DEEDS:
            self._with_object(name, value)
        elif name == "Cancel":
            self._held = None
            self._arm("")
            self._panel.ask.disabled = False
            self._tell("")
        elif name == "Download selection":
            self._download(now.selection, now.name)
        elif name == "Save prompts in run":
            self._tell(self._run.save(now.question))
        elif name == "Link":
            self._memory.link = write_link(link_of(now, self._memory.clicks, self._eye.view))
            self._page.address(self._memory.link)
            self._tell("The address of this page holds question and camera now; copy it.")

    def _ask(self) -> None:
        """Asks what the box of prompts says."""
        line = self._panel.prompts.value
        what = "Reading the prompts. The first time, the text encoder is loaded."
        self._work(what, lambda turn: self._answer(turn, line))

    def _work(self, what: str, work: Callable[[Turn], None]) -> None:
        """Does what takes a while in a thread of its own, the last of what waits; the button to ask rests meanwhile."""
        turn = self._turns.start(what)
        self._panel.ask.disabled = True
        self._tell("")
        self._asking.put(lambda: self._told(lambda: self._take(turn, work)), "the last")

    def _take(self, turn: Turn, work: Callable[[Turn], None]) -> None:
        try:
            if self._turns.wanted(turn):
                work(turn)
        finally:
            if self._turns.finish(turn):  # it failed: an answer finishes its turn itself
                self._say()
            self._panel.ask.disabled = self._turns.busy != ""

    def _answer(self, turn: Turn, line: str, **how: Any) -> None:
        """Shows the answer to a line of prompts, unless it comes too late. Texts are read without the lock."""
        with self._lock:
            before, clicks, sure = self.state.question, dict(self._memory.clicks), self._panel.sure.value
        prompts = read_prompts(line, self._run.read, self._run.known(clicks))
        how = {"min_reliability": min(1.0, max(0.0, sure)) if before is None else before.min_reliability, **how}
        prompts, question = pose(self._run.space.field, prompts, self._run.read, **how)
        with self._lock:
            if not self._turns.finish(turn):
                return
            self._memory.line = line
            question = question if "threshold" in how else carried(self.state, question)
            self._show(self._memory.history.do(coloured(actions.ask(self.state, prompts, question))))

    def _select_floaters(self, turn: Turn) -> None:
        """Selects what likely floats, to look at and to hide."""
        with self._run.reading:
            found = self._run.floaters
        with self._lock:
            if self._turns.finish(turn):
                state = coloured(actions.select_floaters(self.state, found))
                self._show(
                    self._memory.history.do(state), f"{actions.LOOK_FIRST} Faint ones are drawn more opaque here."
                )

    def _explain(self) -> None:
        """Shows the photographs that voted for the selection."""
        turn = self._reasons.start(state := self.state)
        self._tell("")

        def find() -> None:
            try:
                self._reasons.find(turn, state)
            finally:
                self._say()

        self._explaining.put(lambda: self._told(find), "the last")

    def _arm(self, name: str) -> None:
        """What the next click on the scene does; an empty name: nothing."""
        self._mode = name
        self._page.on_click(self._clicked if name else None)
        if name:
            self._tell("Click on an object." if name in _ONCE else "Click on objects. Cancel or Escape ends it.")

    def _hold(self, name: str) -> None:
        """A key is held down that clicks go by, or let go: then they do what they did before."""
        with self._lock:
            if name:
                self._held = self._mode if self._held is None else self._held
                self._arm(name)
            elif self._held is not None:
                mode, self._held = self._held, None
                self._arm(mode)
                if not mode and self._message.startswith("Click on"):
                    self._tell("")

    def _clicked(self, origin: Sequence[float], direction: Sequence[float]) -> None:
        def hit() -> None:
            weights = self._run.weights(origin, direction)
            with self._lock:
                self._hit(self._mode, weights)

        self._deeds.put(lambda: self._told(hit))

    def _hit(self, name: str, weights: torch.Tensor) -> None:
        if name in _ONCE:
            self._arm("")
        if name == LIKE:
            gaussian, text = actions.met(self.state, weights), click_name(1 + len(self._memory.clicks))
            self._memory.clicks[text] = gaussian
            self._panel.prompts.value = text
            self._act("Ask", None)
        elif name:
            state = coloured(actions.click(self.state, weights, _MODES[name]))  # pyright: ignore[reportArgumentType]
            self._show(self._memory.history.do(state), "" if name in _ONCE else "Click on more objects, or Cancel.")

    def _with_object(self, deed: str, row: FoundObject) -> None:
        if deed == "go to":
            self._go_to(row)
        elif deed == "export":
            self._download(row.mask, row.name)
        else:
            act = actions.only if deed == "only" else actions.hide
            self._show(self._memory.history.do(act(self.state, row.mask)))

    def _go_to(self, what: FoundObject | Spot) -> None:
        eye, gaussians = self._eye.view, self._run.scene.gaussians
        place = clear_viewpoint(what, gaussians, self.state.drawn, eye.position, eye.up, eye.fov)
        self._eye.look(place, what.centre)

    def _download(self, mask: torch.Tensor, name: str) -> None:
        file, content, message = self._run.exported(mask, name, self.state.answer)
        self._page.download(file, content)
        self._tell(message)

    def _greet(self, text: str) -> None:
        """The page has told its token and its link: what was lost with the connection comes back."""
        hello = read_hello(text)
        with self._lock:
            if self._greeted:
                return self._hold(hello.held)
            self._greeted = True
            self._memory, token = self._remember(hello.token, self._page.number)
            if token != hello.token:
                self._page.become(token)
            memory = self._memory
            fresh = memory.view is None and len(memory.history.states) == 1
            if memory.line:
                self._panel.prompts.value = memory.line
            if memory.view is not None:
                self._eye.go(memory.view)
            if not hello.webgl:
                self._painter.stills = Stills(self._run, self._page, self._eye, lambda: self.state, self._tell)
            note = "" if hello.webgl else _BLIND
            self._show(memory.history, note)
        link = read_link(hello.link) if hello.link != memory.link else None
        memory.link = hello.link
        if link is not None:
            self._follow(link)
        elif fresh and len(texts := list(self._run.stored())) > 0:
            self._panel.prompts.value = join_prompts(texts)
            self._tell(f"The run stores these prompts; press Ask. {note}".rstrip())

    def _follow(self, link: Link) -> None:
        """Asks the question of a link, from its camera."""
        self._memory.clicks.update({name: n for name, n in link.clicks.items() if is_click(name)})
        if link.view is not None and link.view.looks:
            self._eye.go(link.view)
        if link.look in get_args(Look):
            self._show(self._memory.history.do(actions.look(self.state, link.look)))
        if not link.prompts:
            return
        self._panel.prompts.value = link.prompts
        how = {"min_reliability": link.min_reliability}
        how |= {} if link.threshold is None else {"threshold": link.threshold}
        self._work("Reading the prompts of the link.", lambda turn: self._answer(turn, link.prompts, **how))

    def _show(self, history: History[State], message: str = "") -> None:
        if history is not self._memory.history or message:  # else nothing is new, and what was told stays
            self._message = message
        self._memory.history = history
        self._painter.changed()

    def _tell(self, message: str) -> None:
        with self._lock:
            self._message = message
            self._say()

    def _say(self) -> None:
        state = self.state
        drawn = (state.selection & state.drawn).cpu().numpy()[self._run.records.rows]
        self._panel.say(state, self._message, self._turns.busy or self._reasons.busy, int(drawn.sum()))
        self._panel.explain(self._reasons.content, busy=self._reasons.busy != "")

    def _late(self) -> None:
        """Draws also where the page never told its token."""
        if not self._greeted:
            self._painter.changed()

    def _drawn(self, state: State) -> None:
        """A state was sent: the panel follows, unless there is a later one already."""
        with self._lock:
            if state is self.state:
                self._reasons.follow(state)
                self._panel.follow(state)
                self._say()

    def _rested(self, state: State) -> None:
        """Nothing has changed for a while: what takes longer follows, while the next state may be drawn already."""

        def follow() -> None:
            self._panel.rows.show(found_objects(state, most=MOST_OBJECTS))
            self._panel.judge(verdicts_mdx(state), verdicts(state))

        self._resting.put(lambda: self._told(follow), "the last")
