"""What is known of the viser that is installed still holds, and its server gives away nothing but its page."""

from __future__ import annotations

import logging
import socket
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version
from types import SimpleNamespace

import msgspec
import numpy as np
import pytest
from websockets.sync.client import ClientConnection

from normlift_ns.viewer.adapter import Page, Server, pass_over_the_gone
from tests.viewer.wire import ONE, messages, opened

pytest.importorskip("viser")


@pytest.fixture(scope="module")
def pages() -> list[Page]:
    return []


@pytest.fixture(scope="module")
def server(pages: list[Page]) -> Iterator[Server]:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    server = Server("127.0.0.1", port, "label", pages.append, lambda _: None)
    yield server
    server.stop()


def received(browser: ClientConnection, kind: str) -> dict:
    """The next message of a kind."""
    deadline = time.monotonic() + 30
    while time.monotonic() < deadline:
        for message in messages(browser.recv(timeout=30)):
            if message["type"] == kind:
                return message
    raise AssertionError(f"no {kind}")


def answered(port: int, path: str) -> bytes:
    """The raw answer to a path that no client would clean up."""
    with socket.create_connection(("127.0.0.1", port), 10) as line:
        line.sendall(f"GET {path} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n".encode())
        found = b""
        while piece := line.recv(65536):
            found += piece
    return found


@pytest.mark.parametrize(
    "path", ["/../../_viser.py", "/assets/../../../_viser.py", "/%2e%2e/%2e%2e/_viser.py", "/..", "//etc/passwd"]
)
def test_only_the_page_is_served(server, path):
    found = answered(server.port, path)
    assert b"import" not in found
    assert b"root:" not in found
    page = urllib.request.urlopen(f"http://127.0.0.1:{server.port}/", timeout=10).read()
    assert b"<title>" in page
    assert b"normliftBlind" in page
    assert b"googletagmanager" not in page
    assert page.count(b"</script>") == 2


@pytest.mark.parametrize(
    "path", ["/assets", "/hdri/", "//etc/passwd", "//", "/" + "a" * 5000, "/%00", "/a\x00b", "/none"]
)
def test_what_is_no_file_is_not_found_and_told_to_nobody(server, path, monkeypatch):
    told = []
    monkeypatch.setattr(logging.Logger, "handle", lambda _, record: told.append(record.getMessage()))
    assert b"404" in answered(server.port, path)
    assert told == []


@contextmanager
def browsing(server: Server, pages: list[Page]) -> Iterator[tuple[ClientConnection, Page]]:
    """A browser, and its page."""
    before, deadline = len(pages), time.monotonic() + 30
    with opened(server.port) as browser:
        while len(pages) == before and time.monotonic() < deadline:
            time.sleep(0.01)
        yield browser, pages[before]


def records(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Some Gaussians, and their covariances: the entries on the diagonal and above."""
    buffer = np.zeros((count, 8), np.uint32)
    factors = np.tile(np.array([1.0, 0.5, 0.25, 1.0, 0.5, 1.0], np.float16), (count, 1))
    lower = np.array([[1, 0, 0], [0.5, 1, 0], [0.25, 0.5, 1]])
    buffer[:, :3] = np.random.default_rng(0).random((count, 3), np.float32).view(np.uint32)
    buffer[:, 4:7] = factors.view(np.uint32)
    buffer[:, 7] = np.arange(count) + 0x80402000
    return buffer, (lower @ lower.T)[np.triu_indices(3)]


def test_splats_are_swapped_and_not_sent_under_the_same_name(server, pages):
    with browsing(server, pages) as (browser, page):
        assert "permessage-deflate" not in browser.response.headers.get("Sec-WebSocket-Extensions", "")
        buffers = [records(n) for n in (3, 5)]
        page.draw(buffers[0][0])
        first = received(browser, "GaussianSplatsMessage")
        sent = np.frombuffer(first["props"]["buffer"] if ONE else first["buffer"], np.uint32).reshape(3, 8)
        np.testing.assert_array_equal(sent[:, [0, 1, 2, 7]], buffers[0][0][:, [0, 1, 2, 7]])
        shape = np.ascontiguousarray(sent[:, 4:7]).view(np.float16)
        np.testing.assert_array_equal(
            shape, buffers[0][1][None].repeat(3, 0) if ONE else [[1, 0.5, 0.25, 1, 0.5, 1]] * 3
        )
        page.draw(buffers[1][0])
        assert received(browser, "RemoveSceneNodeMessage")["name"] == first["name"]
        page.draw(buffers[0][0][:0])
        page.outline(np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)], float))
        assert received(browser, "CatmullRomSplineMessage")["name"] == "/box"
        page.outline(None)
        page.listen()
        assert "sessionStorage" in received(browser, "RunJavascriptMessage")["source"]
        page.download("a.ply", b"ply")
        assert received(browser, "FileTransferPart")["content"] == b"ply"
        page.notice("wait")
        page.notice("")
        assert not page.gone
    deadline = time.monotonic() + 30
    while not page.gone and time.monotonic() < deadline:
        time.sleep(0.01)
    assert page.gone


def test_messages_keep_their_order_and_no_page_waits_for_another(server, pages):
    with browsing(server, pages) as (browser, page), browsing(server, pages) as (other, another):
        with page.together():
            for i in range(200):  # more than viser has threads
                with page.together():
                    page.gui.add_text(f"text {i}", "")
            another.gui.add_text("Prompts", "").on_update(lambda _: another.notice("heard"))
            made = received(other, "GuiTextMessage" if ONE else "GuiAddTextMessage")
            name = "uuid" if ONE else "id"
            other.send(
                msgspec.msgpack.encode({"type": "GuiUpdateMessage", name: made[name], "updates": {"value": "red"}})
            )
            received(other, "GuiMarkdownMessage" if ONE else "GuiAddMarkdownMessage")
        texts = []
        while len(texts) < 200:
            some = [one for one in messages(browser.recv(timeout=30)) if "Text" in one["type"]]
            texts += [(one["props"] if ONE else one)["label"] for one in some]
        assert texts == [f"text {i}" for i in range(200)]
        with pytest.raises(ZeroDivisionError), page.together():
            _ = 1 / 0
        page.notice("still there")
        received(browser, "GuiMarkdownMessage" if ONE else "GuiAddMarkdownMessage")


def test_nonsense_in_a_widget_is_passed_over(server, pages, capsys):
    with browsing(server, pages) as (browser, page):
        heard = []
        widget = page.gui.add_slider("Grow", min=-10, max=10, step=1, initial_value=0)
        widget.on_update(lambda _: heard.append(widget.value))
        made = received(browser, "GuiSliderMessage" if ONE else "GuiAddSliderMessage")
        for value in (float("nan"), float("inf"), None, "abc", [1, float("nan")], {}, -(10**18), 3):
            update = {"uuid" if ONE else "id": made["uuid" if ONE else "id"], "updates": {"value": value}}
            browser.send(msgspec.msgpack.encode({"type": "GuiUpdateMessage", **update}))
            time.sleep(0.05)
        deadline = time.monotonic() + 30
        while 3 not in heard and time.monotonic() < deadline:
            time.sleep(0.01)
    assert heard == [-(10**18), 3]
    assert "Traceback" not in capsys.readouterr().err


def test_clicks_come_until_nobody_listens(server, pages):
    if ONE:
        event = {"ray_origin": [0, 0, 0], "ray_direction": [0, 0, 1], "screen_pos": [[0.5, 0.5]], "modifier": None}
    else:
        event = {"ray_origin": [0, 0, 0], "ray_direction": [0, 0, 1], "screen_pos": [[0.5, 0.5]]}
    with browsing(server, pages) as (browser, page):
        clicks = []
        page.on_click(lambda *ray: clicks.append(ray))
        page.on_click(lambda *ray: clicks.append(ray))
        click = {"type": "ScenePointerMessage", "event_type": "click", **event}
        browser.send(msgspec.msgpack.encode(click))
        deadline = time.monotonic() + 30
        while not clicks and time.monotonic() < deadline:
            time.sleep(0.01)
        page.on_click(None)
        page.on_click(None)
        browser.send(msgspec.msgpack.encode(click))
        time.sleep(0.3)
        assert len(clicks) == 1
        assert tuple(clicks[0][1]) == (0, 0, 1)


def test_what_a_closed_page_asked_is_passed_over_and_all_else_is_told():
    def read(number: int, message: Exception) -> None:
        heard.append(number)
        raise message

    heard, come = [], []
    lines = [SimpleNamespace(_handle_incoming_message=read) for _ in range(2)]
    told = {"get_clients": lambda: {3: "here"}, "on_client_connect": come.append}
    pass_over_the_gone(SimpleNamespace(_websock_server=lines[0], **told))
    come[0](SimpleNamespace(_websock_connection=lines[1]))
    for line in lines:
        line._handle_incoming_message(4, KeyError(4))
        for other in (KeyError(3), KeyError("4"), KeyError(True), IndexError(4), ValueError("wrong")):
            with pytest.raises(type(other)):
                line._handle_incoming_message(5, other)
    assert heard == 2 * [4, 5, 5, 5, 5, 5]


def test_nobody_can_publish_the_server(server):
    from viser import _messages  # noqa: PLC0415

    handlers = server._server._websock_server._incoming_handlers
    assert not handlers.get(_messages.ShareUrlRequest)


def test_the_version_is_one_that_the_adapter_knows():
    assert version("viser").split(".")[0] == "1" or version("viser").split(".")[:2] == ["0", "2"]
