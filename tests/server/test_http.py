"""The HTTP API of a small lifted run, its client, and what the server refuses."""

import gzip
import io
import json
import socket
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from websockets.sync.client import connect as connect_websocket

from normlift_ns import connect, open_run
from normlift_ns.core.field import SemanticField
from normlift_ns.errors import InputError
from normlift_ns.server import app as app_module
from normlift_ns.server import runs as runs_module
from normlift_ns.server.app import ServerOptions, WarmServer
from normlift_ns.server.runs import RunStore
from normlift_ns.server.schema import Selection
from tests.server.pages import client_of, make_served, make_server, running

RUN = "/api/runs/cubes"


@pytest.fixture(scope="module")
def served_room(lifted):
    server = WarmServer(RunStore([lifted], open_run), ServerOptions(port=0))
    with running(server) as port:
        yield server.runs.get(server.runs.ids[0]).run, connect(f"127.0.0.1:{port}")


@pytest.fixture
def client(tmp_path):
    with client_of(make_server(make_served(tmp_path))) as client:
        yield client


def test_a_client_answers_as_the_run_itself(served_room, tmp_path, monkeypatch):
    run, remote = served_room
    local, answer = run.ask("red", "yellow"), remote.ask("red", "yellow")
    assert torch.equal(answer.relevancy, local.relevancy) and torch.equal(answer.selected, local.selected)
    assert [(one.text, one.verdict) for one in answer] == [(one.text, one.verdict) for one in local]
    assert answer["red"].result.centroid == pytest.approx(local["red"].centroid)
    red = remote.ask("red", threshold=0.9, min_reliability=0.2)
    assert torch.equal(red.mask, run.ask("red", threshold=0.9, min_reliability=0.2).mask)
    objects = remote.objects(answer["yellow"]).objects
    assert [one.count for one in objects[:1]] == [one.size for one in local["yellow"].objects[:1]]
    assert remote.select(answer.mask).count == int(local.mask.sum())
    assert remote.select(Selection(answer.question, object=1)).count == remote.objects(answer).objects[0].count
    floaters = int(run.floaters().mask.sum())
    assert remote.select(Selection(floaters=True)).count == floaters == int(remote.floaters().sum())
    assert remote.select(Selection(answer.question, invert=True)).count == len(run.field) - int(local.mask.sum())
    why, expected = remote.why(answer["red"]), run.why(local["red"])
    assert why.effective_views == pytest.approx(expected.n_eff)
    assert why.support[0].name == run.votes.names[expected.views[0].view]
    assert remote.catalogue(answer) == json.loads(json.dumps(run.catalogue(local).to_json()))
    monkeypatch.setattr("normlift_ns.server.client.MAX_FEATURES", 1000)  # of one request
    torch.testing.assert_close(remote.features(5), run.field.directions(torch.arange(5, len(run.field))))
    camera = remote.camera("0001")
    assert torch.allclose(camera.world_to_camera, run.camera("0001").world_to_camera)
    image, plain = remote.render(camera, answer["red"]), remote.render("0001")
    assert image.shape == plain.shape == (120, 160, 3) and not torch.equal(image, plain)
    own = run.render("0001").float()
    assert float((plain.float() - own).abs().mean()) < 8  # JPEG
    run.export(tmp_path / "own.ply", local["red"])
    path = remote.export(tmp_path / "red.ply", answer["red"])
    assert path.read_bytes() == (tmp_path / "own.ply").read_bytes()
    with pytest.raises(FileExistsError):
        remote.export(path)
    masks = remote.masks(tmp_path / "masks", answer["red"])
    assert len(masks) == len(run.scene.train) and masks[0].read_bytes()[:4] == b"\x89PNG"
    for wrong in (
        lambda: remote.ask("zzyzx"),
        lambda: remote.ask(""),
        lambda: remote.why(torch.zeros(3, dtype=torch.bool)),
        lambda: remote.camera("none"),
        lambda: remote.select("red"),
        lambda: remote.select(Selection(answer.question, prompt=2)),
        lambda: remote.features(9, 9),
        lambda: connect(remote.address, "other"),
    ):
        with pytest.raises(InputError):
            wrong()
    with pytest.raises(OSError, match=r"127\.0\.0\.1:9"):
        connect("127.0.0.1:9")


def test_geometry_images_and_the_description_of_the_api(served_room, client):
    run, remote = served_room
    content = remote._get(remote._path("geometry"))
    assert content[:2] == b"\x1f\x8b" and len(content) < 60 * len(run.field)
    facts = remote.info
    assert facts["num_drawn"] + facts["num_left_out"] <= facts["num_gaussians"] == len(run.field)
    assert set(facts["saved_prompts"]) == {"red", "yellow"} and len(facts["examples"]) > 0
    assert set(facts["examples"]) < {"red", "orange", "yellow", "green", "blue", "purple", "pink", "brown", "black",
                                     "white", "gray"}  # fmt: skip
    first = client.get(f"{RUN}/geometry")
    assert first.headers["cache-control"] == "private, no-cache"
    tag = first.headers["etag"]
    assert client.get(f"{RUN}/geometry", headers={"If-None-Match": tag}).status_code == 304
    assert "immutable" in client.get(f"{RUN}/geometry?digest={tag[1:-1]}").headers["cache-control"]
    assert client.get(f"{RUN}/images/0?max_size=16").content[:2] == b"\xff\xd8"
    for size in ("15", "4097", "9" * 5000, "²"):
        assert client.get(f"{RUN}/images/0?max_size={size}").status_code == 400
    assert client.get(f"{RUN}/images/7").status_code == 400
    assert client.get(f"{RUN}/cameras").json()["cameras"][0]["width"] == 16
    document = client.get("/api/openapi.json").json()
    paths, names = document["paths"], document["components"]["schemas"]
    assert {"/api/runs/{run}/query", "/api/runs/{run}/floaters"} < set(paths) and "QueryRequest" in names
    references = set(json.dumps(document).split('"#/components/schemas/')[1:])
    assert {one.split('"')[0] for one in references} <= set(names)
    for path in paths:
        assert path in client.get("/api").text or path == "/api/runs"


def test_answers_of_the_small_world(client):
    body = {"texts": ["red", "blue"], "threshold": 0.5}
    answer = client.post(f"{RUN}/query", json=body).json()
    assert [row["count"] for row in answer["results"]] == [128, 64] and answer["num_gaussians"] == 256
    objects = client.post(f"{RUN}/objects", json={"question": body}).json()["objects"]
    assert [one["count"] for one in objects] == [64, 64, 64]
    ray = {"origin": [101.0, 1.0, 9.0], "direction": [0, 0, -1]}
    assert client.post(f"{RUN}/select", json={"ray": ray}).json()["count"] == 64
    mask = client.post(f"{RUN}/select", json={"ray": ray, "arrays": "npy"}).content
    assert np.load(io.BytesIO(mask)).sum() == 64
    for verb, request, words in (
        ("query", {"texts": ["zebra"]}, "unknown"), ("query", {"texts": []}, "length"),
        ("query", {"texts": ["red"], "x": 1}, "x"),
        ("query", {"texts": ["red"], "min_reliability": 2}, "<= 1"), ("select", {"mask": "AAAA"}, "bytes"),
        ("objects", {"question": body, "object": 9}, "no object 9"),
        ("export", {"question": body, "format": "exe"}, "exe"),
        ("render", {"page_view": {"position": [0, 0, 0], "look_at": [0, 0, 0], "up": [0, 0, 1], "fov": 1}}, "look"),
    ):  # fmt: skip
        answer = client.post(f"{RUN}/{verb}", json=request)
        assert answer.status_code == 400 and words in answer.json()["error"], (verb, request, answer.text)
    assert client.post(f"{RUN}/query", content=b"\xff{").status_code == 400
    assert client.get(f"{RUN}/features?start=5&stop=2").status_code == 400
    assert client.get("/api/runs/other/cameras").status_code == 404
    assert client.get(f"{RUN}/query").status_code == 405


def test_writing_needs_the_access_token_elsewhere(tmp_path):
    served, body = make_served(tmp_path), {"question": {"texts": ["red"]}}
    for options, token, status in (
        ({}, "", 200), ({"read_only": True}, "", 403), ({"host": "0.0.0.0", "access_token": "a"}, "", 403),
        ({"host": "0.0.0.0", "access_token": "a"}, "b", 403), ({"host": "0.0.0.0", "access_token": "a"}, "a", 200),
        ({"host": "::", "access_token": "a"}, "", 403), ({"host": "::1"}, "", 200),
    ):  # fmt: skip
        with client_of(make_server(served, **options)) as client:
            answer = client.post(f"{RUN}/save", json=body, headers={"Authorization": f"Bearer {token}"})
            assert answer.status_code == status, (options, token, answer.text)


def test_other_hosts_and_origins_are_refused(client):
    foreign = ({"Host": "evil.example"}, {"Host": "localhost:7008", "Origin": "https://evil.example"})
    for headers in ({"Host": "127.0.0.1", "Origin": "http://127.0.0.1"}, *foreign):
        for path in ("/", "/api/runs", f"{RUN}/geometry", "/assets/none.js"):
            expected = 403 if headers in foreign else 404 if path.startswith("/assets") else 200
            assert client.get(path, headers=headers).status_code == expected
    for headers in foreign:
        with pytest.raises(Exception), client.websocket_connect(f"{RUN}/session", headers=headers):  # noqa: B017
            pytest.fail("accepted")


def test_bodies_are_bounded_headers_are_strict_and_no_file_outside_is_served(client, tmp_path, monkeypatch):
    assert client.post(f"{RUN}/query", content=b"x" * (app_module.MAX_BODY + 1)).status_code == 413
    assert client.post(f"{RUN}/query", content=iter([b"x" * 2**20] * 5)).status_code == 413
    policy = client.get("/").headers["content-security-policy"]
    assert "unsafe-eval" not in policy.replace("wasm-unsafe-eval", "") and "http" not in policy
    (tmp_path / "page" / "assets").mkdir(parents=True)
    (tmp_path / "page" / "index.html").write_text("<p>the page")
    (tmp_path / "page" / "assets" / "a.js").write_text("1")
    (tmp_path / "secret").write_text("2")
    (tmp_path / "page" / "assets" / "link").symlink_to(tmp_path / "secret")
    monkeypatch.setattr(app_module, "PAGE_FOLDER", tmp_path / "none")
    assert "build" in client.get("/").text
    monkeypatch.setattr(app_module, "PAGE_FOLDER", tmp_path / "page")
    assert client.get("/").text == "<p>the page" and client.get("/assets/a.js").text == "1"
    (tmp_path / "page" / "assets" / "a.js.gz").write_bytes(gzip.compress(b"compressed"))
    compressed, plain = ("compressed", "gzip"), ("1", None)
    for accepted, expected in (("gzip, br", compressed), ("identity", plain), ("gzip;q=0", plain)):
        given = {"accept-encoding": accepted}
        answer, head = (ask("/assets/a.js", headers=given) for ask in (client.get, client.head))
        assert (answer.text, answer.headers.get("content-encoding")) == expected
        assert answer.headers["vary"] == "Accept-Encoding" and "javascript" in answer.headers["content-type"]
        assert (head.status_code, head.headers["content-length"]) == (200, answer.headers["content-length"])
    part = client.get("/assets/a.js", headers={"accept-encoding": "identity", "range": "bytes=0-0"})
    assert (part.status_code, part.text, part.headers["content-range"]) == (206, "1", "bytes 0-0/1")
    assert "content-encoding" not in client.get("/api/runs", headers={"accept-encoding": "gzip"}).headers  # no secrets
    for path in ("/../../secret", "/%2e%2e/%2e%2e/secret", "//etc/passwd", "/link", "/"):
        assert client.get(f"/assets{path}").status_code == 404, path


def test_a_slow_body_and_slow_work_end(monkeypatch, tmp_path):
    served, go = make_served(tmp_path), threading.Event()
    monkeypatch.setattr(app_module, "_BODY_TIMEOUT", 0.3)
    monkeypatch.setattr(app_module, "REQUEST_TIMEOUT", 1.0)
    monkeypatch.setattr(served, "read", lambda texts: go.wait(60))
    with running(make_server(served, port=0)) as port:
        for body, length, codes in ((b"", 99, (b"408", b"504")), (b'{"texts": ["blue"]}', 19, (b"504",))):
            with socket.create_connection(("127.0.0.1", port), 60) as line:
                head = f"POST {RUN}/query HTTP/1.1\r\nHost: localhost:{port}\r\nContent-Length: {length}\r\n\r\n"
                line.sendall(head.encode() + body)
                assert line.recv(100).split()[1] in codes
        go.set()


def test_many_clients_at_a_time(tmp_path):
    words = (("red",), ("blue",), ("green",), ("red", "blue"), ("blue", "green"))
    with running(make_server(make_served(tmp_path), port=0)) as port:

        def ask(number: int) -> bool:
            remote = connect(f"127.0.0.1:{port}")
            asked = [(texts, remote.ask(*texts, threshold=0.5)) for texts in 4 * words[number % 5 :]]
            return all(answer.selected.shape == (256, len(texts)) == (256, len(answer)) for texts, answer in asked)

        with ThreadPoolExecutor(16) as pool:
            assert all(pool.map(ask, range(16)))


def test_runs_are_closed_when_memory_is_scarce_but_not_those_with_pages(tmp_path, monkeypatch):
    open_one = Mock(side_effect=lambda config: make_served(tmp_path).run)
    monkeypatch.setattr(runs_module, "_estimated_bytes", lambda run: 10)
    configs = [tmp_path / name / "normlift" / "one" / "config.yml" for name in ("fox", "castle", "fox")]
    store = RunStore(configs, open_one, memory_limit=25)
    assert store.ids == ["fox-one", "castle-one", "fox-one-3"]
    first = store.get("fox-one")
    first.remember("token", object())
    for name in ("castle-one", "fox-one-3", "fox-one", "fox-one-3", "castle-one"):
        store.get(name)
    assert open_one.call_count == 4  # castle-one twice
    assert store.get("fox-one") is first
    with pytest.raises(InputError, match="fox-one, castle-one"):
        store.get("other")
    assert isinstance(first.space.field, SemanticField)


def test_runs_that_cannot_be_opened_are_not_listed(tmp_path, monkeypatch):
    warm = []

    def open_one(config):
        if config.parts[-4] in broken:
            raise InputError(f"{config} is missing")
        return make_served(tmp_path).run

    monkeypatch.setattr(runs_module, "_estimated_bytes", lambda run: 10)
    monkeypatch.setattr(runs_module.ServedRun, "warm_up", lambda served, wait: warm.append(served.id))
    configs = [tmp_path / name / "normlift" / "one" / "config.yml" for name in ("fox", "castle", "room")]
    broken, store = {"fox", "castle", "room"}, RunStore(configs, open_one, memory_limit=5, max_gaussians=7)
    server = WarmServer(store, ServerOptions())
    with client_of(server) as client:
        answer = client.get("/api/runs")
        assert answer.status_code == 400 and answer.json()["error"] == "config.yml is missing"
        broken -= {"fox", "room"}
        assert [run["id"] for run in client.get("/api/runs").json()["runs"]] == ["fox-one", "room-one"]
    assert len(store.get("room-one").rows) == 7
    server.warm_up()
    assert warm == ["room-one"]  # fox-one does not fit into the memory


@pytest.mark.slow
def test_a_request_that_does_not_arrive_in_time_is_closed(tmp_path, monkeypatch):
    monkeypatch.setattr(app_module, "_HEADER_TIMEOUT", 0.3)
    monkeypatch.setattr(app_module, "_KEEP_ALIVE", 1)
    request = b"GET /api/runs HTTP/1.1\r\nHost: localhost\r\n\r\n"
    with running(WarmServer(RunStore([], open_run), ServerOptions(port=0))) as port:
        for first in (b"", request[:20], request + request[:20]):  # nothing, a part, a part after a whole one
            with socket.create_connection(("127.0.0.1", port), timeout=20) as line:
                line.sendall(first)
                received = b"".join(iter(lambda: line.recv(4096), b""))
            assert received.count(b'{"runs":[]}') == (len(first) > len(request))
        with socket.create_connection(("127.0.0.1", port), timeout=20) as line:
            for _ in range(2):  # a connection may rest between requests
                line.sendall(request)
                received = b""
                while not received.endswith(b'{"runs":[]}'):
                    received += line.recv(4096)
                    assert received.startswith(b"HTTP/1.1 200")
                time.sleep(0.6)


def test_a_page_may_rest(tmp_path, monkeypatch):
    monkeypatch.setattr(app_module, "_HEADER_TIMEOUT", 0.3)
    with (
        running(make_server(make_served(tmp_path), port=0)) as port,
        connect_websocket(f"ws://127.0.0.1:{port}{RUN}/session") as line,
    ):
        line.send(json.dumps({"action": "greet", "value": {"token": "one"}, "seq": 1}))
        time.sleep(1)
        line.send(json.dumps({"action": "link", "seq": 2}))
        assert any(json.loads(text)["seq"] == 2 for text in line if isinstance(text, str))
