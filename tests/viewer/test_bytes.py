"""What goes over the line of a real server: an answer costs 32 bytes per drawn Gaussian, turning the camera nothing."""

from importlib.util import find_spec

import pytest
from websockets.sync.client import connect

from normlift_ns.viewer.adapter import Door
from normlift_ns.viewer.person import People
from normlift_ns.viewer.shared import BYTES
from tests.session.worlds import cubes
from tests.viewer.scenes import free_port, run_of
from tests.viewer.wire import CAMERA

MOST_REST = 8_000
"""Bytes of widgets and headers, less than one per Gaussian."""


@pytest.mark.slow
@pytest.mark.skipif(find_spec("viser") is None, reason="viser is not installed")
def test_an_answer_costs_32_bytes_per_drawn_gaussian(tmp_path):
    from research.view import Client  # noqa: PLC0415

    rests, block = [], 14**3
    door, people = Door("127.0.0.1", free_port()), People(run_of(tmp_path, cubes(14)))
    door.open("", people.come, people.go)
    try:
        with connect(f"ws://127.0.0.1:{door.server.port}", max_size=None) as line:
            client = Client(line)
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
            client.tell(CAMERA | {"position": [0, 1, 0]})
            client.rest()
            assert client.bytes == 0
    finally:
        door.server.stop()
    print("bytes of widgets and headers", rests)
    assert 0 < max(rests) <= MOST_REST
