"""What goes over the line of a real server: an answer costs 32 bytes per drawn Gaussian, turning the camera nothing."""

from __future__ import annotations

import socket
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from websockets.sync.client import connect

from benchmarks.view import Client
from normlift_ns import Camera, GaussianScene
from normlift_ns.runs.files import FIELD_FOLDER
from normlift_ns.viewer.people import People
from normlift_ns.viewer.records import BYTES, make_records
from normlift_ns.viewer.serving.door import Door
from normlift_ns.viewer.shared import Run
from tests.session import worlds

pytest.importorskip("viser")
MOST_REST = 8_000
"""Bytes of widgets and headers, however large the scene is: less than one per Gaussian of the larger one here."""
CAMERA = {
    "type": "ViewerCameraMessage", "wxyz": [0, 1, 0, 0], "position": [0, 1, 0], "fov": 1.0, "aspect": 2.0,
    "look_at": [0, 0, 1], "up_direction": [0, 0, 1],
}  # fmt: skip


def served(side: int, tmp_path, monkeypatch) -> Door:
    monkeypatch.setattr(worlds, "SIDE", side)
    monkeypatch.setattr(worlds, "BLOCK", side**3)
    space = worlds.cubes()
    n = len(space)
    camera = Camera(torch.tensor([[50.0, 0, 8], [0, 50, 6], [0, 0, 1]]), torch.eye(4), 16, 12)
    gaussians = GaussianScene(space.means, torch.eye(4)[:1].expand(n, 4), torch.ones(n, 3), torch.full((n,), 0.9))
    scene: Any = SimpleNamespace(
        gaussians=gaussians, parameters={"features_dc": torch.zeros(n, 3)}, has_harmonics=True,
        rasterize_mode="classic", train=SimpleNamespace(cameras=[camera]),
    )  # fmt: skip
    (tmp_path / FIELD_FOLDER).mkdir(exist_ok=True)
    run = Run(tmp_path, scene, space, make_records(scene), lambda: SimpleNamespace(rows=worlds.read))
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    door, people = Door("127.0.0.1", port), People(run)
    door.open("", people.come, people.go)
    return door


def spent(client: Client, label: str, value: Any) -> tuple[int, int]:
    """Gaussians that are drawn after a widget is set, and bytes until nothing comes any more."""
    client.rest()
    client.bytes = 0
    client.set(label, value)
    count = client.splats()
    client.rest()
    return count, client.bytes


@pytest.mark.slow
def test_an_answer_costs_32_bytes_per_drawn_gaussian(tmp_path, monkeypatch):
    rests = []
    for side in (4, 14):
        door = served(side, tmp_path, monkeypatch)
        try:
            with connect(f"ws://127.0.0.1:{door.server.port}", max_size=None) as line:
                client, block = Client(line), side**3
                assert client.drawn == 4 * block
                for prompt in ("red", "blue", "red, blue", "red"):
                    client.set("Prompts", prompt)
                    count, total = spent(client, "Ask", True)
                    assert count == 4 * block
                    rests.append(total - BYTES * count)
                count, total = spent(client, "Selection", "Hide")
                assert count == 2 * block
                rests.append(total - BYTES * count)
                client.rest(quiet=3)  # what a person did before is done
                client.bytes = 0
                client.tell(CAMERA)
                client.rest()
                assert client.bytes == 0
        finally:
            door.server.stop()
    print("bytes of widgets and headers", rests)
    assert 0 < max(rests) <= MOST_REST
