"""Messages between a page and the server: actions and the types of their values, and the colors of a state.

Colors are sent as a palette and one byte per Gaussian on the page: an index into the palette, or `NOT_DRAWN`.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal, NamedTuple, get_args

import msgspec
import numpy as np
import torch
from jaxtyping import Float, UInt8

from normlift_ns.core.gaussians import Camera
from normlift_ns.errors import InputError
from normlift_ns.options import RelevancyRule
from normlift_ns.rendering.colors import RELIABILITY_COLORMAP, RGB, Colormap, colormap_rgb, prompt_rgb_tuples
from normlift_ns.rendering.figures import map_scale
from normlift_ns.server.permalink import Finite, Greeting, PageView, Side, Vector
from normlift_ns.session.state import State

# Actions and their values.


ColorMode = Literal["overlay", "heat", "prompts", "reliability", "rgb", "pca"]
"""Coloring of the scene. overlay: selected Gaussians in the color of their most relevant prompt, stronger for higher
relevancy. prompts: the same at full strength. heat: relevancy of all Gaussians with a direction, in a colormap.
reliability: R in a colormap from 0 to 1. rgb: trained colors. pca: three principal components of the features as RGB.
"""
COLOR_MODES: tuple[ColorMode, ...] = get_args(ColorMode)
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
    """Ray of a click; the mode "like" searches for all Gaussians similar to the clicked one."""

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
    """Request to show or hide a layer."""

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


# Colors of a state as a palette and one byte per drawn Gaussian.


NOT_DRAWN = 255
"""Code of Gaussians that the user has hidden. All other codes are indices into the palette."""
BY_HAND_COLOR: RGB = (1.0, 0.75, 0.1)
_OWN, _GRAY = 0, 1
"""Codes of the trained color, and of its dimmed gray value."""
_FIRST, _CODES = 2, 253
"""First code for the colors of a color mode, and the number of codes for these colors."""
_MIN_SHARE, _FULL_SHARE = 0.45, 0.85
"""Opacity of a prompt's color over gray, at the threshold and at the highest relevancy."""
_MIN_SPAN = 0.05
_MIN_LUMINANCE = 0.4
_LUMINANCE = (0.2126, 0.7152, 0.0722)
_PCA_LEVELS = 6
_PCA_QUANTILES = (0.02, 0.98)


class Codes(NamedTuple):
    """Colors of M Gaussians: a palette, and one code per Gaussian, an index into the palette or `NOT_DRAWN`."""

    palette: list[tuple[int, int, int, float, int]]
    """Red, green and blue in 0..255, the opacity of this color, and the color under it (0: trained color, 1: gray).
    """
    codes: UInt8[np.ndarray, " m"]


def make_codes(state: State, rows: np.ndarray, pca: Float[torch.Tensor, "n 3"] | None = None) -> Codes:
    """Return the colors of the Gaussians on the page.

    Args:
        rows: Indices of these Gaussians in the scene; see `ServedRun.rows`.
        pca: Principal components of all Gaussians, in 0..1; needed for the color mode pca.
    """
    table: list[tuple[int, int, int, float, int]] = [(0, 0, 0, 0.0, 0), (0, 0, 0, 0.0, 1)]
    codes = np.full(len(rows), _OWN)
    mode = state.color_mode
    if mode == "reliability":
        codes = _ramp(_rows(state.space.field.scalars.reliability, rows), 0.0, 1.0)
        table += [(*rgb, 1.0, 0) for rgb in _colormap(RELIABILITY_COLORMAP)]
    elif mode == "pca" and pca is not None:
        steps = np.round(_rows(pca, rows) * (_PCA_LEVELS - 1)).astype(int).clip(0, _PCA_LEVELS - 1)
        codes = _FIRST + steps @ np.array([_PCA_LEVELS**2, _PCA_LEVELS, 1])
        levels = np.round(np.linspace(0, 255, _PCA_LEVELS)).astype(int).tolist()
        table += [(r, g, b, 1.0, 0) for r in levels for g in levels for b in levels]
    elif mode == "heat" and state.answer is not None:
        relevancy, low, high = _relevancy(state), *heat_scale(state)
        codes = np.where(_rows(state.answer.valid, rows), _ramp(_rows(relevancy, rows), low, high), _GRAY)
        table += [(*rgb, _FULL_SHARE, 1) for rgb in _colormap(state.colormap)]
    elif mode in ("overlay", "prompts", "heat"):
        codes = _prompt_codes(state, rows, table, full=mode == "prompts")
    codes = np.where(_rows(state.drawn, rows), codes, NOT_DRAWN)
    return Codes(table, codes.astype(np.uint8))


def prompt_display_colors(state: State) -> list[RGB]:
    """Return the colors of the prompts, lightened so that they are visible in a dark scene."""
    return [] if state.answer is None else [_lightened(color) for color in prompt_rgb_tuples(state.answer.texts)]


def legend(state: State) -> dict[str, Any] | None:
    """Return the end values, label and colors of the color scale of a state; None if it has no scale."""
    if state.color_mode == "reliability":
        low, high, label, colors = 0.0, 1.0, "reliability R", _colormap(RELIABILITY_COLORMAP)
    elif state.answer is None or not state.prompts_select or state.color_mode not in ("overlay", "heat"):
        return None
    elif state.color_mode == "heat":
        (low, high), label, colors = heat_scale(state), "relevancy", _colormap(state.colormap)
    elif state.shown is None and len(state.answer.texts) > 1:
        return None
    else:
        low, high = overlay_scale(state)
        color = _bytes(prompt_display_colors(state)[state.shown or 0])
        label, shares = "relevancy", np.linspace(_MIN_SHARE, _FULL_SHARE, 6)[:, None]
        colors = np.round(shares * color + (1 - shares) * 96).astype(int).tolist()
    return {"low": low, "high": high, "label": label, "colors": colors[:: max(1, len(colors) // 6)]}


def overlay_scale(state: State) -> tuple[float, float]:
    """Return the relevancies that get the weakest and the strongest color.

    The first is the threshold. The second is the highest relevancy, at most 1, but at least 0.05 above the threshold.
    """
    assert state.answer is not None
    relevancy = _relevancy(state)[state.answer.valid]
    low = state.answer.question.threshold
    return low, max(min(1.0, float(relevancy.max())) if len(relevancy) > 0 else low, low + _MIN_SPAN)


def heat_scale(state: State) -> tuple[float, float]:
    """Return the relevancies that get the first and the last color of the heat map."""
    assert state.answer is not None
    low, high = map_scale(state.answer)
    return low, max(min(1.0, high), low + _MIN_SPAN)


def pca_of(directions: Float[torch.Tensor, "m d"]) -> tuple[Float[torch.Tensor, "3 d"], Float[torch.Tensor, "3 2"]]:
    """Return the three principal axes of a sample of directions, and the 2 % and 98 % quantiles along each axis."""
    centered = directions.double() - directions.double().mean(dim=0)
    _, vectors = torch.linalg.eigh(centered.T @ centered)
    axes = vectors[:, -3:].T.flip(0)
    ends = torch.tensor(_PCA_QUANTILES, dtype=torch.float64)
    return axes, torch.quantile(directions.double() @ axes.T, ends, dim=0).T


def _prompt_codes(state: State, rows: np.ndarray, table: list[Any], *, full: bool) -> np.ndarray:
    """Append the colors of the prompts to the palette `table`, and return the codes of the Gaussians `rows`."""
    selection = _rows(state.selection, rows)
    answer = state.answer if state.prompts_select else None
    table.append((*_bytes(BY_HAND_COLOR), _FULL_SHARE, 1))
    codes = np.where(selection, _FIRST, _GRAY)
    if answer is None:
        return codes if bool(state.selection.any()) else np.full(len(rows), _OWN)
    prompts = range(len(answer.texts)) if state.shown is None else [state.shown]
    levels = 1 if full else (_CODES - 1) // len(answer.texts)
    low, high = overlay_scale(state)
    relevancy = answer.relevancy.where(answer.selected, -torch.inf)[:, list(prompts)]
    value, best = (_rows(x, rows) for x in relevancy.max(dim=1))
    asked = selection & np.isfinite(value)
    step = np.nan_to_num((value - low) / (high - low), neginf=0.0).clip(0, 1)
    level = np.round(step * (levels - 1)).astype(int)
    colors = [_bytes(color) for color in prompt_display_colors(state)]
    for prompt in prompts:
        shares = [_FULL_SHARE] if levels == 1 else np.linspace(_MIN_SHARE, _FULL_SHARE, levels).tolist()
        table += [(*colors[prompt], share, 1) for share in shares]
    return np.where(asked, _FIRST + 1 + best * levels + level, codes)


def _relevancy(state: State) -> torch.Tensor:
    assert state.answer is not None
    relevancy = state.answer.relevancy
    return relevancy.amax(dim=1) if state.shown is None else relevancy[:, state.shown]


def _ramp(values: np.ndarray, low: float, high: float) -> np.ndarray:
    step = np.nan_to_num((values - low) / (high - low)).clip(0, 1)
    return _FIRST + np.round(step * (_CODES - 1)).astype(int)


def _colormap(name: Any) -> list[tuple[int, int, int]]:
    picked = torch.linspace(0, 255, _CODES).round().long()
    return [tuple(row) for row in (colormap_rgb(name)[picked] * 255).round().int().tolist()]


def _lightened(color: RGB) -> RGB:
    """Mix a dark color with white so that its luminance is `_MIN_LUMINANCE`.

    >>> [round(x, 2) for x in _lightened((0.2, 0.0, 0.25))]
    [0.49, 0.36, 0.52]
    """
    luminance = sum(weight * x for weight, x in zip(_LUMINANCE, color))
    white = max(0.0, (_MIN_LUMINANCE - luminance) / (1 - luminance)) if luminance < _MIN_LUMINANCE else 0.0
    red, green, blue = ((1 - white) * x + white for x in color)
    return red, green, blue


def _bytes(color: RGB) -> tuple[int, int, int]:
    red, green, blue = (round(255 * x) for x in color)
    return red, green, blue


def _rows(values: torch.Tensor, rows: np.ndarray) -> np.ndarray:
    return values.detach().cpu().numpy()[rows]
