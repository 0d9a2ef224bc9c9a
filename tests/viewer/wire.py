"""What goes over the line between viser and its page, for both lines of viser."""

import struct
from importlib.metadata import version
from typing import Any

import msgspec
from websockets.sync.client import ClientConnection, connect

ONE = int(version("viser").split(".")[0]) >= 1
"""Whether it is 1.x."""
_VIEW = {
    "type": "ViewerCameraMessage", "wxyz": [1, 0, 0, 0], "position": [0, 0, 0], "fov": 1.0, "look_at": [0, 0, 1],
    "up_direction": [0, 0, 1],
}  # fmt: skip
CAMERA = _VIEW | ({"near": 0.01, "far": 100.0, "image_height": 4, "image_width": 4} if ONE else {"aspect": 1.0})


def opened(port: int) -> ClientConnection:
    """A browser without a page, which has told its camera."""
    kinds: Any = [f"viser-v{version('viser')}"] if ONE else None
    browser = connect(f"ws://127.0.0.1:{port}", max_size=None, subprotocols=kinds)
    browser.send(msgspec.msgpack.encode(CAMERA))
    return browser


def messages(raw: Any) -> list[dict[str, Any]]:
    """The messages in what came; arrays as bytes."""
    if not ONE:
        return msgspec.msgpack.decode(raw)
    import zstandard  # noqa: PLC0415 (comes with viser 1.x)

    _, packed = struct.unpack("<QQ", raw[:16])
    found = msgspec.msgpack.decode(zstandard.ZstdDecompressor().decompress(raw[16 : 16 + packed]))
    arrays, at = [], 16 + packed
    for length in found["binaryBufferLengths"]:
        at += -at % 8
        arrays.append(raw[at : at + length])
        at += length
    return [_filled(message, arrays) for message in found["messages"]]


def _filled(value: Any, arrays: list[bytes]) -> Any:
    if isinstance(value, dict) and "__binary_index" in value:
        return arrays[value["__binary_index"]]
    if isinstance(value, dict):
        return {key: _filled(one, arrays) for key, one in value.items()}
    return [_filled(one, arrays) for one in value] if isinstance(value, list) else value
