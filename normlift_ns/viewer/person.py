"""The camera of a page, in the scene's own units."""

from __future__ import annotations

import io
import secrets
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import Any, get_args

import numpy as np
import torch
from jaxtyping import UInt8
from PIL import Image

from normlift_ns.core.gaussians import Camera, GaussianScene
from normlift_ns.errors import InputError, describe_error
from normlift_ns.options import WEAK_RELIABILITY
from normlift_ns.query.engine import Answer
from normlift_ns.rasterization.rasterize import render
from normlift_ns.rendering.colors import clip_text, prompt_rgb_tuples
from normlift_ns.session import actions
from normlift_ns.session.actions import (
    MAX_THRESHOLD,
    MIN_THRESHOLD,
    PromptDiagnostics,
    carry_threshold,
    diagnose_prompts,
)
from normlift_ns.session.objects import LookAtTarget, ObjectRow, list_objects, unoccluded_viewpoint
from normlift_ns.session.prompts import build_query, click_name, encode_prompts, is_click, join_prompts
from normlift_ns.session.selection import SelectionBox
from normlift_ns.session.state import History, JobQueue, RequestToken, RequestTokens, State
from normlift_ns.viewer.adapter import SESSION_LABEL, BrowserPage, add_button_group
from normlift_ns.viewer.shared import (
    LOOKS,
    Link,
    Look,
    Memory,
    Records,
    Run,
    View,
    coloured,
    legend,
    link_of,
    opacities,
    painted,
    read_hello,
    read_link,
    write_link,
)
from normlift_ns.viewer.widgets import (
    MAX_OBJECT_ROWS,
    OBJECT_ACTIONS,
    Explanation,
    ObjectRows,
    color_swatch,
    diagnostics_mdx,
    escape_mdx,
)

_FIELDS_OF_VIEW = (0.3, 1.9)


class Eye:
    """Where a page looks from."""

    def __init__(self, page: BrowserPage, records: Records) -> None:
        self._page, self._records, self._units = page, records, records.units

    @property
    def view(self) -> View:
        """Where it is now."""
        camera = self._page.camera
        places = (self.position, self._units.to_scene(camera.look_at), np.asarray(camera.up_direction, float))
        position, look_at, up = (tuple(map(float, place)) for place in places)
        return View(position, look_at, up, float(camera.fov))  # pyright: ignore[reportArgumentType]

    @property
    def position(self) -> np.ndarray:
        """Its place."""
        return self._units.to_scene(self._page.camera.position)

    @property
    def fov(self) -> float:
        """Its vertical field of view, in radians."""
        return float(self._page.camera.fov)

    def camera(self, pixels: int) -> Camera:
        """A camera that sees what the page does, in a picture of about so many pixels."""
        seen = self._page.camera
        aspect = float(np.clip(seen.aspect, 0.1, 10.0))
        height = max(1, round((pixels / aspect) ** 0.5))
        width = max(1, round(aspect * height))
        focal = height / 2 / np.tan(float(np.clip(seen.fov, 1e-3, 3.1)) / 2)
        K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], dtype=torch.float64)
        w, x, y, z = np.asarray(seen.wxyz, float) / np.linalg.norm(seen.wxyz)
        turn = np.array([
            [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
            [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
            [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)],
        ])  # fmt: skip
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = turn, -turn @ self.position
        return Camera(K.float(), torch.from_numpy(pose).float(), width, height)

    def go(self, view: View) -> None:
        """Goes where a link or a lost connection says."""
        with self._page.together():
            self._page.camera.fov = view.fov
            self._page.camera.up_direction = np.array(view.up)
            self.look(view.position, view.look_at)

    def look(self, place: Sequence[float] | np.ndarray, target: Sequence[float] | np.ndarray) -> None:
        """Goes to a place, and looks at another one."""
        with self._page.together():
            self._page.camera.position = self._units.to_browser(place)
            self._page.camera.look_at = self._units.to_browser(target)

    def begin(self, cameras: Sequence[Camera]) -> None:
        """Starts at the first photograph of the training, looking as far as the scene is away."""
        if len(cameras) == 0:
            return
        poses: list[Any] = [camera.world_to_camera.double().cpu().numpy() for camera in cameras]
        up = -np.mean([pose[1, :3] for pose in poses], axis=0)
        length = np.linalg.norm(up)
        up = up / length if length > 1e-6 else np.array([0.0, 0.0, 1.0])
        first = np.linalg.inv(poses[0])
        place, ahead = first[:3, 3], first[:3, 2]
        means = self._units.to_scene(self._records.table[::50, :3].copy().view(np.float32))
        depth = (means - place) @ ahead
        distance = float(np.median(depth[depth > 0])) if (depth > 0).any() else 1 / self._units.factor
        fov = 2 * np.arctan(cameras[0].height / 2 / float(cameras[0].K[1, 1]))
        self._page.up(up)
        view = (tuple(place), tuple(place + distance * ahead), tuple(up))
        self.go(View(*view, float(np.clip(fov, *_FIELDS_OF_VIEW))))  # pyright: ignore[reportArgumentType]


# Pictures from the server for a browser without WebGL, which cannot draw Gaussians itself.


_COARSE, _FINE = 160 * 120, 800 * 600
"""Pixels of a picture while the camera moves, and once it rests."""
_REST = 0.25
"""Seconds without a change after which the fine picture is drawn."""
_QUALITY = 85
"""Of the JPEG."""
_DRAWING = threading.Lock()
"""One picture at a time: each takes all cores, and some of numba's threads bear no second one."""


class Stills:
    """Draws what one page shows whenever it has changed: coarsely at once, and finely when it rests.

    Args:
        state: what is shown now.
        tell: shows a message in the panel.
    """

    def __init__(
        self, run: Run, page: BrowserPage, eye: Eye, state: Callable[[], State], tell: Callable[[str], None]
    ) -> None:
        self._run, self._page, self._eye, self._state, self._tell = run, page, eye, state, tell
        self._changed, self._gone = threading.Event(), False
        page.on_camera(self.change)
        threading.Thread(target=self._draw_on, daemon=True).start()

    def change(self) -> None:
        """The camera or the state is another one."""
        self._changed.set()

    def stop(self) -> None:
        """The page is gone."""
        self._gone = True
        self._changed.set()

    def _draw_on(self) -> None:
        while not self._gone:
            self._changed.wait()
            self._changed.clear()
            try:
                self._draw(_COARSE)
                if not self._changed.wait(_REST):
                    self._draw(_FINE)
            except Exception as error:  # whatever it is: the next picture may come out well
                if not self._gone:
                    self._tell(describe_error(error)[0])

    def _draw(self, pixels: int) -> None:
        if self._gone:
            return
        with io.BytesIO() as file:
            Image.fromarray(still(self._run, self._state(), self._eye.camera(pixels))).save(
                file, "JPEG", quality=_QUALITY
            )
            self._page.show_picture(file.getvalue())


def still(run: Run, state: State, camera: Camera) -> UInt8[np.ndarray, "h w 3"]:
    """The same Gaussians in the same colours as a browser with WebGL draws, on white."""
    colours, drawn = painted(run.records, state)
    device = run.scene.gaussians.means.device
    rows = torch.from_numpy(run.records.rows[drawn]).to(device)
    whole = run.scene.gaussians
    alpha = opacities(run.records, state)[drawn]
    opaque = whole.opacities[rows]
    if (alpha != run.records.alpha[drawn]).any():  # what is faint is to be seen
        opaque = torch.from_numpy(alpha).to(opaque) / 255
    part = GaussianScene(whole.means[rows], whole.quats[rows], whole.scales[rows], opaque)
    values = torch.from_numpy(colours[drawn]).to(device, part.means.dtype) / 255
    with _DRAWING:
        image, alpha = render(part, camera, values, rasterize_mode=run.scene.rasterize_mode)
    shown = image + (1 - alpha)[:, :, None]
    return (shown.clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()


# Draws for one page: the latest state, in a thread of its own, whenever it has changed.


_FRAME = 0.1
"""Seconds between two pictures that are sent, at least."""
_GLANCE = 0.02
"""Seconds after which to look again whether a page has taken what was sent."""


class Painter:
    """Begins to work when it is first told that something has `changed`.

    Args:
        state: what to draw.
        drawn: called with a state that was sent.
        rested: called with it again once nothing has changed for a while, for what takes longer.
        failed: called with whatever was raised.
    """

    def __init__(
        self,
        page: BrowserPage,
        records: Records,
        state: Callable[[], State],
        drawn: Callable[[State], None],
        rested: Callable[[State], None],
        failed: Callable[[Exception], None],
    ) -> None:
        self._page, self._records, self._state = page, records, state
        self._drawn, self._rested, self._failed = drawn, rested, failed
        self._changed, self._ended = threading.Event(), False
        self.stills: Stills | None = None
        """What draws in place of the browser, where that cannot."""
        threading.Thread(target=self._work, daemon=True).start()

    def changed(self) -> None:
        """There is something new to draw."""
        self._changed.set()

    def end(self) -> None:
        """Draws nothing any more."""
        self._ended = True
        self._changed.set()
        if self.stills is not None:
            self.stills.stop()

    def _work(self) -> None:
        while not self._ended:
            self._changed.wait()
            self._changed.clear()
            try:
                self._draw()
            except Exception as error:  # whatever it is: nothing may stop the viewer
                if not self._ended:
                    self._failed(error)

    def _draw(self) -> None:
        while self._page.behind and not self._ended:  # pictures for a slow page would come ever later
            time.sleep(_GLANCE)
        state = self._state()
        if self.stills is None:
            self._page.draw(self._records.buffer(*painted(self._records, state), opacities(self._records, state)))
        else:
            self.stills.change()
        corners = None if state.box is None else state.box.corners
        self._page.outline(None if corners is None else self._records.units.to_browser(corners))
        self._drawn(state)
        if not self._changed.wait(_FRAME) and not self._ended:
            self._rested(state)


# The widgets of a page, and how they look for a state. They know no field, and what they do is `person.Person`'s.


ALL = "all prompts"


class Panel:
    """The widgets of one page.

    Args:
        gui: viser's `GuiApi` of the page.
        act: called with the name of what was pressed or changed, and its value, in a thread of its own.
        readonly: without what writes to the disk of the server.
    """

    def __init__(self, gui: Any, act: Callable[[str, Any], None], facts: str, *, readonly: bool) -> None:
        self._gui, self._act = gui, act
        self._values: dict[str, Any] = {}
        self.session = gui.add_text(SESSION_LABEL, "")
        self.session.on_update(lambda _: act("hello", self.session.value))
        self.prompts = gui.add_text("Prompts", "", hint="What to look for, separated by commas. Enter asks.")
        self.ask = self._button("Ask")
        self.cancel = self._button("Cancel", "Escape. Ends a question that runs, and clicks that wait.", "gray")
        self.status = gui.add_markdown("Type what to look for, then press Ask or Enter.")
        self._group("History", ("Undo", "Redo", "Clear"))
        self.shown = self._input(
            "shown", gui.add_dropdown("Prompt", (ALL,), initial_value=ALL, hint="Whose selection counts.")
        )
        self.threshold = self._slider(
            "threshold", "Threshold", MIN_THRESHOLD, MAX_THRESHOLD, 0.005, 0.5, "Relevancy above which to select."
        )
        self._button("Suggested", "The threshold that the histogram suggests; it is the dashed line in it.", "gray")
        self.histograms = gui.add_markdown("")
        self._nearest: list[Any] = []
        self.sure = self._slider(
            "min_reliability", "Reliability", 0.0, 1.0, 0.01, 0.0, "Minimum R of what is selected."
        )
        self.look = self._input("look", gui.add_dropdown("Draw", LOOKS, initial_value=LOOKS[0]))
        with gui.add_folder("Click in the scene"):
            self._button("Select", "Selects the connected object that you click.", "gray")
            self._button("Add", "Adds objects that you click. Or hold Shift and click.", "gray")
            self._button("Take away", "Takes away objects that you click. Or hold Alt and click.", "gray")
            self._button("More like this", "Asks for everything like what you click.", "gray")
            self.steps = self._slider("resize", "Grow", -10, 10, 1, 0, "Grows or shrinks the selection, part to whole.")
        with gui.add_folder("Hide"):
            self._group("Selection", ("Hide", "Only", "Unhide"))
            self.poor = gui.add_button("Leave out what is poorly evidenced", visible=False)
            self.poor.on_click(lambda _: act("leave out", None))
            self._button("Select likely floaters", "Gaussians that belong to no surface. Look, then hide them.", "gray")
        with gui.add_folder("Why"):
            self.why = self._button("Why?", "Shows the photographs that voted for the selection.", "gray")
            self.reasons = gui.add_markdown("")
        with gui.add_folder("Box", expand_by_default=False):
            self._group("Place", ("Around", "None"))
            self._group("Keep", ("Inside", "Outside"))
            self.centre = gui.add_vector3("Centre", (0.0, 0.0, 0.0), step=0.01)
            self.size = gui.add_vector3("Size", (1.0, 1.0, 1.0), min=(0.0, 0.0, 0.0), step=0.01)
        self.rows = ObjectRows(gui, lambda deed, row, _: act(deed, row))
        with gui.add_folder("Keep"):
            self._button("Download selection", "A PLY file of the selected Gaussians.", "gray")
            if not readonly:
                self._button("Save prompts in run", "Beside those that the run stores already.", "gray")
            self._button("Link", "Puts question and camera into the address of this page.", "gray")
        gui.add_markdown(escape_mdx(facts))

    def _button(self, label: str, hint: str | None = None, color: Any = None) -> Any:
        button = self._gui.add_button(label, hint=hint, color=color)
        button.on_click(lambda _: self._act(label, None))
        return button

    def _group(self, label: str, options: Sequence[str]) -> None:
        add_button_group(self._gui, label, options, lambda name, _: self._act(name, None))

    def _slider(self, name: str, label: str, low: Any, high: Any, step: Any, value: Any, hint: str) -> Any:
        return self._input(name, self._gui.add_slider(label, low, high, step, value, hint=hint))

    def _input(self, name: str, widget: Any) -> Any:
        """A widget whose changes are told, but for those that the program made."""
        self._values[name] = widget.value

        def changed(_: Any) -> None:
            if widget.value != self._values[name]:
                self._values[name] = widget.value
                self._act(name, widget.value)

        widget.on_update(changed)
        return widget

    def set(self, name: str, widget: Any, value: Any) -> None:
        """Sets a widget without telling."""
        if widget.value != value:
            self._values[name] = value
            widget.value = value

    def forget(self) -> None:
        """Sets back what the next question would take over."""
        self.set("min_reliability", self.sure, 0.0)

    def follow(self, state: State) -> None:
        """Shows a state in all widgets but the prompts, which belong to the person who types."""
        texts = () if state.answer is None else state.answer.texts
        options = (ALL, *(f"{i + 1}: {clip_text(text, 30)}" for i, text in enumerate(texts)))
        if tuple(self.shown.options) != options:
            self._values["shown"] = ALL
            self.shown.options = options
        self.set("shown", self.shown, options[0 if state.shown is None else state.shown + 1])
        if state.query is not None:
            self.set("threshold", self.threshold, min(MAX_THRESHOLD, max(MIN_THRESHOLD, state.query.threshold)))
            self.set("min_reliability", self.sure, state.query.min_reliability)
        self.set("look", self.look, state.color_mode)
        self.set("resize", self.steps, state.grow_steps)
        if state.box is not None:
            self.centre.value, self.size.value = state.box.center, state.box.size
        self.poor.visible = state.warning != ""

    def place(self, value: str) -> int | None:
        """The prompt that a choice of the dropdown names."""
        return None if value == ALL else int(value.partition(":")[0]) - 1

    def say(self, state: State, message: str, busy: str, drawable: int) -> None:
        """Shows what is selected, and a message."""
        self.status.content = status(state, message, busy, drawable)

    def explain(self, reasons: str, *, busy: bool) -> None:
        """Shows why something is selected, as `reasons.Reasons` has it."""
        self.why.disabled = busy
        if self.reasons.content != reasons:
            self.reasons.content = reasons

    def judge(self, histograms: str, found: Sequence[PromptDiagnostics]) -> None:
        """Shows histograms as MDX, and a button to go to the nearest match of what is probably not in the scene."""
        self.histograms.content = histograms
        for button in self._nearest:
            button.remove()
        self._nearest = []
        for i, one in enumerate(verdict for verdict in found if verdict.nearest_position is not None):
            label = f"Go to nearest: {clip_text(one.text, 20)}"
            place = self.histograms.order + (i + 1) / 100
            button = self._gui.add_button(label, color="gray", order=place)
            button.on_click(lambda _, one=one: self._act("nearest", one.nearest_position))
            self._nearest.append(button)

    def box(self, name: str, state: State) -> SelectionBox | None:
        """The box of a button: around the selection, or where the panel has it; None: none.

        Raises:
            ValueError: there is nothing to put it around.
        """
        if name == "None":
            return None
        if name != "Around":
            return SelectionBox(tuple(self.centre.value), tuple(self.size.value), keeps_inside=name == "Inside")
        chosen = state.space.means[state.selection].double()
        if len(chosen) == 0:
            raise InputError("Nothing is selected; there is nothing to put a box around.")
        low, high = chosen.amin(dim=0), chosen.amax(dim=0)
        centre, size = ((low + high) / 2).tolist(), (1.001 * (high - low) + 1e-9).tolist()
        self.centre.value, self.size.value = tuple(centre), tuple(size)  # at once: Inside and Outside read them
        return SelectionBox(tuple(centre), tuple(size))


def status(state: State, message: str, busy: str, drawable: int) -> str:
    """As MDX: what runs, a message, how much is selected, each prompt with its number or its problem, and the legend.

    Args:
        drawable: selected Gaussians that are drawn at all.
    """
    lines = [f"**{escape_mdx(busy)}**"] * (busy != "") + [escape_mdx(clip_text(message, 400))] * (message != "")
    if state.query is None and not bool(state.selection.any()):
        return "\n\n".join(lines) or "Type what to look for, then press Ask or Enter."
    count = int(state.selection.sum())
    why = "" if drawable == count else f" ({drawable:,} of them are drawn: others are too faint, hidden or left out)"
    lines.append(f"**{count:,}** of {len(state.space):,} Gaussians selected{state.by_hand_suffix}{why}")
    if state.answer is not None:
        lines.append("\n".join(_rows(state, state.answer)))
    if state.warning:
        lines.append(escape_mdx(f"{state.warning} Below R = {WEAK_RELIABILITY:g} few views saw it, or they disagree."))
    return "\n\n".join([*lines, *filter(None, [legend(state)])])


def _rows(state: State, answer: Answer) -> list[str]:
    colours: Mapping[str, Any] = dict(zip(answer.texts, prompt_rgb_tuples(answer.texts)))
    counts = dict(zip(answer.texts, answer.selected.sum(dim=0).tolist()))
    lines = ["| | prompt | found |", "|---|---|---|"]
    for prompt in state.prompts[:20]:
        name = escape_mdx(clip_text(prompt.text, 40))
        if prompt.text in counts and not prompt.error:
            lines.append(f"| {color_swatch(colours[prompt.text])} | {name} | {counts[prompt.text]:,} |")
        else:
            lines.append(f"| ⚠ | {name} | {escape_mdx(clip_text(prompt.error, 120))} |")
    if len(state.prompts) > 20:
        lines.append(f"| | and {len(state.prompts) - 20} more | |")
    return lines


# One person before one page: what each widget does to their history, and what the page shows of it.


LIKE = "More like this"
_MODES = {"Select": "select", "Add": "add", "Take away": "take away", LIKE: "like"}
_ONCE = ("Select", LIKE)
_SLIDERS = {
    "threshold": actions.set_threshold,
    "min_reliability": actions.set_min_reliability,
    "resize": actions.resize,
}
_DEEDS = {
    "Hide": actions.hide,
    "Only": actions.show_only,
    "Unhide": actions.show_all,
    "Suggested": actions.use_suggested_threshold,
    "Clear": actions.clear,
    "leave out": actions.remove_weak,
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

    def __init__(self, run: Run, page: BrowserPage, remember: Callable[[str, int], tuple[Memory, str]]) -> None:
        self._run, self._page, self._remember = run, page, remember
        self._memory = Memory(History.of(State(run.space), lean=State.without_caches))
        self._lock, self._turns, self._eye = threading.RLock(), RequestTokens(), Eye(page, run.records)
        self._reasons = Explanation(run.opened_votes)
        self._deeds, self._asking, self._explaining, self._resting = JobQueue(), JobQueue(), JobQueue(), JobQueue()
        self._message, self._mode, self._greeted = "", "", False
        self._held: str | None = None
        told = (lambda: self.state, self._drawn, self._rested, lambda error: self._tell(describe_error(error)[0]))
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
        self._reasons.clear()
        self._painter.end()
        for worker in (self._deeds, self._asking, self._explaining, self._resting):
            worker.close()

    def _act(self, name: str, value: Any) -> None:
        """What a widget does, after what was pressed before; returns at once."""
        if name == "Cancel":  # what waits is not wanted any more
            self._deeds.clear()
            self._turns.cancel()
            self._reasons.clear()
        key = name if name in _SLIDERS else ""
        self._deeds.submit(lambda: self._told(lambda: self._deed(name, value)), key)

    def _told(self, work: Callable[[], None]) -> None:
        """Does something; whatever goes wrong is told in the panel."""
        try:
            work()
        except Exception as error:  # whatever it is: nothing may stop the viewer
            self._tell(describe_error(error)[0])

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
            self._show(history.do(actions.show_prompt(now, self._panel.place(value))))
        elif name == "look":
            self._show(history.do(actions.set_color_mode(now, value)))
        elif name in ("Around", "Inside", "Outside", "None"):
            self._show(history.do(actions.set_box(now, self._panel.box(name, now))))
        elif name in _MODES:
            self._arm(name)
        elif name == "nearest":
            self._go_to(LookAtTarget(value, _AROUND / self._run.records.units.factor))
        elif name in OBJECT_ACTIONS:
            self._with_object(name, value)
        elif name == "Cancel":
            self._held = None
            self._arm("")
            self._panel.ask.disabled = False
            self._tell("")
        elif name == "Download selection":
            self._download(now.selection, now.name)
        elif name == "Save prompts in run":
            self._tell(self._run.save(now.query))
        elif name == "Link":
            self._memory.link = write_link(link_of(now, self._memory.clicks, self._eye.view))
            self._page.address(self._memory.link)
            self._tell("The address of this page holds question and camera now; copy it.")

    def _ask(self) -> None:
        """Asks what the box of prompts says."""
        line = self._panel.prompts.value
        what = "Reading the prompts. The first time, the text encoder is loaded."
        self._work(what, lambda turn: self._answer(turn, line))

    def _work(self, what: str, work: Callable[[RequestToken], None]) -> None:
        """Does what takes a while in a thread of its own, the last of what waits; the button to ask rests meanwhile."""
        turn = self._turns.start(what)
        self._panel.ask.disabled = True
        self._tell("")
        self._asking.submit(lambda: self._told(lambda: self._take(turn, work)), "the last")

    def _take(self, turn: RequestToken, work: Callable[[RequestToken], None]) -> None:
        try:
            if self._turns.is_current(turn):
                work(turn)
        finally:
            if self._turns.finish(turn):  # it failed: an answer finishes its turn itself
                self._say()
            self._panel.ask.disabled = self._turns.busy != ""

    def _answer(self, turn: RequestToken, line: str, **how: Any) -> None:
        """Shows the answer to a line of prompts, unless it comes too late. Texts are read without the lock."""
        with self._lock:
            before, clicks, sure = self.state.query, dict(self._memory.clicks), self._panel.sure.value
        prompts = encode_prompts(line, self._run.read, self._run.known(clicks))
        how = {"min_reliability": min(1.0, max(0.0, sure)) if before is None else before.min_reliability, **how}
        prompts, question = build_query(self._run.space.field, prompts, self._run.read, **how)
        with self._lock:
            if not self._turns.finish(turn):
                return
            self._memory.line = line
            question = question if "threshold" in how else carry_threshold(self.state, question)
            self._show(self._memory.history.do(coloured(actions.ask(self.state, prompts, question))))

    def _select_floaters(self, turn: RequestToken) -> None:
        """Selects what likely floats, to look at and to hide."""
        with self._run.reading:
            found = self._run.floaters
        with self._lock:
            if self._turns.finish(turn):
                state = coloured(actions.select_floaters(self.state, found))
                self._show(
                    self._memory.history.do(state), f"{actions.FLOATERS_HINT} Faint ones are drawn more opaque here."
                )

    def _explain(self) -> None:
        """Shows the photographs that voted for the selection."""
        turn = self._reasons.start(state := self.state)
        self._tell("")

        def find() -> None:
            try:
                self._reasons.compute(turn, state)
            finally:
                self._say()

        self._explaining.submit(lambda: self._told(find), "the last")

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

        self._deeds.submit(lambda: self._told(hit))

    def _hit(self, name: str, weights: torch.Tensor) -> None:
        if name in _ONCE:
            self._arm("")
        if name == LIKE:
            gaussian, text = actions.pick_gaussian(self.state, weights), click_name(1 + len(self._memory.clicks))
            self._memory.clicks[text] = gaussian
            self._panel.prompts.value = text
            self._act("Ask", None)
        elif name:
            state = coloured(actions.click(self.state, weights, _MODES[name]))  # pyright: ignore[reportArgumentType]
            self._show(self._memory.history.do(state), "" if name in _ONCE else "Click on more objects, or Cancel.")

    def _with_object(self, deed: str, row: ObjectRow) -> None:
        if deed == "go to":
            self._go_to(row)
        elif deed == "export":
            self._download(row.mask, row.name)
        else:
            act = actions.show_only if deed == "only" else actions.hide
            self._show(self._memory.history.do(act(self.state, row.mask)))

    def _go_to(self, what: ObjectRow | LookAtTarget) -> None:
        eye, gaussians = self._eye.view, self._run.scene.gaussians
        place = unoccluded_viewpoint(what, gaussians, self.state.drawn, eye.position, eye.up, eye.fov)
        self._eye.look(place, what.center)

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
            typed = self._panel.prompts.value  # before the server has read the greeting: it stays
            if memory.line and not typed:
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
        elif fresh and not typed and len(texts := list(self._run.stored())) > 0:
            self._panel.prompts.value = join_prompts(texts)
            self._tell(f"The run stores these prompts; press Ask. {note}".rstrip())

    def _follow(self, link: Link) -> None:
        """Asks the question of a link, from its camera."""
        self._memory.clicks.update({name: n for name, n in link.clicks.items() if is_click(name)})
        if link.view is not None and link.view.looks:
            self._eye.go(link.view)
        if link.look in get_args(Look):
            self._show(self._memory.history.do(actions.set_color_mode(self.state, link.look)))
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
                self._reasons.update(state)
                self._panel.follow(state)
                self._say()

    def _rested(self, state: State) -> None:
        """Nothing has changed for a while: what takes longer follows, while the next state may be drawn already."""

        def follow() -> None:
            self._panel.rows.show(list_objects(state, max_objects=MAX_OBJECT_ROWS))
            self._panel.judge(diagnostics_mdx(state), diagnose_prompts(state))

        self._resting.submit(lambda: self._told(follow), "the last")


# Everyone who looks: a page each, and what is kept for those who come back.


MOST_KEPT = 64
"""Persons who are remembered after they have left."""


class People:
    """All pages of one server."""

    def __init__(self, run: Run) -> None:
        self._run, self._lock = run, threading.Lock()
        self._memories: OrderedDict[str, Memory] = OrderedDict()
        self._here: dict[int, Person] = {}
        self._left: set[int] = set()

    def come(self, page: BrowserPage) -> None:
        """Makes the panel of a page, in the thread that calls."""
        person = Person(self._run, page, self._remember)
        with self._lock:
            left = page.number in self._left or page.gone
            self._left.discard(page.number)
            if not left:
                self._here[page.number] = person
        if left:  # while the panel was made
            person.leave()

    def go(self, number: int) -> None:
        """Keeps what a page had that is gone."""
        with self._lock:
            person = self._here.pop(number, None)
            if person is None:
                self._left.add(number)
        if person is not None:
            person.leave()

    def _remember(self, token: str, page: int) -> tuple[Memory, str]:
        """The memory of a token; a page that shows it already, such as a duplicated tab, keeps it, and the new one
        gets a copy under a token of its own.
        """
        with self._lock:
            found = self._memories.get(token)
            if found is not None and found.page is not None and found.page in self._here:
                token, found = (
                    secrets.token_urlsafe(16),
                    Memory(found.history, found.line, dict(found.clicks), found.view, found.link),
                )
            if found is None:
                found = Memory(History.of(State(self._run.space), lean=State.without_caches))
            found.page = page
            self._memories[token] = found
            self._memories.move_to_end(token)
            for old in [name for name, memory in self._memories.items() if memory.page is None][:-MOST_KEPT]:
                del self._memories[old]
            return found, token
