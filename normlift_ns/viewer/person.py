"""The camera of a page, in the scene's own units."""

from __future__ import annotations

import io
import secrets
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Sequence
from contextlib import nullcontext, suppress
from functools import partial
from typing import Any, get_args

import numpy as np
import torch
from jaxtyping import Bool, UInt8
from PIL import Image

from normlift_ns.core.gaussians import Camera, GaussianScene
from normlift_ns.errors import InputError, describe_error
from normlift_ns.options import WEAK_RELIABILITY
from normlift_ns.rasterization.rasterize import render
from normlift_ns.rendering.colors import clip_text
from normlift_ns.session import actions
from normlift_ns.session.actions import MAX_THRESHOLD, MIN_THRESHOLD, PromptDiagnostics, diagnose_prompts
from normlift_ns.session.objects import LookAtTarget, ObjectRow, list_objects, unoccluded_viewpoint
from normlift_ns.session.prompts import is_click, join_prompts
from normlift_ns.session.selection import SelectionBox
from normlift_ns.session.state import History, JobQueue, RequestToken, State
from normlift_ns.viewer.adapter import SESSION_LABEL, BrowserPage, add_button_group
from normlift_ns.viewer.controller import Controller
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
    ALL_PROMPTS,
    MAX_OBJECT_ROWS,
    SLIDERS,
    Act,
    Action,
    ActionWidgets,
    Explanation,
    ObjectRows,
    diagnostics_mdx,
    escape_mdx,
    prompt_rows,
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
    """Renderer of a page, which starts at the first call of `changed`.

    Args:
        state: what to draw.
        drawn: called with each state after it was sent.
        rested: called with the state again after a while without changes, for slower work.
        failed: called with each exception.
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
        """Request a new render."""
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


class Panel(ActionWidgets):
    """Widgets of one page.

    Args:
        gui: viser's `GuiApi` of the page.
        act: called with each action of the user; returns immediately.
        readonly: omit widgets that write to the server's disk.
    """

    def __init__(self, gui: Any, act: Act, facts: str, *, readonly: bool) -> None:
        super().__init__(gui, act, nullcontext())
        self.session = gui.add_text(SESSION_LABEL, "")
        self.session.on_update(lambda event: act(Action.GREET, self.session.value, event.client))
        self.prompts = gui.add_text("Prompts", "", hint="What to look for, separated by commas. Enter asks.")
        self.ask = self._button(Action.ASK)
        self.cancel = self._gray(Action.CANCEL, "Escape. Ends a question that runs, and clicks that wait.")
        self.status = gui.add_markdown("Type what to look for, then press Ask or Enter.")
        self._group("History", (Action.UNDO, Action.REDO, Action.CLEAR))
        choice = gui.add_dropdown("Prompt", (ALL_PROMPTS,), initial_value=ALL_PROMPTS, hint="Whose selection counts.")
        self.shown = self._input(Action.SHOW_PROMPT, choice)
        numbers = (MIN_THRESHOLD, MAX_THRESHOLD, 0.005, 0.5)
        self.threshold = self._slider(Action.THRESHOLD, numbers, "Relevancy above which to select.")
        self._gray(Action.SUGGESTED, "The threshold that the histogram suggests; it is the dashed line in it.")
        self.histograms = gui.add_markdown("")
        self._nearest: list[Any] = []
        numbers = (0.0, 1.0, 0.01, 0.0)
        self.reliability = self._slider(Action.RELIABILITY, numbers, "Minimum R of what is selected.", "Reliability")
        self.look = self._input(Action.COLORS, gui.add_dropdown("Draw", LOOKS, initial_value=LOOKS[0]))
        with gui.add_folder("Click in the scene"):
            self._gray(Action.SELECT, "Selects the connected object that you click.")
            self._gray(Action.ADD, "Adds objects that you click. Or hold Shift and click.")
            self._gray(Action.REMOVE, "Takes away objects that you click. Or hold Alt and click.", "Take away")
            self._gray(Action.LIKE, "Asks for everything like what you click.")
            self.steps = self._slider(Action.GROW, (-10, 10, 1, 0), "Grows or shrinks the selection, part to whole.")
        with gui.add_folder("Hide"):
            buttons = (Action.HIDE, Action.SHOW_ONLY, Action.SHOW_ALL)
            self._group("Selection", buttons, ("Hide", "Only", "Unhide"))
            self.remove_weak = self._button(Action.REMOVE_WEAK, "Leave out what is poorly evidenced")
            self.remove_weak.visible = False
            self._gray(Action.SELECT_FLOATERS, "Gaussians that belong to no surface. Look, then hide them.")
        with gui.add_folder("Why"):
            self.explain_button = self._gray(Action.EXPLAIN, "Shows the photographs that voted for the selection.")
            self.reasons = gui.add_markdown("")
        with gui.add_folder("Box", expand_by_default=False):
            for label, names in (("Place", ("Around", "None")), ("Keep", ("Inside", "Outside"))):
                add_button_group(gui, label, names, lambda name, event: act(Action.BOX, name, event.client))
            self.centre = gui.add_vector3("Centre", (0.0, 0.0, 0.0), step=0.01)
            self.size = gui.add_vector3("Size", (1.0, 1.0, 1.0), min=(0.0, 0.0, 0.0), step=0.01)
        self.rows = ObjectRows(gui, act)
        with gui.add_folder("Keep"):
            self._gray(Action.DOWNLOAD, "A PLY file of the selected Gaussians.")
            if not readonly:
                self._gray(Action.SAVE, "Beside those that the run stores already.")
            self._gray(Action.LINK, "Puts question and camera into the address of this page.")
        gui.add_markdown(escape_mdx(facts))

    def _gray(self, action: Action, hint: str, label: str = "") -> Any:
        return self._button(action, label, hint=hint, color="gray")

    def show_state(self, state: State) -> None:
        """Shows a state in all widgets but the prompts, which belong to the person who types."""
        super().show_state(state)
        self._set(Action.COLORS, self.look, state.color_mode)
        if state.box is not None:
            self.centre.value, self.size.value = state.box.center, state.box.size

    def judge(self, histograms: str, found: Sequence[PromptDiagnostics]) -> None:
        """Shows histograms as MDX, and a button to go to the nearest match of each prompt that is not found."""
        self.histograms.content = histograms
        for button in self._nearest:
            button.remove()
        self._nearest = []
        for i, one in enumerate(verdict for verdict in found if verdict.nearest_position is not None):
            label = f"Go to nearest: {clip_text(one.text, 20)}"
            place = self.histograms.order + (i + 1) / 100
            button = self._gui.add_button(label, color="gray", order=place)
            button.on_click(lambda _, one=one: self._act(Action.GO_TO, one.nearest_position, None))
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
        counts = zip(state.answer.texts, state.answer.selected.sum(dim=0).tolist())
        rows = prompt_rows(state.prompts, ["selected"], {text: [f"{count:,}"] for text, count in counts}, max_rows=20)
        lines.append("\n".join(rows))
    if state.warning:
        lines.append(escape_mdx(f"{state.warning} Below R = {WEAK_RELIABILITY:g} few views saw it, or they disagree."))
    return "\n\n".join([*lines, *filter(None, [legend(state)])])


# One person before one page: what each widget does to their history, and what the page shows of it.


_ONCE = (Action.SELECT, Action.LIKE)
_HELD = {"": None, "Add": Action.ADD, "Take away": Action.REMOVE}
"""What the page says of a key that is held down."""
_PATIENCE = 3.0
"""Seconds to wait for the page's greeting before the scene is drawn without."""
_AROUND = 2.0
"""What is seen around a spot, in the units of a browser."""
_BLIND = "This browser has no WebGL 2 to draw the scene with; the pictures come from the server, and are slower."


class Person(Controller):
    """One page, with the memory of the person before it.

    Args:
        remember: the memory for a token and the number of a page, and the token that the page has from now on.
    """

    reading_message = "Reading the prompts. The first time, the text encoder is loaded."
    floaters_message = f"{actions.FLOATERS_HINT} Faint ones are drawn more opaque here."
    _session: Memory
    _widgets: Panel

    def __init__(self, run: Run, page: BrowserPage, remember: Callable[[str, int], tuple[Memory, str]]) -> None:
        super().__init__(Memory(History.of(State(run.space), lean=State.without_caches)), Explanation(run.opened_votes))
        self._shared, self._page, self._remember = run, page, remember
        self._eye = Eye(page, run.records)
        self._deeds, self._resting = JobQueue(), JobQueue()
        self._slow = {Action.ASK: JobQueue(), Action.EXPLAIN: JobQueue()}
        self._mode: Action | None = None
        self._greeted = False
        self._held: tuple[Action | None] | None = None
        self._handlers |= {
            Action.GREET: lambda text, _: self._greet(text),
            Action.BOX: lambda name, _: self._do(actions.set_box(self.state, self._widgets.box(name, self.state))),
            Action.COLORS: lambda look, _: self._do(actions.set_color_mode(self.state, look)),
            Action.LINK: lambda *_: self._link(),
        }
        self._painter = Painter(page, run.records, lambda: self.state, self._drawn, self._rested, self._show_error)
        with page.together():
            self._widgets = Panel(page.gui, self.act, run.records.facts, readonly=run.readonly)
        self._eye.begin(run.scene.train.cameras)
        page.listen()
        waiting = threading.Timer(_PATIENCE, self._late)
        waiting.daemon = True
        waiting.start()

    @property
    def state(self) -> State:
        """What is shown now."""
        return self.history.now

    def leave(self) -> None:
        """The page is gone."""
        with suppress(AssertionError):  # viser's, where no camera ever came
            self._session.view = self._eye.view
        self._session.line, self._session.page = self._widgets.prompts.value, None
        self._discard()
        self._painter.end()
        for worker in (self._deeds, self._resting, *self._slow.values()):
            worker.close()

    def act(self, action: Action, value: Any = None, client: Any = None) -> None:
        """What a widget does, after what was pressed before; returns at once."""
        if action is Action.CANCEL:  # what waits is not wanted any more
            self._deeds.clear()
            self._discard()
        self._deeds.submit(partial(super().act, action, value, client), action.name if action in SLIDERS else "")

    def _do(self, state: State, message: str = "", *, key: str | None = None, answered: bool = False) -> None:
        super()._do(coloured(state) if answered else state, message, key=key, answered=answered)

    def _cancel(self) -> None:
        self._held = None
        self._arm(None)
        super()._cancel()

    def _clear(self) -> None:
        self._do(actions.clear(self.state))
        self._widgets.reset_reliability()

    def _link(self) -> None:
        self._session.link = write_link(link_of(self.state, self._session.clicks, self._eye.view))
        self._page.address(self._session.link)
        self.show_message("The address of this page holds question and camera now; copy it.")

    def _start(self, job: Callable[[], None], kind: Action) -> None:
        self._slow[kind].submit(job, "the last")

    def _finish(self, token: RequestToken, task: Callable[[RequestToken], None]) -> None:
        super()._finish(token, task)
        self._widgets.ask.disabled = self._turns.busy != ""

    def _encode(self, texts: Sequence[str]) -> Any:
        return self._shared.read(texts)

    def _known_vectors(self) -> dict[str, Any]:
        with self._lock:
            clicks = dict(self._session.clicks)
        return self._shared.known(clicks)

    def _query_settings(self) -> dict[str, Any]:
        before, sure = self.state.query, self._widgets.reliability.value
        return {"min_reliability": min(1.0, max(0.0, sure)) if before is None else before.min_reliability}

    def _find_floaters(self) -> Bool[torch.Tensor, " n"]:
        with self._shared.reading:
            return self._shared.floaters

    def _wait_for_click(self, action: Action, value: Any, client: Any) -> None:
        self._arm(action)

    def _arm(self, action: Action | None) -> None:
        """What the next click on the scene does; None: nothing."""
        self._mode = action
        self._page.on_click(None if action is None else self._clicked)
        if action is not None:
            once = action in _ONCE
            self.show_message("Click on an object." if once else "Click on objects. Cancel or Escape ends it.")

    def _hold(self, action: Action | None) -> None:
        """A key is held down that clicks go by, or let go: then they do what they did before."""
        with self._lock:
            if action is not None:
                self._held = (self._mode,) if self._held is None else self._held
                self._arm(action)
            elif self._held is not None:
                (mode,), self._held = self._held, None
                self._arm(mode)
                if mode is None and self._message.startswith("Click on"):
                    self.show_message("")

    def _clicked(self, origin: Sequence[float], direction: Sequence[float]) -> None:
        def hit() -> None:
            weights = self._shared.weights(origin, direction)
            with self._lock:
                mode = self._mode
                if mode in _ONCE:
                    self._arm(None)
                if mode is Action.LIKE:
                    self._ask_click(actions.pick_gaussian(self.state, weights), self._shared.stored())
                elif mode is not None:
                    self._click(mode, weights, "" if mode in _ONCE else "Click on more objects, or Cancel.")

        self._deeds.submit(lambda: self._guard(hit))

    def _move_camera(self, target: ObjectRow | tuple[float, float, float], client: Any) -> None:
        eye, gaussians, around = (
            self._eye.view,
            self._shared.scene.gaussians,
            _AROUND / self._shared.records.units.factor,
        )
        what = LookAtTarget(target, around) if isinstance(target, tuple) else target
        place = unoccluded_viewpoint(what, gaussians, self.state.drawn, eye.position, eye.up, eye.fov)
        self._eye.look(place, what.center)

    def _download(self, mask: torch.Tensor, name: str, client: Any) -> None:
        file, content, message = self._shared.exported(mask, name, self.state)
        self._page.download(file, content)
        self.show_message(message)

    def _save(self) -> None:
        self.show_message(self._shared.save(self.state.query))

    def _greet(self, text: str) -> None:
        """The page has told its token and its link: what was lost with the connection comes back."""
        hello = read_hello(text)
        with self._lock:
            if self._greeted:
                return self._hold(_HELD[hello.held])
            self._greeted = True
            self._session, token = self._remember(hello.token, self._page.number)
            if token != hello.token:
                self._page.become(token)
            memory = self._session
            fresh = memory.view is None and len(self.history.states) == 1
            typed = self._widgets.prompts.value  # before the server has read the greeting: it stays
            if memory.line and not typed:
                self._set_prompts(memory.line)
            if memory.view is not None:
                self._eye.go(memory.view)
            if not hello.webgl:
                shows = (self._page, self._eye, lambda: self.state, self.show_message)
                self._painter.stills = Stills(self._shared, *shows)
            note = "" if hello.webgl else _BLIND
            self._show(self.history, note)
        link = read_link(hello.link) if hello.link != memory.link else None
        memory.link = hello.link
        if link is not None:
            self._follow(link)
        elif fresh and not typed and len(texts := list(self._shared.stored())) > 0:
            self._widgets.prompts.value = join_prompts(texts)
            self.show_message(f"The run stores these prompts; press Ask. {note}".rstrip())

    def _follow(self, link: Link) -> None:
        """Asks the question of a link, from its camera."""
        self._session.clicks.update({name: n for name, n in link.clicks.items() if is_click(name)})
        if link.view is not None and link.view.looks:
            self._eye.go(link.view)
        if link.look in get_args(Look):
            self._do(actions.set_color_mode(self.state, link.look))
        if not link.prompts:
            return
        self._set_prompts(link.prompts)
        how = {"min_reliability": link.min_reliability, "threshold": link.threshold}
        self._run("Reading the prompts of the link.", partial(self._answer, line=link.prompts, **how))

    def _show(self, history: History[State], message: str = "", *, answered: bool = False) -> None:
        if history is not self.history or message:  # else nothing is new, and what was told stays
            self._message = message
        self._session.history = history
        self._painter.changed()

    def _update_widgets(self) -> None:
        state = self.state
        drawn = (state.selection & state.drawn).cpu().numpy()[self._shared.records.rows]
        self._widgets.show_busy(self._reasons, can_ask=self._turns.busy == "")
        busy = self._turns.busy or self._reasons.busy
        self._widgets.status.content = status(state, self._message, busy, int(drawn.sum()))

    def _late(self) -> None:
        """Draws also where the page never told its token."""
        if not self._greeted:
            self._painter.changed()

    def _drawn(self, state: State) -> None:
        """A state was sent: the panel follows, unless there is a later one already."""
        with self._lock:
            if state is self.state:
                self._reasons.update(state)
                self._widgets.show_state(state)
                self._update_widgets()

    def _rested(self, state: State) -> None:
        """Nothing has changed for a while: what takes longer follows, while the next state may be drawn already."""

        def follow() -> None:
            self._widgets.rows.show(list_objects(state, max_objects=MAX_OBJECT_ROWS))
            self._widgets.judge(diagnostics_mdx(state), diagnose_prompts(state))

        self._resting.submit(lambda: self._guard(follow), "the last")


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
