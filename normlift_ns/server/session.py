"""Session of one page: it applies the actions of the page in order, and sends messages to the page."""

from __future__ import annotations

import struct
from collections import OrderedDict, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Generic, Protocol, TypeVar

import anyio
import msgspec
import torch
from anyio import CapacityLimiter, Event, Lock, create_task_group
from anyio.abc import TaskGroup
from jaxtyping import Bool
from torch import Tensor

from normlift_ns.core.gaussians import Camera
from normlift_ns.errors import InputError, describe_error
from normlift_ns.query.question import join_prompts
from normlift_ns.server import protocol
from normlift_ns.server.describe import (
    MAX_OBJECTS,
    describe_hover,
    describe_state,
    explanation_of,
    object_json,
    region_mask,
)  # fmt: skip
from normlift_ns.server.permalink import Greeting, Link, PageView, link_of, read_link, write_link
from normlift_ns.server.runs import PageMemory, ServedRun, without_paths
from normlift_ns.session import actions
from normlift_ns.session.objects import LookAtTarget, ObjectRow
from normlift_ns.session.prompts import build_query, click_name, encode_prompts, is_click, not_understood
from normlift_ns.session.state import RequestTokens, State

_MAX_PENDING = 256
"""Maximum number of waiting actions; the server closes the connection of a page that sends more."""
_REST = 0.03
"""Seconds without a change after which the server computes objects and histograms."""
_GREETING_TIMEOUT = 20.0
_SPOT = 0.3
"""Extent of the region around a position to look at, as a multiple of the scene's radius."""
_SLIDERS = ("threshold", "reliability", "grow")
"""Actions of sliders. If successive actions of one slider are waiting, only the last is applied. Successive actions of
one slider are merged into one step of the history."""

T = TypeVar("T")


class Latest(Generic[T]):
    """Slot that holds the latest value until it is taken."""

    def __init__(self) -> None:
        self._values: list[T] = []
        self._event = Event()

    def put(self, value: T) -> None:
        """Replace the value."""
        self._values = [value]
        self._event.set()

    async def take(self) -> T:
        """Wait for a value, remove it from the slot, and return it."""
        while len(self._values) == 0:
            self._event = Event()
            await self._event.wait()
        return self._values.pop()

    @property
    def empty(self) -> bool:
        """True if the slot has no value."""
        return len(self._values) == 0


class PageSocket(Protocol):
    """Connection to a page."""

    async def receive_text(self) -> str:
        """Return the next text message; raise an exception when the connection ends."""
        ...

    async def send_text(self, data: str) -> None:
        """Send a text message."""
        ...

    async def send_bytes(self, data: bytes) -> None:
        """Send a binary message."""
        ...


@dataclass(frozen=True)
class PageLimits:
    """Limits on threads, shared by all pages, and functions of the server that sessions call."""

    quick: CapacityLimiter
    """Limit on threads for actions."""
    asking: CapacityLimiter
    """Limit on threads for queries; the first query loads the text encoder."""
    slow: CapacityLimiter
    """Limit on threads for explanations, exports and images."""
    may_write: Callable[[str], bool]
    """Function that returns True if a page with this access token may store prompts in a run."""
    offer: Callable[[str, bytes], str]
    """Function that stores a file for download and returns its URL path."""


@dataclass(frozen=True)
class _Pending:
    action: str
    value: Any
    seq: int


class PageSession:
    """Session of one page.

    Actions that change the state run one after another in a thread of `limits.quick`. Slow requests run concurrently
    with them. The result of a slow request is applied like an action, unless a newer request has made it stale.
    """

    def __init__(self, served: ServedRun, socket: PageSocket, limits: PageLimits) -> None:
        self._run, self._socket, self._limits = served, socket, limits
        self._pending: deque[_Pending] = deque()
        self._wake = Event()
        self._sending = Lock()
        self._dirty: Latest[int] = Latest()
        self._slots: dict[str, Latest[_Pending]] = {name: Latest() for name in ("hover", "still")}
        self._tokens, self._explaining = RequestTokens(), RequestTokens()
        self._objects: OrderedDict[int, ObjectRow] = OrderedDict()
        self._next_object = 1
        self._revision = 0
        self._read_only = True
        self._group: TaskGroup
        self._memory: PageMemory
        self._changes: dict[str, Callable[..., State]] = {
            "clear": actions.clear, "threshold": actions.set_threshold, "suggested": actions.use_suggested_threshold,
            "reliability": self._set_reliability, "show_prompt": actions.show_prompt, "grow": actions.resize,
            "color_mode": actions.set_color_mode, "invert": actions.invert, "show_all": actions.show_all,
            "remove_weak": actions.remove_weak, "pick": self._pick, "region": self._select_region,
            "brush": self._select_region, "object": self._select_object,
            "colormap": lambda state, name: replace(state, colormap=name, action=f"Colormap {name}"),
            "hide": lambda state, ids: actions.hide(state, self._mask_of(ids)),
            "isolate": lambda state, ids: actions.show_only(state, self._mask_of(ids)),
            "layer_add": lambda state, value: actions.add_layer(state, value.name),
            "layer_remove": lambda state, value: actions.remove_layer(state, value.name),
            "layer_visible": lambda state, value: actions.show_layer(state, value.name, visible=value.visible),
            "layer_select": lambda state, value: actions.select(
                state, actions.find_layer(state, value.name).mask, f"Select layer {value.name}"
            ),
        }  # fmt: skip
        self._slow: dict[str, Callable[[_Pending], Any]] = {
            "ask": self._ask, "negatives": self._ask, "rule": self._ask, "floaters": self._select_floaters,
            "explain": self._explain, "export": self._export, "go_to": self._go_to, "save_prompts": self._save,
        }  # fmt: skip

    @property
    def _state(self) -> State:
        return self._memory.history.now

    async def run(self) -> None:
        """Serve the page until its connection ends.

        Raises:
            ValueError: The first message is not a greeting.
            TimeoutError: The first message does not arrive in time.
        """
        with anyio.fail_after(_GREETING_TIMEOUT):
            first = protocol.read_message(await self._socket.receive_text())
        if first.action != "greet":
            raise InputError('The first message of a page must have the action "greet".')
        greeting = protocol.read_value(first)
        self._memory, token = self._run.remember(greeting.token, self)
        self._read_only = not self._limits.may_write(greeting.access)
        try:
            async with create_task_group() as self._group:
                await self._greet(greeting, token, first.seq)
                for task in (self._work, self._paint, self._hover_on, self._draw_stills):
                    self._group.start_soon(task)
                while len(self._pending) < _MAX_PENDING:
                    await self._receive(await self._socket.receive_text())
                self._group.cancel_scope.cancel()
        finally:
            self._memory.page = None

    # Incoming messages.

    async def _receive(self, text: str) -> None:
        message = protocol.Message("")
        try:
            message = protocol.read_message(text)
            pending = _Pending(message.action, protocol.read_value(message), message.seq)
        except InputError as error:
            await self._tell(str(error), "error", message.seq)
            return
        if pending.action in self._slots:
            self._slots[pending.action].put(pending)
        elif pending.action == "camera":
            self._memory.view = pending.value if pending.value.is_valid else self._memory.view
        elif pending.action == "cancel":
            self._pending.clear()
            self._tokens.cancel()
            self._explaining.cancel()
            await self._send(type="busy", text=None, seq=pending.seq)
        else:
            self._append(pending)

    def _append(self, pending: _Pending) -> None:
        if pending.action in _SLIDERS and self._pending and self._pending[-1].action == pending.action:
            self._pending.pop()
        self._pending.append(pending)
        self._wake.set()

    async def _work(self) -> None:
        while True:
            while self._pending:
                await self._do(self._pending.popleft())
            self._wake = Event()
            await self._wake.wait()

    async def _do(self, pending: _Pending) -> None:
        try:
            if pending.action in self._slow:
                await self._slow[pending.action](pending)
            elif pending.action in ("undo", "redo", "go_to_step"):
                self._step(pending)
            elif pending.action == "link":
                self._memory.link = write_link(link_of(self._state, self._memory.clicks, self._memory.view))
                await self._send(type="token", token="", link=self._memory.link, seq=pending.seq)
            elif pending.action == "pick" and pending.value.mode == "like":
                await self._ask_similar(pending)
            elif pending.action != "greet":
                await self._change(pending)
        except Exception as error:  # libraries may raise any exception, which must not end the session
            await self._tell(describe_error(error)[0], "error", pending.seq)

    def _step(self, pending: _Pending) -> None:
        history = self._memory.history
        steps = {"undo": history.undo, "redo": history.redo}
        history = steps[pending.action]() if pending.action in steps else history.go_to(pending.value)
        if history is not self._memory.history:
            self._memory.history = history
            self._memory.line = join_prompts([prompt.text for prompt in history.now.prompts])
        self._show(pending.seq)

    async def _change(self, pending: _Pending) -> None:
        """Apply an action that only changes the state."""
        change: Any = pending.value if callable(pending.value) else self._changes[pending.action]
        takes_value = not callable(pending.value) and protocol.VALUES[pending.action] is not Any
        arguments = (pending.value,) if takes_value else ()

        def compute() -> State:
            state = change(self._state, *arguments)
            _ = state.selection  # cached by the state, so that sending it is quick
            return state

        state = await self._in_thread(compute, self._limits.quick)
        if pending.action == "clear":
            self._memory.line, self._memory.min_reliability = "", 0.0
        key = pending.action if pending.action in _SLIDERS else None
        self._memory.history = self._memory.history.do(state, key=key)
        self._show(pending.seq)

    def _show(self, seq: int) -> None:
        self._revision += 1
        self._dirty.put(seq)

    async def _in_thread(self, work: Callable[[], T], limiter: CapacityLimiter) -> T:
        return await anyio.to_thread.run_sync(work, limiter=limiter, abandon_on_cancel=True)

    # Actions that only change the state.

    def _set_reliability(self, state: State, value: float) -> State:
        self._memory.min_reliability = value
        return actions.set_min_reliability(state, value)

    def _visible(self, state: State) -> State:
        """Return the state with a color mode that shows the selection."""
        return replace(state, color_mode="overlay") if state.color_mode == "rgb" else state

    def _pick(self, state: State, value: protocol.Pick) -> State:
        weights = self._run.weights(value.origin, value.direction)
        return self._visible(actions.click(state, weights, value.mode))  # pyrefly: ignore[bad-argument-type]

    def _select_object(self, state: State, value: protocol.ObjectAction) -> State:
        row = self._object(value.id)
        return self._visible(actions.change_objects(state, row.mask, value.mode, row.text))

    def _select_region(self, state: State, value: protocol.Region | protocol.Brush) -> State:
        mask = region_mask(self._run, state, value)
        return self._visible(actions.change_selection(state, mask, value.mode, "a region"))

    def _object(self, number: int) -> ObjectRow:
        if number not in self._objects:
            raise InputError("This object is no longer listed. Choose an object from the current list.")
        return self._objects[number]

    def _mask_of(self, ids: Sequence[int] | None) -> Bool[Tensor, " n"] | None:
        if ids is None:
            return None
        return torch.stack([self._object(number).mask for number in ids or [0]]).any(dim=0)

    # Slow requests.

    async def _ask(self, pending: _Pending) -> None:
        """Update prompts, negatives or rule from an action, and start the query of the prompts in the search box."""
        memory = self._memory
        if pending.action == "ask":
            memory.line = pending.value.line
            memory.negatives = memory.negatives if pending.value.negatives is None else tuple(pending.value.negatives)
        elif pending.action == "negatives":
            memory.negatives = None if pending.value is None else tuple(pending.value)
        else:
            memory.rule = pending.value
        if pending.action != "ask" and self._state.query is None:
            return self._show(pending.seq)
        return await self._ask_line(pending.seq)

    async def _ask_similar(self, pending: _Pending) -> None:
        """Start a query for all Gaussians similar to the clicked one."""
        memory = self._memory
        pick = partial(self._run.weights, pending.value.origin, pending.value.direction)
        gaussian = actions.pick_gaussian(self._state, await self._in_thread(pick, self._limits.quick))
        names = {*memory.clicks, *self._run.stored()}
        name = next(name for n in range(1, len(names) + 2) if (name := click_name(n)) not in names)
        memory.clicks[name], memory.line = gaussian, name
        await self._ask_line(pending.seq)

    async def _ask_line(self, seq: int, **settings: Any) -> None:
        memory, line = self._memory, self._memory.line
        negatives = memory.negatives
        options: dict[str, Any] = {
            "relevancy": memory.rule,
            "negatives": negatives,
            "min_reliability": memory.min_reliability,
            **settings,
        }

        def compute() -> tuple[Callable[[State], State], str]:
            known = self._run.known(memory.clicks)
            prompts = encode_prompts(line, self._run.read, known)
            message = not_understood(prompts)
            if message:
                return lambda state: actions.ask(state, prompts, None), message
            rows, query = build_query(self._run.space.field, prompts, self._run.read, **options)
            self._run.space.answer(query)  # the state gets this answer from the cache
            return lambda state: self._visible(actions.ask(state, rows, query)), ""

        await self._start("Searching …", compute, seq)

    async def _select_floaters(self, pending: _Pending) -> None:
        def compute() -> tuple[Callable[[State], State], str]:
            floaters = self._run.floaters
            return lambda state: self._visible(actions.select_floaters(state, floaters)), actions.FLOATERS_HINT

        await self._start("Finding likely floaters …", compute, pending.seq)

    async def _start(self, text: str, compute: Callable[[], tuple[Callable[[State], State], str]], seq: int) -> None:
        """Start a slow request. `compute` returns a function from the current state to the new one, and a message."""
        token = self._tokens.start(text)

        async def work() -> None:
            try:
                change, message = await self._in_thread(compute, self._limits.asking)
                if self._tokens.finish(token):
                    self._append(_Pending("apply", change, seq))
                    if message:
                        await self._tell(message, "info", seq)
            except Exception as error:
                if self._tokens.finish(token):
                    await self._tell(describe_error(error)[0], "error", seq)
                    self._show(seq)

        await self._send(type="busy", text=text, seq=seq)
        self._group.start_soon(work)

    async def _explain(self, pending: _Pending) -> None:
        state, token = self._state, self._explaining.start("Finding supporting images …")
        compute = partial(explanation_of, self._run, state)

        async def work() -> None:
            try:
                result = await self._in_thread(compute, self._limits.slow)
                if self._explaining.finish(token):
                    await self._send(type="explanation", seq=pending.seq, **result)
            except Exception as error:
                if self._explaining.finish(token):
                    await self._tell(describe_error(error)[0], "error", pending.seq)
            await self._send(type="busy", text=self._tokens.busy or None, seq=pending.seq)

        await self._send(type="busy", text=token.description, seq=pending.seq)
        self._group.start_soon(work)

    async def _export(self, pending: _Pending) -> None:
        state, value = self._state, pending.value
        row = None if value.object is None else self._object(value.object)
        mask, name = (state.selection, state.name) if row is None else (row.mask, row.name)
        if not bool(mask.any()):
            raise InputError("Nothing is selected, so there is nothing to export.")

        async def work() -> None:
            try:
                compute = partial(self._run.export, state, mask, name, value.format)
                file, content, text = await self._in_thread(compute, self._limits.slow)
                address = self._limits.offer(file, content)
                await self._send(type="download", name=file, url=address, text=text, seq=pending.seq)
            except Exception as error:
                await self._tell(describe_error(error)[0], "error", pending.seq)

        self._group.start_soon(work)

    async def _save(self, pending: _Pending) -> None:
        if self._read_only:
            raise InputError(
                "This page may not store prompts in the run: the server is read-only, or the page's address lacks the "
                "access token printed by the server."
            )
        replaces = pending.value is not None and pending.value.replace
        store = partial(self._run.save, self._state.query, replaces=replaces)
        count = await self._in_thread(store, self._limits.slow)
        await self._tell(f"The run now stores {count}.", "done", pending.seq)

    async def _go_to(self, pending: _Pending) -> None:
        """Move the camera to face an object or a position, with little occlusion if possible."""
        value = pending.value
        if value.id is None and value.position is None:
            raise InputError("The action go_to needs a position or the id of an object.")
        spot = LookAtTarget(value.position or (0.0, 0.0, 0.0), _SPOT * self._run.frame[2])
        target = spot if value.id is None else self._object(value.id)
        find = partial(self._run.view_of, target, self._memory.view, self._state.drawn)
        self._memory.view = await self._in_thread(find, self._limits.slow)
        await self._send_camera(self._memory.view, pending.seq)

    async def _send_camera(self, view: PageView, seq: int) -> None:
        place = {"position": view.position, "look_at": view.look_at, "up": view.up, "fov": view.fov}
        await self._send(type="camera", seq=seq, **place)

    # Outgoing messages.

    async def _greet(self, greeting: Greeting, token: str, seq: int) -> None:
        """Send the restored session to the page, and apply the link in its URL."""
        memory = self._memory
        fresh = memory.view is None and len(memory.history.states) == 1
        link = await self._follow(greeting, seq)
        stored = await self._in_thread(lambda: list(self._run.stored()), self._limits.slow)
        if fresh and len(stored) > 0 and (link is None or not link.prompts):
            memory.line = join_prompts(stored)
            await self._tell("This scene has saved prompts. Press Ask to search for them.", "info", seq)
        await self._send(type="token", token=token, link=memory.link, read_only=self._read_only, seq=seq)
        view = memory.view or await self._in_thread(lambda: self._run.first_view, self._limits.slow)
        if view is not None:
            await self._send_camera(view, seq)
        self._show(seq)
        if link is not None and link.prompts:
            memory.line, memory.min_reliability = link.prompts, link.min_reliability
            await self._ask_line(seq, threshold=link.threshold)

    async def _follow(self, greeting: Greeting, seq: int) -> Link | None:
        """Apply clicks, camera and color mode from the link in the page's URL, unless the page has already used it."""
        memory, link = self._memory, None
        try:
            link = read_link(greeting.link) if greeting.link != memory.link else None
        except InputError as error:
            await self._tell(str(error), "error", seq)
        memory.link = greeting.link
        if link is not None:
            memory.clicks |= {name: gaussian for name, gaussian in link.clicks.items() if is_click(name)}
            memory.view = link.view if link.view is not None and link.view.is_valid else memory.view
            if link.look in protocol.COLOR_MODES:
                memory.history = memory.history.do(actions.set_color_mode(self._state, link.look))
        return link

    async def _paint(self) -> None:
        """Send colors and state after each change, and details after a pause."""
        while True:
            seq = await self._dirty.take()
            try:
                state, revision = self._state, self._revision
                codes = await self._in_thread(partial(self._codes, state), self._limits.quick)
                header = {"type": "codes", "revision": revision, "seq": seq, "palette": codes.palette}
                await self._send_binary(header, codes.codes.tobytes())
                await self._send_state(state, revision, seq)
                await anyio.sleep(_REST)
                if self._dirty.empty:
                    await self._send_state(state, revision, seq, details=True)
            except Exception as error:
                await self._tell(describe_error(error)[0], "error", seq)

    async def _send_state(self, state: State, revision: int, seq: int, *, details: bool = False) -> None:
        memory, history = self._memory, self._memory.history
        describe = partial(describe_state, state, self._run.rows, details=details)
        content, objects = await self._in_thread(describe, self._limits.quick)
        if details:
            rows = range(self._next_object, self._next_object + len(objects))
            self._next_object += len(objects)
            self._objects.update(zip(rows, objects))
            while len(self._objects) > 2 * MAX_OBJECTS:
                self._objects.popitem(last=False)
            content["objects"] = [object_json(state, number, row) for number, row in zip(rows, objects)]
        content |= {
            "line": memory.line, "rule": memory.rule, "negatives": memory.negatives, "step": history.index,
            "history": [{"text": one.action or "Open"} for one in history.states], "busy": self._tokens.busy or None,
        }  # fmt: skip
        await self._send(type="state", revision=revision, seq=seq, **content)

    def _codes(self, state: State) -> protocol.Codes:
        return protocol.make_codes(state, self._run.rows, self._run.pca if state.color_mode == "pca" else None)

    async def _hover_on(self) -> None:
        while True:
            pending = await self._slots["hover"].take()
            try:
                describe = partial(describe_hover, self._run, self._state, pending.value, tuple(self._objects.items()))
                result = await self._in_thread(describe, self._limits.quick)
            except Exception:  # a hover must not show errors
                result = None
            empty = dict.fromkeys(("label", "relevancy", "reliability", "object", "position", "distance"))
            await self._send(type="hover", seq=pending.seq, **(result or empty))

    async def _draw_stills(self) -> None:
        while True:
            pending = await self._slots["still"].take()
            state, revision = self._state, self._revision
            try:
                view = self._memory.view or self._run.first_view
                if view is None:
                    raise InputError("The run has no training images, so the initial camera is unknown.")
                camera = view.camera(pending.value.max_size)
                draw = partial(self._still, state, camera, pending.value.background)
                jpeg = await self._in_thread(draw, self._limits.slow)
                await self._send_binary({"type": "still", "seq": pending.seq, "revision": revision}, jpeg)
            except Exception as error:
                await self._tell(describe_error(error)[0], "error", pending.seq)

    def _still(self, state: State, camera: Camera, background: Sequence[float]) -> bytes:
        return self._run.still(self._codes(state), camera, background)

    async def _tell(self, text: str, kind: str, seq: int) -> None:
        await self._send(type="message", text=without_paths(text), kind=kind, seq=seq)

    async def _send(self, **message: Any) -> None:
        async with self._sending:
            await self._socket.send_text(msgspec.json.encode(message).decode())

    async def _send_binary(self, header: dict[str, Any], payload: bytes) -> None:
        head = msgspec.json.encode(header)
        async with self._sending:
            await self._socket.send_bytes(struct.pack("<I", len(head)) + head + payload)
