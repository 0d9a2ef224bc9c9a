"""All that is known of viser, and of the two lines of it: 0.2.7, which nerfstudio 1.1.5 pins, and 1.x.

0.2.7 draws Gaussians by a private helper that fails on thin ones (it adds 1e-7 to every entry of a covariance and takes
its Cholesky factor) and never repaints a resend under the same name. Its message is therefore made here, and names are
swapped. 1.x, which cannot be installed beside nerfstudio 1.1.5, has `add_gaussian_splats` for it; `make test-viser1`
runs the tests of this file with it. Where the two differ a comment says so.
"""

from __future__ import annotations

import contextlib
import inspect
import io
import json
import math
import re
import threading
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, UInt32

from normlift_ns.viewer.blind.page import picture_script
from normlift_ns.viewer.serving.guard import guarded

SESSION = "Session"
"""Label of the text box through which the page's script tells the server its token and its link; it is not shown."""
_EDGES = (0, 1, 3, 2, 0, 4, 5, 1, 5, 7, 3, 7, 6, 2, 6, 4)
"""Corners on a way along all edges of a box."""
_HELD = (None, "shift", "alt")
"""Keys with which a click counts."""
_SCRIPT = """
(() => {
  const labelled = (text) => [...document.querySelectorAll("label")].find((l) => l.textContent === text);
  const press = (text) => {
    const found = [...document.querySelectorAll("button")].find((b) => b.textContent.trim() === text);
    if (found && !found.disabled) found.click();
  };
  const rowOf = (text) => {
    let row = labelled(text);
    while (row && !row.querySelector("input")) row = row.parentElement;
    return row;
  };
  const tell = (held = "") => {
    const row = rowOf("SESSION");
    if (!row) return setTimeout(tell, 50);
    const box = row.querySelector("input");
    row.parentElement.style.display = "none";
    let token = sessionStorage.getItem("normlift");
    if (!token) {
      token = crypto.randomUUID ? crypto.randomUUID() : String(Math.random()).slice(2) + Date.now();
      sessionStorage.setItem("normlift", token);
    }
    const webgl = !window.normliftBlind;
    const asked = new URLSearchParams(location.search).get("q");
    const value = JSON.stringify({token, link: asked ? "q=" + asked : "", webgl, held});
    Object.getOwnPropertyDescriptor(HTMLInputElement.prototype, "value").set.call(box, value);
    box.dispatchEvent(new Event("input", {bubbles: true}));
  };
  tell();
  if (window.normlift) return;
  window.normlift = true;
  const style = document.createElement("style");
  style.textContent = `.mantine-Button-root[data-variant="outline"] { padding-inline: 2px; }
    .mantine-Flex-root > div:has(label:empty) { display: none; }
    .mantine-ActionIcon-root:has(.tabler-icon-share) { display: none; }`;
  document.head.append(style);
  const typing = (event) => ["INPUT", "TEXTAREA"].includes(event.target.tagName);
  const deeds = {Shift: "Add", Alt: "Take away"};
  let held = "";
  const hold = (key, wait) => {
    held = key;
    setTimeout(() => { if (held === key) tell(deeds[key] || ""); }, wait);
  };
  addEventListener("keydown", (event) => {
    const row = rowOf("Prompts");
    const box = row && row.querySelector("input");
    if (event.key === "Enter" && event.target === box) setTimeout(() => press("Ask"), 150);
    if (event.key === "Escape") press("Cancel");
    if (typing(event) || event.repeat) return;
    if (event.key in deeds) hold(event.key, 0);
    if (event.key === "Alt") event.preventDefault();
    if ((event.ctrlKey || event.metaKey) && event.key.toLowerCase() === "z") press(event.shiftKey ? "Redo" : "Undo");
  });
  addEventListener("keyup", (event) => { if (held && event.key === held) hold("", 600); });
  addEventListener("blur", () => { if (held) hold("", 600); });
})();
""".replace("SESSION", SESSION)


class Server:
    """A viser server.

    Args:
        on_page: called in a thread of its own for every browser that opens the page, or comes back to it.
        on_gone: called when it is closed or cut off.
    """

    def __init__(
        self,
        host: str,
        port: int,
        label: str,
        on_page: Callable[[Page], None],
        on_gone: Callable[[int], None],
    ) -> None:
        import viser  # noqa: PLC0415 (--help should not wait for it)

        with guarded(), contextlib.redirect_stdout(io.StringIO()):  # its own table of addresses
            self._server = viser.ViserServer(host=host, port=port, label=label, verbose=False)
        self.host, self.port = host, self._server.get_port()
        self._refuse_tunnels()
        gui: Any = self._server.gui
        if hasattr(gui, "main_panel"):  # 1.x
            gui.configure_theme(show_logo=False, show_share_button=False)
            gui.main_panel.dock_right()
        else:
            gui.configure_theme(control_layout="collapsible", show_logo=False)

        @self._server.on_client_connect
        def _(client: Any) -> None:  # under a lock of viser's
            threading.Thread(target=on_page, args=(Page(client),), daemon=True).start()

        @self._server.on_client_disconnect
        def _(client: Any) -> None:
            on_gone(client.client_id)

    def _refuse_tunnels(self) -> None:
        """A page could ask viser to publish the server on the internet; nobody told it to.

        The script hides the button. viser could itself, but 0.2.7's page then loses count of React's hooks, and stays
        white on a phone.
        """
        from viser import _messages  # noqa: PLC0415

        for name in ("ShareUrlRequest", "ShareUrlDisconnect"):
            message = getattr(_messages, name, None)
            with contextlib.suppress(KeyError, AssertionError, AttributeError):
                self._server._websock_server.unregister_handler(message)  # pyright: ignore[reportArgumentType]

    def label(self, text: str) -> None:
        """Stands over the panel of every page."""
        self._server.gui.set_panel_label(text)

    def stop(self) -> None:
        """Closes all pages."""
        self._server.stop()


class Page:
    """The page of one browser, from its connection to its loss."""

    def __init__(self, client: Any) -> None:
        self._client = client
        if hasattr(client._websock_connection, "unsafe_send_message"):  # 0.2.7
            _in_order(client._websock_connection)
        else:
            _in_html(client._websock_connection)
        _hear_sense(client._websock_connection)
        self._waiting: Any = client._websock_connection._state.message_buffer
        self.number: int = client.client_id
        """Of the connection."""
        self._splats: Any = None
        self._box: Any = None
        self._notice: Any = None
        self._count = 0

    @property
    def gui(self) -> Any:
        """Widgets of this page alone: viser's `GuiApi`."""
        return self._client.gui

    @property
    def camera(self) -> Any:
        """viser's camera of this page, in the browser's units."""
        return self._client.camera

    @property
    def gone(self) -> bool:
        """Whether the connection is lost."""
        return self._waiting.done

    @property
    def behind(self) -> bool:
        """Whether messages wait for the page to take those before."""
        return len(self._waiting.message_from_id) > 0

    def together(self) -> Any:
        """A context whose messages the page shows at once."""
        return self._client.atomic()

    def notice(self, text: str) -> None:
        """Shows a text in the panel, in place of that before; an empty one: none."""
        if self._notice is not None:
            self._notice.remove()
        self._notice = self._client.gui.add_markdown(text) if text else None

    def draw(self, buffer: UInt32[np.ndarray, "k 8"]) -> None:
        """Draws Gaussians in place of those before."""
        with self.together():
            if self._splats is not None:
                self._splats.remove()
                self._splats = None
            if len(buffer) > 0:
                self._count += 1
                self._splats = self._add(f"/splats_{self._count}", buffer)
        self._client.flush()

    def outline(self, corners: Float[np.ndarray, "8 3"] | None) -> None:
        """Draws the edges of a box in place of those before; None: of none."""
        if self._box is not None:
            self._box.remove()
        self._box = None
        if corners is not None:
            add = self._client.scene.add_spline_catmull_rom
            old = "line_width" in inspect.signature(add).parameters  # 0.2.7
            wide: dict[str, Any] = {"line_width": 4.0} if old else {"thickness": 4.0, "thickness_units": "screen"}
            straight = {"curve_type": "catmullrom", "tension": 0.0, "segments": 240}  # between corners
            path = np.asarray(corners, float)[list(_EDGES)]
            points = tuple(map(tuple, path.tolist())) if old else path
            self._box = add("/box", points, color=(255, 140, 0), **straight, **wide)

    def _add(self, name: str, buffer: UInt32[np.ndarray, "k 8"]) -> Any:
        scene = self._client.scene
        if hasattr(scene, "add_gaussian_splats"):  # 1.x
            return scene.add_gaussian_splats(name, **_unpacked(buffer))
        from viser import GaussianSplatHandle, _messages  # noqa: PLC0415

        scene._websock_interface.queue_message(_messages.GaussianSplatsMessage(name=name, buffer=buffer))
        return GaussianSplatHandle._make(scene, name, (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), True)

    def on_camera(self, moved: Callable[[], None]) -> None:
        """Calls a function whenever the person moves the camera or changes the size of the page."""
        self._client.camera.on_update(lambda _: moved())

    def show_picture(self, jpeg: bytes) -> None:
        """Shows a picture in place of the scene."""
        self._run(picture_script(jpeg))

    def up(self, direction: np.ndarray) -> None:
        """Which way is up, for turning the camera."""
        self._client.scene.set_up_direction(direction)

    def listen(self) -> None:
        """Runs the script that knows keys; it writes the token, the link and the key that is held into the box called
        `SESSION`.
        """
        self._run(_SCRIPT)

    def become(self, token: str) -> None:
        """Gives the page another token."""
        self._run(f'sessionStorage.setItem("normlift", {json.dumps(token)});')

    def address(self, query: str) -> None:
        """Writes a link into the browser's address bar, and onto the clipboard where it lets us. It is the query of the
        address: viser takes a fragment for part of the server's name.
        """
        self._run(
            f'history.replaceState(null, "", "?" + {json.dumps(query)});'
            "if (navigator.clipboard) navigator.clipboard.writeText(location.href).catch(() => {});"
        )

    def _run(self, script: str) -> None:
        from viser import _messages  # noqa: PLC0415

        self._client._websock_connection.queue_message(_messages.RunJavascriptMessage(source=script))

    def download(self, name: str, content: bytes) -> None:
        """Lets the browser save a file."""
        self._client.send_file_download(name, content)

    def on_click(self, clicked: Callable[[tuple[float, ...], tuple[float, ...]], None] | None) -> None:
        """Calls a function with origin and direction of the ray of every click on the scene; None: of none."""
        scene = self._client.scene
        one = hasattr(scene, "on_click")  # 1.x, which also tells which keys are held
        if one:
            scene.remove_click_callback()
        elif clicked is None and scene._scene_pointer_cb is not None:
            scene.remove_pointer_callback()
        if clicked is None:
            return
        told = clicked
        for listen in [scene.on_click(modifier=keys) for keys in _HELD] if one else [scene.on_pointer_event("click")]:
            listen(lambda event: told(event.ray_origin, event.ray_direction))


def _in_order(connection: Any) -> None:
    """Messages of a connection go in the order in which they are made, and those of `together` at once.

    viser 0.2.7 hands each message that is made within its `atomic` to one of 32 threads that serve all pages, where it
    waits: a panel of sixty widgets stops all pages while it is made. Two threads can lock each other out for ever, an
    error within does it surely, and messages overtake those that wait.
    """
    lock, held, depth = threading.RLock(), [], [0]

    def queue_message(message: Any) -> None:
        with lock:
            if depth[0] > 0:
                held.append(message)
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
                    for message in held:
                        connection.unsafe_send_message(message)
                    held.clear()

    connection.queue_message, connection.atomic = queue_message, atomic


def _in_html(connection: Any) -> None:
    """Texts of a connection, which are MDX as 0.2.7 reads it, as the HTML that 1.x reads."""
    queue = connection.queue_message

    def queue_message(message: Any) -> None:
        for some in (getattr(message, "updates", None), vars(getattr(message, "props", connection))):
            if isinstance(some, dict) and isinstance(some.get("_markdown"), str):
                some["_markdown"] = html_of(some["_markdown"])
        queue(message)

    connection.queue_message = queue_message


def html_of(mdx: str) -> str:
    """What MDX writes as an object, HTML writes as a text.

    >>> html_of('<i style={{fontSize: "1em", color: "red"}}>a</i>')
    '<i style="font-size: 1em; color: red">a</i>'
    """

    def style(found: re.Match[str]) -> str:
        pairs = re.findall(r'(\w+): "([^"]*)"', found[1])
        words = [f"{re.sub('[A-Z]', lambda big: '-' + big[0].lower(), name)}: {value}" for name, value in pairs]
        return f'style="{"; ".join(words)}"'

    return re.sub(r"style=\{\{(.*?)\}\}", style, mdx)


def _hear_sense(connection: Any) -> None:
    """What a page sends as the value of a widget is passed over where it is no such value: a lone minus in a box for
    numbers is sent as one that is none, on which viser raises.
    """
    from viser import _messages  # noqa: PLC0415

    def sensible(hear: Callable[[int, Any], Any]) -> Callable[[int, Any], Any]:
        odd = contextlib.suppress(ArithmeticError, AssertionError, TypeError, ValueError)

        def heard(number: int, message: Any) -> None:
            if all(map(_finite, message.updates.values())):
                with odd:
                    hear(number, message)

        async def heard_one(number: int, message: Any) -> None:  # 1.x
            if all(map(_finite, message.updates.values())):
                with odd:
                    await hear(number, message)

        return heard_one if inspect.iscoroutinefunction(hear) else heard

    handlers = connection._incoming_handlers
    handlers[_messages.GuiUpdateMessage] = [sensible(hear) for hear in handlers.get(_messages.GuiUpdateMessage, [])]


def _finite(value: Any) -> bool:
    if isinstance(value, list | tuple):
        return all(map(_finite, value))
    return not isinstance(value, float) or math.isfinite(value)


def button_group(gui: Any, label: str, options: Sequence[str], pressed: Callable[[str, Any], None]) -> Any:
    """Buttons in a row, without room for a label that is empty; `pressed` is called with the name of the one that is,
    and with viser's event.

    viser 0.2.7 passes over a button of a group that was the last to be pressed, and at first over the first one.
    """
    group = gui.add_button_group(label, options)

    def clicked(event: Any) -> None:
        name, group._impl.value = group.value, ""
        pressed(name, event)

    group._impl.value = ""
    group.on_click(clicked)
    return group


def pass_over_the_gone(server: Any) -> None:
    """Nothing is printed about messages of a page that was closed before they were read.

    viser 0.2.7 reads them in another thread, where it and nerfstudio 1.1.5 look up the page by its number, and prints a
    traceback when it is not there any more.

    Args:
        server: viser's.
    """

    def quiet(line: Any) -> None:
        handle = line._handle_incoming_message

        def read(number: int, message: Any) -> None:
            try:
                handle(number, message)
            except KeyError as error:
                if any(type(key) is not int or key in server.get_clients() for key in error.args):
                    raise

        if not inspect.iscoroutinefunction(handle):  # as 1.x has it
            line._handle_incoming_message = read

    quiet(server._websock_server)
    server.on_client_connect(lambda client: quiet(client._websock_connection))


def _unpacked(buffer: UInt32[np.ndarray, "k 8"]) -> dict[str, np.ndarray]:
    """Records as the arguments of viser 1.x."""
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
