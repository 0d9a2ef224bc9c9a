"""Adapter for viser 0.2.7, the library of nerfstudio's viewer: order of messages, button groups and keys."""

from __future__ import annotations

import contextlib
import inspect
import threading
from collections.abc import Callable, Iterator, Sequence
from typing import Any

_MAX_HOLDUP = 0.5
"""Maximum number of seconds that a message waits for the previous message."""
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
"""Script that makes Enter press Ask and Escape press Cancel, because viser 0.2.7 does not handle these keys. Enter
takes effect after 150 ms, because viser sends typed text only every 50 ms."""


def handle_in_order(server: Any) -> None:
    """Make a server handle messages in the order in which they arrive.

    viser 0.2.7 passes each message to one of 32 threads. On a busy machine, a button press can therefore overtake the
    text typed before it, and one of two quick presses can be lost. With this function, each message waits until the
    previous message is handled, but for at most half a second.

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
    """Make a server send all messages in order, including those within `atomic`.

    Args:
        server: viser's server, 0.2.7.
    """
    _send_in_order(server._websock_server)
    server.on_client_connect(lambda client: _send_in_order(client._websock_connection))


def _send_in_order(connection: Any) -> None:
    """Make a connection send its messages in order, and those within `atomic` together when its context ends.

    viser 0.2.7 passes each message within `atomic` to one of 32 threads that serve all pages. The thread is blocked
    until the context ends, so a panel of sixty widgets blocks all pages while it is created. Later messages can
    overtake waiting ones, two threads can deadlock, and an exception within the context always causes a deadlock.
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


def add_button_group(gui: Any, label: str, options: Sequence[str], pressed: Callable[[str, Any], None]) -> Any:
    """Add a row of buttons to a panel; an empty label takes no space.

    This function works around an error in viser 0.2.7. viser ignores a repeated press of the same button of a group,
    and a press of its first button before any other press.

    Args:
        pressed: Function to call with the caption of the pressed button and viser's event.
    """
    group = gui.add_button_group(label, options)

    def clicked(event: Any) -> None:
        name, group._impl.value = group.value, ""
        pressed(name, event)

    group._impl.value = ""
    group.on_click(clicked)
    return group


def ignore_closed_clients(server: Any) -> None:
    """Suppress tracebacks about messages whose pages were closed before viser handled them.

    viser 0.2.7 handles messages in another thread. In this thread, viser and nerfstudio 1.1.5 look up the page by its
    number, and viser prints a traceback if the page no longer exists.

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

        if not inspect.iscoroutinefunction(handle):  # it is one in viser 1.x
            connection._handle_incoming_message = handle_quietly

    silence(server._websock_server)
    server.on_client_connect(lambda client: silence(client._websock_connection))
