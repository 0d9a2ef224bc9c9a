"""Adapter for viser: its server, pages, widgets, security headers, and pages without WebGL."""

from __future__ import annotations

import base64
import contextlib
import functools
import http
import inspect
import io
import json
import math
import re
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import Any
from urllib.parse import unquote

import numpy as np
from jaxtyping import Float, UInt32
from msgspec import MsgspecError

from normlift_ns.viewer.host_check import accepted_names, refuse_request

SCRIPT = """
(() => {
  const plain = HTMLCanvasElement.prototype.getContext;
  const probe = plain.call(document.createElement("canvas"), "webgl2");
  if (probe) {
    const extension = probe.getExtension("WEBGL_lose_context");
    if (extension) extension.loseContext();
    return;
  }
  window.normliftBlind = true;
  const numbers = {}, names = {};
  const number = (name) => {
    if (!(name in numbers)) {
      numbers[name] = 1 + Object.keys(numbers).length;
      names[numbers[name]] = name;
    }
    return numbers[name];
  };
  const parameter = (name) =>
    name === "VERSION" ? "WebGL 2.0" :
    name === "SHADING_LANGUAGE_VERSION" ? "WebGL GLSL ES 3.00" :
    ["VIEWPORT", "SCISSOR_BOX"].includes(name) ? new Int32Array(4) :
    name && name.startsWith("MAX_") ? 1024 : 0;
  const answers = {
    getParameter: (which) => parameter(names[which]),
    getExtension: () => null,
    getSupportedExtensions: () => [],
    getContextAttributes: () => ({}),
    getShaderPrecisionFormat: () => ({precision: 23, rangeMin: 127, rangeMax: 127}),
    getProgramParameter: (program, which) => (names[which] || "").startsWith("ACTIVE_") ? 0 : true,
    getShaderParameter: () => true,
    getProgramInfoLog: () => "",
    getShaderInfoLog: () => "",
    getShaderSource: () => "",
    getUniformLocation: () => null,
    getAttribLocation: () => -1,
    getError: () => 0,
    isContextLost: () => false,
    checkFramebufferStatus: () => number("FRAMEBUFFER_COMPLETE"),
    clientWaitSync: () => number("ALREADY_SIGNALED"),
  };
  const context = (canvas) => new Proxy({}, {get: (_, name) =>
    name === "canvas" ? canvas :
    name === "constructor" ? {name: "WebGL2RenderingContext"} :
    name === "drawingBufferWidth" ? canvas.width :
    name === "drawingBufferHeight" ? canvas.height :
    name === "drawingBufferColorSpace" ? "srgb" :
    typeof name !== "string" ? undefined :
    name in answers ? answers[name] :
    name === name.toUpperCase() ? number(name) :
    name.startsWith("create") || name === "fenceSync" ? () => ({}) : () => undefined});
  const kept = new WeakMap();
  HTMLCanvasElement.prototype.getContext = function (kind, ...rest) {
    if (kind !== "webgl2") return plain.call(this, kind, ...rest);
    if (!kept.has(this)) kept.set(this, context(this));
    return kept.get(this);
  };
})();
"""
"""Script for the head of the page. Without WebGL, three.js raises an error and React removes the whole page. The script
therefore supplies a context that draws nothing. Panel, camera and clicks then work, and the server sends renders.
"""

_PICTURE = """
(() => {
  const canvas = document.querySelector("canvas[data-engine]");
  if (!canvas) return;
  let shown = document.getElementById("normlift_still");
  if (!shown) {
    shown = document.createElement("img");
    shown.id = "normlift_still";
    shown.style.cssText = "position: absolute; inset: 0; width: 100%; height: 100%; pointer-events: none";
    canvas.parentElement.append(shown);
  }
  shown.src = "data:image/jpeg;base64,CONTENT";
})();
"""


def with_script(page: bytes) -> bytes:
    """Return the page with our script before all others, and without the script that reports visits to Google.

    >>> with_script(b"<html><head><title>")[:20]
    b'<html><head><script>'
    """
    page = re.sub(rb"<!-- Google tag.*?</script>.*?</script>", b"", page, count=1, flags=re.DOTALL)
    return page.replace(b"<head>", b"<head><script>" + SCRIPT.encode() + b"</script>", 1)


def picture_script(jpeg: bytes) -> str:
    """Return the script that shows an image in place of the scene."""
    return _PICTURE.replace("CONTENT", base64.b64encode(jpeg).decode())


_PLAIN_TEXT = {"Content-Type": "text/plain; charset=utf-8", "X-Content-Type-Options": "nosniff"}


@contextlib.contextmanager
def guarded(names: frozenset[str]) -> Iterator[None]:
    """Restrict viser servers that start in this context to requests for one of `names` and to the files of the page,
    which then contains our script for browsers without WebGL, and disable compression.

    Otherwise, 0.2.7 serves any file that a path with .. leads to, and spends seconds on compressing colors.
    """
    from viser.infra import _infra as known  # noqa: PLC0415

    _infra: Any = known
    if not hasattr(_infra, "WebSocketServerProtocol"):  # 1.x
        with _guarded_one(names):
            yield
        return
    module = _infra.websockets.server
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of websockets, whose older half viser calls
        serve = module.serve

    def guarded_serve(handler: Any, host: str, port: int, *, process_request: Any = None, **options: Any) -> Any:
        async def request(path: str, headers: Any) -> Any:
            refused = refuse_request(headers.get_all("Host"), headers.get_all("Origin"), names)
            if refused is not None:
                return http.HTTPStatus.FORBIDDEN, _PLAIN_TEXT, f"403: {refused}\n".encode()
            place = unquote(path.partition("?")[0])
            if headers.get("Upgrade") == "websocket":
                return await process_request(path, headers)
            if ".." in place.split("/") or not place.startswith("/"):
                return http.HTTPStatus.NOT_FOUND, {}, b"404"
            try:
                if place not in ("/", "/index.html"):
                    return await process_request(path, headers)
                status, told, content = await process_request(path, {})  # not compressed
            except (OSError, ValueError):  # such as a folder, or a name that is too long
                return http.HTTPStatus.NOT_FOUND, {}, b"404"
            return status, told, with_script(content)

        options["compression"] = None
        return serve(_closing_malformed(handler), host, port, process_request=request, **options)

    module.serve = guarded_serve
    try:
        yield
    finally:
        module.serve = serve


@contextlib.contextmanager
def _guarded_one(names: frozenset[str]) -> Iterator[None]:
    """Guard the file server of viser 1.x, which already rejects paths outside its folder and does not compress."""
    from viser.infra import _infra  # noqa: PLC0415

    one: Any = _infra
    module, Headers, Response = one.websockets.asyncio.server, one.Headers, one.Response
    serve: Any = module.serve
    missing = (http.HTTPStatus.NOT_FOUND, "Not Found", Headers({"Content-Length": "3"}), b"404")

    def guarded_serve(handler: Any, *address: Any, process_request: Any = None, **options: Any) -> Any:
        def request(connection: Any, asked: Any) -> Any:
            refused = refuse_request(asked.headers.get_all("Host"), asked.headers.get_all("Origin"), names)
            if refused is not None:
                content = f"403: {refused}\n".encode()
                headers = Headers({**_PLAIN_TEXT, "Content-Length": str(len(content))})
                return Response(http.HTTPStatus.FORBIDDEN, "Forbidden", headers, content)
            place = asked.path.partition("?")[0]
            if asked.headers.get("Upgrade") == "websocket":
                return process_request(connection, asked)
            if place.startswith("//"):
                return Response(*missing)
            is_page = place in ("/", "/index.html")
            if is_page:
                asked.headers.pop("Accept-Encoding", None)
            try:
                found = process_request(connection, asked)
            except (OSError, ValueError):  # such as a name that is too long
                return Response(*missing)
            if not is_page:
                return found
            content = with_script(found.body)
            headers = Headers({"Content-Type": "text/html", "Content-Length": str(len(content))})
            return Response(found.status_code, found.reason_phrase, headers, content)

        return serve(_closing_malformed(handler), *address, process_request=request, **options)

    module.serve = guarded_serve
    try:
        yield
    finally:
        module.serve = serve


def _closing_malformed(handler: Any) -> Any:
    """Let a malformed message close its connection, as a browser would; viser would forget to clean up after it."""
    from viser._messages import Message  # noqa: PLC0415

    @functools.wraps(handler)
    async def handle(connection: Any, *rest: Any) -> None:
        receive = connection.recv

        async def recv() -> Any:
            raw = await receive()
            try:
                Message.deserialize(raw)
            except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError, MsgspecError):
                await connection.close(1008)
                return await receive()  # raises viser's signal of a closed connection
            return raw

        connection.recv = recv
        await handler(connection, *rest)

    return handle


# Adapter for viser in its two versions: 0.2.7, which nerfstudio 1.1.5 pins, and 1.x.
#
# viser 0.2.7 draws Gaussians with a private helper that fails on thin ones: it adds 1e-7 to every entry of a
# covariance before the Cholesky decomposition. It also ignores Gaussians that are sent again under the same name.
# This module therefore builds the message itself, and uses a new name each time. 1.x has `add_gaussian_splats`
# instead, but cannot be installed together with nerfstudio 1.1.5; `make test-viser1` runs the tests of this module
# with it. Comments mark differences between the versions.


SESSION_LABEL = "Session"
"""Label of the hidden text box through which the page's script sends its token and its link to the server."""
_EDGES = (0, 1, 3, 2, 0, 4, 5, 1, 5, 7, 3, 7, 6, 2, 6, 4)
"""Corners of a box along a path that contains all edges."""
_MODIFIERS = (None, "shift", "alt")
"""Modifier keys with which a click is handled."""
_MAX_HOLDUP = 0.5
"""Maximum number of seconds that a message waits for the one before it."""
KEYS_SCRIPT = """
(() => {
  if (window.normlift) return;
  const labelOf = (text) => [...document.querySelectorAll("label")].find((l) => l.textContent === text);
  const rowOf = (text) => {
    let row = labelOf(text);
    while (row && !row.querySelector("input")) row = row.parentElement;
    return row;
  };
  const press = (text) => {
    const found = [...document.querySelectorAll("button")].find((b) => b.textContent.trim() === text);
    if (found && !found.disabled) found.click();
  };
  window.normlift = {rowOf, press};
  const style = document.createElement("style");
  style.textContent = `.mantine-Button-root[data-variant="outline"] { padding-inline: 2px; }
    .mantine-Flex-root > div:has(label:empty) { display: none; }`;
  document.head.append(style);
  const asks = (event) => ["Prompts", "Negatives"].some((text) => {
    const row = rowOf(text);
    return row && row.querySelector("input") === event.target;
  });
  addEventListener("keydown", (event) => {
    if (event.key === "Enter" && asks(event)) setTimeout(() => press("Ask"), 150);
    if (event.key === "Escape") press("Cancel");
  });
})();
"""
"""Script for the keys Enter and Escape, which viser 0.2.7 does not handle. It sends typed text at most every 50 ms."""
_SCRIPT = """
(() => {
  const {rowOf, press} = window.normlift;
  const send = (held = "") => {
    const row = rowOf("SESSION");
    if (!row) return setTimeout(send, 50);
    const box = row.querySelector("input");
    row.parentElement.style.display = "none";
    let token = sessionStorage.getItem("normlift");
    if (!token) {
      token = crypto.randomUUID ? crypto.randomUUID() : String(Math.random()).slice(2) + Date.now();
      sessionStorage.setItem("normlift", token);
    }
    const webgl = !window.normliftBlind;
    const query = new URLSearchParams(location.search).get("q");
    const value = JSON.stringify({token, link: query ? "q=" + query : "", webgl, held});
    Object.getOwnPropertyDescriptor(HTMLInputElement.prototype, "value").set.call(box, value);
    box.dispatchEvent(new Event("input", {bubbles: true}));
  };
  send();
  if (window.normlift.send) return;
  window.normlift.send = send;
  const style = document.createElement("style");
  style.textContent = ".mantine-ActionIcon-root:has(.tabler-icon-share) { display: none; }";
  document.head.append(style);
  const typing = (event) => ["INPUT", "TEXTAREA"].includes(event.target.tagName);
  const actions = {Shift: "Add", Alt: "Take away"};
  let held = "";
  const hold = (key, wait) => {
    held = key;
    setTimeout(() => { if (held === key) send(actions[key] || ""); }, wait);
  };
  addEventListener("keydown", (event) => {
    if (typing(event) || event.repeat) return;
    if (event.key in actions) hold(event.key, 0);
    if (event.key === "Alt") event.preventDefault();
    if ((event.ctrlKey || event.metaKey) && event.key.toLowerCase() === "z") press(event.shiftKey ? "Redo" : "Undo");
  });
  addEventListener("keyup", (event) => { if (held && event.key === held) hold("", 600); });
  addEventListener("blur", () => { if (held) hold("", 600); });
})();
""".replace("SESSION", SESSION_LABEL)


class ViserServer:
    """viser server with a page for each browser.

    Args:
        host: address to bind to.
        port: port to bind to.
        label: text above the panel of every page.
        on_page: called in a separate thread for every browser that connects or reconnects.
        on_gone: called with the number of the page when it is closed or its connection is lost.
        allowed_hosts: further names of this server, see `host_check.accepted_names`.
    """

    def __init__(
        self,
        host: str,
        port: int,
        label: str,
        on_page: Callable[[BrowserPage], None],
        on_gone: Callable[[int], None],
        allowed_hosts: Sequence[str] = (),
    ) -> None:
        import viser  # noqa: PLC0415 (--help should not wait for it)

        with (
            guarded(accepted_names(host, allowed_hosts)),
            contextlib.redirect_stdout(io.StringIO()),
        ):  # hides viser's table of addresses
            self._server = viser.ViserServer(host=host, port=port, label=label, verbose=False)
        handle_in_order(self._server)
        self.host, self.port = host, self._server.get_port()
        self._refuse_tunnels()
        gui: Any = self._server.gui
        if hasattr(gui, "main_panel"):  # 1.x
            gui.configure_theme(show_logo=False, show_share_button=False)
            gui.main_panel.dock_right()
        else:
            gui.configure_theme(control_layout="collapsible", show_logo=False)

        @self._server.on_client_connect
        def _(client: Any) -> None:  # viser holds a lock during this call
            threading.Thread(target=on_page, args=(BrowserPage(client),), daemon=True).start()

        @self._server.on_client_disconnect
        def _(client: Any) -> None:
            on_gone(client.client_id)

    def _refuse_tunnels(self) -> None:
        """Remove the handlers through which a page could make viser publish the server on the internet.

        The script hides the button. viser has an option for that, but with it, 0.2.7's page calls React hooks in a
        varying order and stays blank on a phone.
        """
        from viser import _messages  # noqa: PLC0415

        for name in ("ShareUrlRequest", "ShareUrlDisconnect"):
            message = getattr(_messages, name, None)
            with contextlib.suppress(KeyError, AssertionError, AttributeError):
                self._server._websock_server.unregister_handler(message)  # pyright: ignore[reportArgumentType]

    def label(self, text: str) -> None:
        """Set the text above the panel of every page."""
        self._server.gui.set_panel_label(text)

    def stop(self) -> None:
        """Stop the server, which closes all pages."""
        self._server.stop()


class BrowserPage:
    """Page in one browser, for the lifetime of its connection."""

    def __init__(self, client: Any) -> None:
        self._client = client
        if hasattr(client._websock_connection, "unsafe_send_message"):  # 0.2.7
            _send_in_order(client._websock_connection)
        else:
            _send_html(client._websock_connection)
        _ignore_invalid_values(client._websock_connection)
        self._buffer: Any = client._websock_connection._state.message_buffer
        self.number: int = client.client_id
        """Number of the connection."""
        self._splats: Any = None
        self._box: Any = None
        self._notice: Any = None
        self._count = 0

    @property
    def gui(self) -> Any:
        """viser's `GuiApi` for widgets of this page only."""
        return self._client.gui

    @property
    def camera(self) -> Any:
        """viser's camera of this page, in units of the viser scene."""
        return self._client.camera

    @property
    def gone(self) -> bool:
        """True if the connection is lost."""
        return self._buffer.done

    @property
    def behind(self) -> bool:
        """True if messages wait until the page has received earlier ones."""
        return len(self._buffer.message_from_id) > 0

    def together(self) -> Any:
        """Return a context whose messages take effect on the page at the same time."""
        return self._client.atomic()

    def notice(self, text: str) -> None:
        """Show a text in the panel in place of the previous one; an empty text removes it."""
        if self._notice is not None:
            self._notice.remove()
        self._notice = self._client.gui.add_markdown(text) if text else None

    def draw(self, buffer: UInt32[np.ndarray, "k 8"]) -> None:
        """Draw Gaussians in place of the previous ones."""
        with self.together():
            if self._splats is not None:
                self._splats.remove()
                self._splats = None
            if len(buffer) > 0:
                self._count += 1
                self._splats = self._add(f"/splats_{self._count}", buffer)
        self._client.flush()

    def outline(self, corners: Float[np.ndarray, "8 3"] | None) -> None:
        """Draw the edges of a box in place of the previous one; None: draw no box."""
        if self._box is not None:
            self._box.remove()
        self._box = None
        if corners is not None:
            add = self._client.scene.add_spline_catmull_rom
            old = "line_width" in inspect.signature(add).parameters  # 0.2.7
            width: dict[str, Any] = {"line_width": 4.0} if old else {"thickness": 4.0, "thickness_units": "screen"}
            straight = {"curve_type": "catmullrom", "tension": 0.0, "segments": 240}  # straight lines between corners
            path = np.asarray(corners, float)[list(_EDGES)]
            points = tuple(map(tuple, path.tolist())) if old else path
            self._box = add("/box", points, color=(255, 140, 0), **straight, **width)

    def _add(self, name: str, buffer: UInt32[np.ndarray, "k 8"]) -> Any:
        scene = self._client.scene
        if hasattr(scene, "add_gaussian_splats"):  # 1.x
            return scene.add_gaussian_splats(name, **_unpack_splats(buffer))
        from viser import GaussianSplatHandle, _messages  # noqa: PLC0415

        scene._websock_interface.queue_message(_messages.GaussianSplatsMessage(name=name, buffer=buffer))
        return GaussianSplatHandle._make(scene, name, (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), True)

    def on_camera(self, moved: Callable[[], None]) -> None:
        """Call a function whenever the user moves the camera or resizes the page."""
        self._client.camera.on_update(lambda _: moved())

    def show_picture(self, jpeg: bytes) -> None:
        """Show a JPEG image in place of the scene."""
        self._run(picture_script(jpeg))

    def up(self, direction: np.ndarray) -> None:
        """Set the up direction around which the camera orbits."""
        self._client.scene.set_up_direction(direction)

    def listen(self) -> None:
        """Run the script that handles keys; it writes the token, link and held key into the box `SESSION_LABEL`."""
        self._run(KEYS_SCRIPT + _SCRIPT)

    def become(self, token: str) -> None:
        """Set the session token of the page."""
        self._run(f'sessionStorage.setItem("normlift", {json.dumps(token)});')

    def address(self, query: str) -> None:
        """Set the query of the URL in the address bar, and copy the URL to the clipboard if the browser allows it.

        The link is a query, because viser parses a fragment as part of the server's name.
        """
        self._run(
            f'history.replaceState(null, "", "?" + {json.dumps(query)});'
            "if (navigator.clipboard) navigator.clipboard.writeText(location.href).catch(() => {});"
        )

    def _run(self, script: str) -> None:
        from viser import _messages  # noqa: PLC0415

        self._client._websock_connection.queue_message(_messages.RunJavascriptMessage(source=script))

    def download(self, name: str, content: bytes) -> None:
        """Send a file to the browser's downloads."""
        self._client.send_file_download(name, content)

    def on_click(self, clicked: Callable[[tuple[float, ...], tuple[float, ...]], None] | None) -> None:
        """Set the callback for clicks on the scene, called with origin and direction of the ray; None: remove it."""
        scene = self._client.scene
        viser1 = hasattr(scene, "on_click")  # 1.x, where callbacks are registered per modifier key
        if viser1:
            scene.remove_click_callback()
        elif clicked is None and scene._scene_pointer_cb is not None:
            scene.remove_pointer_callback()
        if clicked is None:
            return
        callback = clicked
        events = [scene.on_click(modifier=key) for key in _MODIFIERS] if viser1 else [scene.on_pointer_event("click")]
        for register in events:
            register(lambda event: callback(event.ray_origin, event.ray_direction))


def handle_in_order(server: Any) -> None:
    """Make a server handle messages in the order in which they come.

    viser 0.2.7 passes each message to one of 32 threads. On a busy machine, the press of a button therefore overtakes
    the text typed before it, and one of two quick presses is lost. With this function, a message waits until the one
    before it is handled, but only for a moment if that is slow.

    Args:
        server: viser's server.
    """
    owner = server._websock_server
    executor: Any = (owner if hasattr(owner, "_thread_executor") else server)._thread_executor  # 0.2.7 and 1.x
    submit, lock, last = executor.submit, threading.Lock(), [threading.Event()]
    last[0].set()

    def submit_in_order(work: Callable[..., Any], *arguments: Any) -> Any:
        done = threading.Event()

        def run(before: threading.Event) -> Any:
            before.wait(_MAX_HOLDUP)
            try:
                return work(*arguments)
            finally:
                done.set()

        with lock:
            before, last[0] = last[0], done
            return submit(run, before)

    executor.submit = submit_in_order


def send_in_order(server: Any) -> None:
    """Make a server send all messages in order, as `BrowserPage` does for its own.

    Args:
        server: viser's server, 0.2.7.
    """
    _send_in_order(server._websock_server)
    server.on_client_connect(lambda client: _send_in_order(client._websock_connection))


def _send_in_order(connection: Any) -> None:
    """Make a connection send its messages in order, and those within `Page.together` in one go.

    viser 0.2.7 passes each message created within its `atomic` to one of 32 threads that serve all pages, where the
    message waits. A panel of sixty widgets therefore blocks all pages while it is created. Messages can overtake those
    that wait, two threads can deadlock, and an exception within the context always causes a deadlock.
    """
    lock, waiting, depth = threading.RLock(), [], [0]

    def queue_message(message: Any) -> None:
        with lock:
            if depth[0] > 0:
                waiting.append(message)
            else:
                connection.unsafe_send_message(message)

    @contextlib.contextmanager
    def atomic() -> Iterator[None]:
        with lock:
            depth[0] += 1
            try:
                yield
            finally:
                depth[0] -= 1
                if depth[0] == 0:
                    for message in waiting:
                        connection.unsafe_send_message(message)
                    waiting.clear()

    connection.queue_message, connection.atomic = queue_message, atomic


def _send_html(connection: Any) -> None:
    """Make a connection convert texts from MDX, which 0.2.7 reads, to HTML, which 1.x reads."""
    queue = connection.queue_message

    def queue_message(message: Any) -> None:
        for props in (getattr(message, "updates", None), vars(getattr(message, "props", connection))):
            if isinstance(props, dict) and isinstance(props.get("_markdown"), str):
                props["_markdown"] = mdx_to_html(props["_markdown"])
        queue(message)

    connection.queue_message = queue_message


def mdx_to_html(mdx: str) -> str:
    """Convert MDX to HTML: style objects become style strings.

    >>> mdx_to_html('<i style={{fontSize: "1em", color: "red"}}>a</i>')
    '<i style="font-size: 1em; color: red">a</i>'
    """

    def style(match: re.Match[str]) -> str:
        pairs = re.findall(r'(\w+): "([^"]*)"', match[1])
        rules = [f"{re.sub('[A-Z]', lambda upper: '-' + upper[0].lower(), name)}: {value}" for name, value in pairs]
        return f'style="{"; ".join(rules)}"'

    return re.sub(r"style=\{\{(.*?)\}\}", style, mdx)


def _ignore_invalid_values(connection: Any) -> None:
    """Make a connection ignore invalid widget values from the page.

    For example, a lone minus sign in a number box is sent as a value that is not a number, on which viser raises.
    """
    from viser import _messages  # noqa: PLC0415

    def checked(handler: Callable[[int, Any], Any]) -> Callable[[int, Any], Any]:
        invalid = contextlib.suppress(ArithmeticError, AssertionError, TypeError, ValueError)

        def handle(number: int, message: Any) -> None:
            if isinstance(message.updates, dict) and all(map(_finite, message.updates.values())):
                with invalid:
                    handler(number, message)

        async def handle_async(number: int, message: Any) -> None:  # 1.x
            if isinstance(message.updates, dict) and all(map(_finite, message.updates.values())):
                with invalid:
                    await handler(number, message)

        return handle_async if inspect.iscoroutinefunction(handler) else handle

    handlers = connection._incoming_handlers
    handlers[_messages.GuiUpdateMessage] = [checked(old) for old in handlers.get(_messages.GuiUpdateMessage, [])]


def _finite(value: Any) -> bool:
    if isinstance(value, list | tuple):
        return all(map(_finite, value))
    return not isinstance(value, float) or math.isfinite(value)


def add_button_group(gui: Any, label: str, options: Sequence[str], pressed: Callable[[str, Any], None]) -> Any:
    """Add a row of buttons to a panel; an empty label takes no room.

    viser 0.2.7 ignores the button of a group that was pressed last, and initially the first button.

    Args:
        pressed: called with the caption of the pressed button and viser's event.
    """
    group = gui.add_button_group(label, options)

    def clicked(event: Any) -> None:
        name, group._impl.value = group.value, ""
        pressed(name, event)

    group._impl.value = ""
    group.on_click(clicked)
    return group


def ignore_closed_clients(server: Any) -> None:
    """Silence tracebacks about messages from a page that was closed before they were handled.

    viser 0.2.7 handles messages in another thread. There, it and nerfstudio 1.1.5 look up the page by its number, and
    viser prints a traceback if the page no longer exists.

    Args:
        server: viser's server.
    """

    def silence(connection: Any) -> None:
        handle = connection._handle_incoming_message

        def handle_quietly(number: int, message: Any) -> None:
            try:
                handle(number, message)
            except KeyError as error:
                if any(type(key) is not int or key in server.get_clients() for key in error.args):
                    raise

        if not inspect.iscoroutinefunction(handle):  # in 1.x it is a coroutine
            connection._handle_incoming_message = handle_quietly

    silence(server._websock_server)
    server.on_client_connect(lambda client: silence(client._websock_connection))


def _unpack_splats(buffer: UInt32[np.ndarray, "k 8"]) -> dict[str, np.ndarray]:
    """Return records as the arguments of viser 1.x's `add_gaussian_splats`."""
    factors = np.ascontiguousarray(buffer[:, 4:7]).view(np.float16).astype(np.float64)
    lower = np.zeros((len(buffer), 3, 3))
    lower[:, [0, 1, 2, 1, 2, 2], [0, 0, 0, 1, 1, 2]] = factors
    rgba = np.ascontiguousarray(buffer[:, 7:8]).view(np.uint8)
    return {
        "centers": np.ascontiguousarray(buffer[:, :3]).view(np.float32),
        "covariances": lower @ lower.swapaxes(1, 2),
        "rgbs": rgba[:, :3],
        "opacities": rgba[:, 3:] / np.float32(255),
    }


OPENING = "Opening the run."


class Door:
    """Server that accepts pages immediately, before torch is imported and the run is read; the pages wait meanwhile."""

    def __init__(self, host: str, port: int, allowed_hosts: Sequence[str] = ()) -> None:
        self._lock, self._waiting = threading.Lock(), dict[int, BrowserPage]()
        self._hosts: tuple[Callable[[BrowserPage], None], Callable[[int], None]] | None = None
        self.server = ViserServer(host, port, "normlift", self._come, self._go, allowed_hosts)

    def open(self, label: str, come: Callable[[BrowserPage], None], go: Callable[[int], None]) -> None:
        """Pass on the waiting pages and all later ones.

        Args:
            label: text above the panel.
            come: called with every page that opens.
            go: called with the number of every page that closes, even if `come` was not called with it.
        """
        self.server.label(label)
        with self._lock:
            self._hosts, waiting = (come, go), list(self._waiting.values())
            self._waiting.clear()
        for page in waiting:
            page.notice("")
            come(page)

    def _come(self, page: BrowserPage) -> None:
        with self._lock:
            hosts = self._hosts
            if hosts is None:
                self._waiting[page.number] = page
                page.notice(OPENING)
        if hosts is not None:
            hosts[0](page)

    def _go(self, number: int) -> None:
        with self._lock:
            hosts = self._hosts
            self._waiting.pop(number, None)
        if hosts is not None:
            hosts[1](number)
