"""What is known of the viser that is installed still holds, and its server gives away nothing but its page."""

import logging
import socket
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from threading import Event
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest
from websockets.sync.client import ClientConnection

from normlift_ns.viewer.adapter import BrowserPage, ViserServer, ignore_closed_clients
from tests.viewer.scenes import free_port, until
from tests.viewer.wire import CAMERA, ONE, messages, opened

pytestmark = pytest.mark.skipif(find_spec("viser") is None, reason="viser is not installed")
NAME, NOTICE = ("uuid", "GuiMarkdownMessage") if ONE else ("id", "GuiAddMarkdownMessage")


@pytest.fixture(scope="module")
def pages() -> list[BrowserPage]:
    return []


@pytest.fixture(scope="module")
def server(pages: list[BrowserPage]) -> Iterator[ViserServer]:
    server = ViserServer("127.0.0.1", free_port(), "label", pages.append, lambda _: None)
    yield server
    server.stop()


@contextmanager
def browsing(server: ViserServer, pages: list[BrowserPage]) -> Iterator[tuple[ClientConnection, BrowserPage]]:
    before = len(pages)
    with opened(server.port) as browser:
        until(lambda: len(pages) > before)
        yield browser, pages[before]


def received(browser: ClientConnection, kind: str) -> dict:
    while True:
        for message in messages(browser.recv(timeout=60)):
            if message["type"] == kind:
                return message


def changes(browser: ClientConnection, made: dict, value: Any) -> None:
    """The browser sends another value of a widget."""
    update = {"type": "GuiUpdateMessage", NAME: made[NAME], "updates": {"value": value}}
    browser.send(msgspec.msgpack.encode(update))


def test_only_the_page_is_served_and_what_is_no_file_is_told_to_nobody(server, monkeypatch):
    told = []
    monkeypatch.setattr(logging.Logger, "handle", lambda _, record: told.append(record.getMessage()))
    page = urllib.request.urlopen(f"http://127.0.0.1:{server.port}/", timeout=60).read()
    assert b"<title>" in page and b"normliftBlind" in page
    assert b"googletagmanager" not in page
    assert page.count(b"</script>") == 2
    outside = ["/../../_viser.py", "/assets/../../../_viser.py", "/%2e%2e/%2e%2e/_viser.py", "/..", "//etc/passwd"]
    for path in [*outside, "/assets", "/hdri/", "//", "/" + "a" * 5000, "/%00", "/a\x00b", "/none"]:
        with socket.create_connection(("127.0.0.1", server.port), 60) as line:  # no client cleans the path up
            line.sendall(f"GET {path} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n".encode())
            found = b"".join(iter(lambda line=line: line.recv(65536), b""))
        assert b"import" not in found and b"root:" not in found, path
        assert path in outside[:4] or b"404" in found, path
    assert told == []


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
        buffer, covariance = records(3)
        page.draw(buffer)
        first = received(browser, "GaussianSplatsMessage")
        sent = np.frombuffer(first["props"]["buffer"] if ONE else first["buffer"], np.uint32).reshape(3, 8)
        np.testing.assert_array_equal(sent[:, [0, 1, 2, 7]], buffer[:, [0, 1, 2, 7]])
        shape = np.ascontiguousarray(sent[:, 4:7]).view(np.float16)
        np.testing.assert_array_equal(shape, 3 * [covariance if ONE else [1, 0.5, 0.25, 1, 0.5, 1]])
        page.draw(records(5)[0])
        assert received(browser, "RemoveSceneNodeMessage")["name"] == first["name"]
        page.draw(buffer[:0])
        page.outline(np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)], float))
        assert received(browser, "CatmullRomSplineMessage")["name"] == "/box"
        page.outline(None)
        assert received(browser, "RemoveSceneNodeMessage")["name"] == "/box"
        page.listen()
        assert "sessionStorage" in received(browser, "RunJavascriptMessage")["source"]
        page.download("a.ply", b"ply")
        assert received(browser, "FileTransferPart")["content"] == b"ply"
        page.notice("wait")
        page.notice("")
        assert not page.gone
    until(lambda: page.gone)


def test_messages_keep_their_order_and_no_page_waits_for_another(server, pages):
    kind = "GuiTextMessage" if ONE else "GuiAddTextMessage"
    with browsing(server, pages) as (browser, page), browsing(server, pages) as (other, another):
        with page.together():
            for i in range(200):  # more than viser has threads
                with page.together():
                    page.gui.add_text(f"text {i}", "")
            another.gui.add_text("Prompts", "").on_update(lambda _: another.notice("heard"))
            changes(other, received(other, kind), "red")
            received(other, NOTICE)
        texts = []
        while len(texts) < 200:
            some = [one for one in messages(browser.recv(timeout=60)) if "Text" in one["type"]]
            texts += [(one["props"] if ONE else one)["label"] for one in some]
        assert texts == [f"text {i}" for i in range(200)]
        with pytest.raises(ZeroDivisionError), page.together():
            _ = 1 / 0
        page.notice("still there")
        received(browser, NOTICE)
        heard, made, overtaken = [], [], Event()
        for name, act in (("slow", lambda: overtaken.wait(0.1)), ("quick", overtaken.set)):
            page.gui.add_text(name, "").on_update(lambda _, name=name, act=act: (act(), heard.append(name)))
            made.append(received(browser, kind))
        for one in made:
            changes(browser, one, "red")
        until(lambda: len(heard) == 2)
        assert heard == ["slow", "quick"]


def test_nonsense_in_a_widget_is_passed_over_and_clicks_come_until_nobody_listens(server, pages, capsys):
    event = {"ray_origin": [0, 0, 0], "ray_direction": [0, 0, 1], "screen_pos": [[0.5, 0.5]]}
    click = {"type": "ScenePointerMessage", "event_type": "click", **event, **({"modifier": None} if ONE else {})}
    with browsing(server, pages) as (browser, page):
        heard, clicks = [], []
        widget = page.gui.add_slider("Grow", min=-10, max=10, step=1, initial_value=0)
        widget.on_update(lambda _: heard.append(widget.value))
        made = received(browser, "GuiSliderMessage" if ONE else "GuiAddSliderMessage")
        for value in (float("nan"), float("inf"), None, "abc", [1, float("nan")], {}, 3):
            changes(browser, made, value)
        until(lambda: heard != [])
        assert heard == [3]
        changes(browser, made, -(10**18))
        until(lambda: len(heard) == 2)
        assert heard[1] == -(10**18)

        for _ in range(2):
            page.on_click(lambda *ray: clicks.append(ray))
        browser.send(msgspec.msgpack.encode(click))
        until(lambda: clicks != [])
        for _ in range(2):
            page.on_click(None)
        browser.send(msgspec.msgpack.encode(click))
        changes(browser, made, 4)
        until(lambda: len(heard) == 3)
        assert [tuple(direction) for _, direction in clicks] == [(0, 0, 1)]
    assert "Traceback" not in capsys.readouterr().err


def test_malformed_messages_harm_no_other_page_and_print_no_traceback(server, pages, capfd):
    known = {"type": "GuiUpdateMessage", NAME: "none", "updates": {"value": 1}}
    objects = [[1], 3, None, {"type": "Nothing"}, {}, known, {**known, "updates": []}, {**known, NAME: [3]},
               {**CAMERA, "fov": "wide"}, {**CAMERA, "position": 3}, {"type": "ScenePointerMessage"}]  # fmt: skip
    with browsing(server, pages) as (other, page):
        for frame in (b"", b"\xc1", b"\x81", "text", bytes(range(256)), *map(msgspec.msgpack.encode, objects)):
            with browsing(server, pages) as (browser, _):
                browser.send(frame)
            page.notice(f"after {frame!r}"[:60])
            received(other, NOTICE)
    until(lambda: all(one.gone for one in pages))
    assert "Traceback" not in capfd.readouterr().err


def test_what_a_closed_page_asked_is_passed_over_and_all_else_is_told():
    def read(number: int, message: Exception) -> None:
        heard.append(number)
        raise message

    heard, come = [], []
    lines = [SimpleNamespace(_handle_incoming_message=read) for _ in range(2)]
    told = {"get_clients": lambda: {3: "here"}, "on_client_connect": come.append}
    ignore_closed_clients(SimpleNamespace(_websock_server=lines[0], **told))
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
