"""A page without a browser, before a run of four cubes of Gaussians."""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from starlette.testclient import TestClient

from normlift_ns.core.partition import spatial_order
from normlift_ns.io.run_dir import FIELD_FOLDER
from normlift_ns.server.app import ServerOptions, WarmServer
from normlift_ns.server.runs import ServedRun
from tests.session.worlds import cubes, read
from tests.viewer.scenes import camera, scene_of, spheres

HOST = "http://localhost:7008"


def make_served(folder: Path, scene: Any = None, space: Any = None) -> ServedRun:
    """A run whose encoder knows three words."""
    space = cubes() if space is None else space
    scene = scene_of(spheres(space.means, 0.3), cameras=(camera(),)) if scene is None else scene
    scene.name, scene.colors = "cubes", lambda seen: scene.parameters["features_dc"] * 0.28209479177387814 + 0.5
    train = scene.train.cameras
    scene.train = Images(train)
    (folder / FIELD_FOLDER).mkdir(exist_ok=True)
    run = SimpleNamespace(folder=folder, scene=scene, field=space.field, texts=SimpleNamespace(rows=read))
    return ServedRun("cubes", run, 10**6)  # type: ignore[arg-type]


class Images(list):
    def __init__(self, cameras: Any) -> None:
        super().__init__(cameras)
        self.cameras, self.names = list(cameras), [f"images/{i}.png" for i in range(len(cameras))]

    def __getitem__(self, index: Any) -> Any:
        return SimpleNamespace(image=torch.full((12, 16, 3), 60, dtype=torch.uint8))


def make_server(served: ServedRun, **options: Any) -> WarmServer:
    runs: Any = SimpleNamespace(ids=[served.id], get=lambda name: served)
    return WarmServer(runs, ServerOptions(**options))


@contextmanager
def running(server: WarmServer, **how: Any) -> Iterator[int]:
    """The port of a server, which is stopped afterwards."""
    try:
        yield server.start(**how)
    finally:
        server.stop()


def client_of(server: WarmServer) -> TestClient:
    return TestClient(server.app(), base_url=HOST, raise_server_exceptions=False)


class Page:
    """A page that keeps what it is told."""

    def __init__(self, socket: Any) -> None:
        self.socket, self.seq, self.state, self.codes, self.palette = socket, 0, {}, np.zeros(0), []
        self.told: list[dict[str, Any]] = []

    def send(self, action: str, value: Any = None) -> int:
        self.seq += 1
        self.socket.send_text(json.dumps({"action": action, "value": value, "seq": self.seq}))
        return self.seq

    def receive(self) -> dict[str, Any]:
        message = self.socket.receive()
        if message["type"] == "websocket.close":
            raise ConnectionError(f"{message.get('code')} {message.get('reason')}")
        if message.get("bytes") is None:
            content = json.loads(message["text"])
        else:
            data = message["bytes"]
            (length,) = struct.unpack("<I", data[:4])
            content = json.loads(data[4 : 4 + length])
            content["payload"] = data[4 + length :]
        if content["type"] == "state":
            self.state = {**self.state, **{key: x for key, x in content.items() if x is not None or content["details"]}}
        if content["type"] == "codes":
            self.codes, self.palette = np.frombuffer(content["payload"], np.uint8), content["palette"]
        self.told.append(content)
        return content

    def do(self, action: str, value: Any = None, until: str = "state") -> dict[str, Any]:
        """Acts, and waits for an answer of a type; a message that reports an error ends it too."""
        seq = self.send(action, value)
        while True:
            message = self.receive()
            if message["seq"] != seq:
                continue
            if message["type"] == "message" and message["kind"] == "error":
                return message
            if message["type"] == until and (until != "state" or message["details"]):
                return message

    def refused(self, action: str, value: Any = None) -> str:
        message = self.do(action, value)
        assert message["type"] == "message" and message["kind"] == "error", message
        return message["text"]

    def color(self, gaussian: int) -> list[float] | None:
        """Entry of the palette of a Gaussian of the cubes, sent in spatial order; None: it is not drawn."""
        code = int(self.codes[int((spatial_order(cubes().means) == gaussian).nonzero())])
        return None if code == 255 else self.palette[code]


@contextmanager
def opened(client: TestClient, token: str = "one", run: str = "cubes", **greeting: Any) -> Any:
    with client.websocket_connect(f"{HOST.replace('http', 'ws')}/api/runs/{run}/session") as socket:
        page = Page(socket)
        page.do("greet", {"token": token, **greeting})
        yield page
