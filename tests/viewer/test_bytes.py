"""What goes over the line of a real server: an answer costs 32 bytes per drawn Gaussian, turning the camera nothing."""

from __future__ import annotations

import socket
from importlib.util import find_spec
from pathlib import Path

import pytest
from websockets.sync.client import connect

from normlift_ns.viewer.people import People
from normlift_ns.viewer.records import BYTES
from normlift_ns.viewer.serving.door import Door
from tests.session.worlds import cubes
from tests.viewer.scenes import run_of

MOST_REST = 8_000
"""Bytes of widgets and headers, however large the scene is: less than one per Gaussian of the larger one here."""
CAMERA = {
    "type": "ViewerCameraMessage", "wxyz": [0, 1, 0, 0], "position": [0, 1, 0], "fov": 1.0, "aspect": 2.0,
    "look_at": [0, 0, 1], "up_direction": [0, 0, 1],
}  # fmt: skip


def served(side: int, folder: Path) -> Door:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    door, people = Door("127.0.0.1", port), People(run_of(folder, cubes(side)))
    door.open("", people.come, people.go)
    return door


@pytest.mark.slow
@pytest.mark.skipif(find_spec("viser") is None, reason="viser is not installed")
def test_an_answer_costs_32_bytes_per_drawn_gaussian(tmp_path):
    from benchmarks.view import Client  # noqa: PLC0415

    rests = []
    for side in (4, 14):
        door = served(side, tmp_path)
        try:
            with connect(f"ws://127.0.0.1:{door.server.port}", max_size=None) as line:
                client, block = Client(line), side**3
                assert client.drawn == 4 * block
                for prompt, drawn in (("red", 4), ("blue", 4), ("red, blue", 4), ("red", 4), ("", 2)):
                    if prompt:
                        client.set("Prompts", prompt)
                    client.rest()
                    client.bytes = 0
                    client.set(*(("Ask", True) if prompt else ("Selection", "Hide")))
                    assert client.splats() == drawn * block
                    client.rest()
                    rests.append(client.bytes - BYTES * drawn * block)
                client.rest(quiet=3)  # what a person did before is done
                client.bytes = 0
                client.tell(CAMERA)
                client.rest()
                assert client.bytes == 0
        finally:
            door.server.stop()
    print("bytes of widgets and headers", rests)
    assert 0 < max(rests) <= MOST_REST
