"""Messages from a page to the server: actions and the types of their values."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import msgspec
import torch

from normlift_ns.core.gaussians import Camera
from normlift_ns.errors import InputError
from normlift_ns.options import RelevancyRule
from normlift_ns.rendering.colors import Colormap
from normlift_ns.server.coloring import ColorMode
from normlift_ns.server.permalink import Finite, Greeting, PageView, Side, Vector

Text = Annotated[str, msgspec.Meta(max_length=4000)]
Texts = Annotated[list[Text], msgspec.Meta(max_length=64)]
Count = Annotated[int, msgspec.Meta(ge=0, le=2**31)]
Mode = Literal["select", "add", "remove"]
Points = Annotated[list[tuple[Finite, Finite]], msgspec.Meta(min_length=1, max_length=4000)]
MatrixRow = tuple[Finite, Finite, Finite, Finite]


class Message(msgspec.Struct, frozen=True):
    """Message from a page."""

    action: str
    value: msgspec.Raw = msgspec.Raw(b"null")
    seq: int = 0
    """Number of the message; responses repeat it."""


class Ask(msgspec.Struct, frozen=True):
    """Line of prompts, separated by commas, and negative prompts."""

    line: Text
    negatives: Texts | None = None


class CameraValue(msgspec.Struct, frozen=True):
    """Camera of a view, as in `core.gaussians.Camera`."""

    K: tuple[Vector, Vector, Vector]
    world_to_camera: tuple[MatrixRow, MatrixRow, MatrixRow, MatrixRow]
    width: Side
    height: Side

    def camera(self) -> Camera:
        """Return the camera; raise ValueError if it is not valid."""
        return Camera(torch.tensor(self.K), torch.tensor(self.world_to_camera), self.width, self.height)


class Ray(msgspec.Struct, frozen=True):
    """Ray in scene units."""

    origin: Vector
    direction: Vector


class Pick(Ray, frozen=True):
    """Click on a Gaussian; the mode "like" searches for all similar Gaussians."""

    mode: Literal["select", "add", "remove", "like"] = "select"


class Region(msgspec.Struct, frozen=True):
    """Polygon in pixel coordinates of a camera."""

    polygon: Points
    camera: CameraValue
    mode: Mode = "select"


class Brush(msgspec.Struct, frozen=True):
    """Brush stroke in pixel coordinates of a camera."""

    points: Points
    radius: Annotated[float, msgspec.Meta(gt=0, le=2000)]
    camera: CameraValue
    mode: Mode = "select"


class ObjectAction(msgspec.Struct, frozen=True):
    """Listed object to select, add or remove."""

    id: Count
    mode: Mode = "select"


class Target(msgspec.Struct, frozen=True):
    """Object or position to look at."""

    id: Count | None = None
    position: Vector | None = None


class Save(msgspec.Struct, frozen=True):
    """Request to store prompts in the run; `replace` deletes the prompts that are already stored."""

    replace: bool = False


class LayerName(msgspec.Struct, frozen=True):
    """Name of a layer."""

    name: Text


class LayerVisibility(LayerName, frozen=True):
    """Name of a layer to show or hide."""

    visible: bool


class Export(msgspec.Struct, frozen=True):
    """Request to download the selection or an object."""

    format: Annotated[str, msgspec.Meta(max_length=20)] = "ply"
    object: Count | None = None


class Still(msgspec.Struct, frozen=True):
    """Request for an image of the current view, rendered by the server."""

    max_size: Annotated[int, msgspec.Meta(ge=16, le=2048)] = 800
    background: tuple[float, float, float] = (1.0, 1.0, 1.0)


_Unit = Annotated[float, msgspec.Meta(ge=0, le=1)]
_Step = Annotated[int, msgspec.Meta(ge=-100, le=100)]
_COUNT: Any = Count
_TEXTS: Any = Texts
_IDS: Any = Annotated[list[Count], msgspec.Meta(max_length=1000)]
VALUES: dict[str, Any] = {
    **dict.fromkeys(
        ("cancel", "undo", "redo", "clear", "suggested", "invert", "show_all", "remove_weak", "floaters", "explain",
         "link"), Any,
    ),
    **dict.fromkeys(("hide", "isolate"), _IDS | None),
    **dict.fromkeys(("layer_add", "layer_select", "layer_remove"), LayerName),
    "greet": Greeting, "ask": Ask, "go_to_step": Count, "threshold": Finite, "reliability": _Unit,
    "show_prompt": _COUNT | None, "rule": RelevancyRule | Literal["auto"], "negatives": _TEXTS | None,
    "color_mode": ColorMode, "colormap": Colormap, "pick": Pick, "hover": Ray, "region": Region, "brush": Brush,
    "grow": _Step, "object": ObjectAction, "go_to": Target, "save_prompts": Save | None,
    "layer_visible": LayerVisibility, "export": Export, "camera": PageView, "still": Still,
}  # fmt: skip
"""Type of the value of each action."""


def read_message(text: str | bytes) -> Message:
    """Decode a message from a page.

    Raises:
        ValueError: `text` is not a valid message.
    """
    return decode(text, Message)


def read_value(message: Message) -> Any:
    """Decode the value of a message.

    Raises:
        ValueError: The action is unknown, or its value is not valid.
    """
    if message.action not in VALUES:
        raise InputError(f"The server does not support the action {message.action[:40]!r}. Reload the page.")
    kind = VALUES[message.action]
    return None if kind is Any else decode(message.value, kind)


def decode(text: str | bytes | msgspec.Raw, kind: Any) -> Any:
    """Decode JSON to the type `kind`.

    Raises:
        ValueError: The JSON is malformed or does not match the type.
    """
    try:
        return msgspec.json.decode(text, type=kind)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise InputError(f"The request is not valid: {error}.") from error
