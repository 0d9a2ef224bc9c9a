"""Gaussians as a browser draws them: one record of 32 bytes each, in units that suit a browser."""

from __future__ import annotations

import base64
import binascii
import dataclasses
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import msgspec
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8, UInt32
from torch import Tensor

from normlift_ns.analysis.explain import RecordedVotes
from normlift_ns.analysis.objects import find_floaters
from normlift_ns.core.gaussians import MIN_OPACITY, SH_C0, Camera, GaussianScene
from normlift_ns.core.scene import Scene
from normlift_ns.errors import InputError
from normlift_ns.exports import TrainedSplat
from normlift_ns.io.run_dir import FIELD_FOLDER
from normlift_ns.query.question import Query, load_query
from normlift_ns.rasterization.rasterize import ray_weights
from normlift_ns.rendering.colors import prompt_rgb_tuples
from normlift_ns.session.outputs import splat_bytes, store_query
from normlift_ns.session.prompts import join_prompts, prompts_of_query
from normlift_ns.session.selection import SelectionContext
from normlift_ns.session.state import State
from normlift_ns.viewer.controller import Session

MOST_DRAWN = 1_000_000
"""Gaussians that a browser sorts and draws without stuttering; more cost memory of its tab."""
BYTES = 32
_THINNEST = 1e-4
"""Least standard deviation, as a share of the largest: what is thinner is not to be seen."""
_EXTENT = 3.0
"""Half the size of the scene in the browser, whose cameras have clipping planes at 0.01 and 1000."""


@dataclass(frozen=True)
class Units:
    """From the scene's own units to those of the browser: (place - centre) * factor."""

    centre: tuple[float, float, float]
    factor: float

    @staticmethod
    def of(cameras: Sequence[Camera], means: Float[np.ndarray, "m 3"]) -> Units:
        """Such that cameras and most Gaussians are within a few units of the origin."""
        poses = [np.linalg.inv(camera.world_to_camera.double().cpu().numpy())[:3, 3] for camera in cameras]
        places = np.concatenate([np.array(poses).reshape(-1, 3), means[:: 1 + len(means) // 10_000]])
        places = places[np.isfinite(places).all(axis=1)]
        if len(places) == 0:
            return Units((0.0, 0.0, 0.0), 1.0)
        centre = np.median(places, axis=0)
        size = float(np.quantile(np.abs(places - centre).max(axis=1), 0.8))
        return Units(tuple(centre.tolist()), _EXTENT / size if size > 0 else 1.0)  # pyright: ignore[reportArgumentType]

    def to_browser(self, place: Sequence[float] | np.ndarray) -> np.ndarray:
        """A place of the scene as the browser has it."""
        return (np.asarray(place, float) - self.centre) * self.factor

    def to_scene(self, place: Sequence[float] | np.ndarray) -> np.ndarray:
        """The inverse of `to_browser`."""
        return np.asarray(place, float) / self.factor + self.centre


@dataclass(frozen=True, eq=False)
class Records:
    """The Gaussians that can be drawn in a browser."""

    rows: np.ndarray
    """Their numbers in the scene, ascending."""
    table: UInt32[np.ndarray, "m 8"]
    """Centre (3 float32), one unused word, Cholesky factor of the covariance (6 float16), and room for the colour."""
    alpha: UInt8[np.ndarray, " m"]
    """Opacities."""
    colours: UInt8[np.ndarray, "m 3"]
    """Of the scene itself: spherical harmonics of degree 0."""
    left_out: int
    """Gaussians that would be seen, but are too many."""
    units: Units

    @property
    def facts(self) -> str:
        """What a person should know of them."""
        facts = f"{len(self.rows):,} Gaussians are drawn, in the colours of spherical harmonics of degree 0."
        if self.left_out > 0:
            facts += f" {self.left_out:,} more are left out, the faintest and smallest: browsers bear no more."
        return facts

    def buffer(
        self,
        colours: UInt8[np.ndarray, "m 3"],
        drawn: Bool[np.ndarray, " m"],
        alpha: UInt8[np.ndarray, " m"] | None = None,
    ) -> UInt32[np.ndarray, "k 8"]:
        """The records of those that are drawn, coloured.

        Args:
            alpha: opacities in place of their own.
        """
        alpha = self.alpha if alpha is None else alpha
        rgba = np.concatenate([colours, alpha[:, None]], axis=1)[drawn]
        found = self.table[drawn]
        found[:, 7] = np.ascontiguousarray(rgba).view(np.uint32)[:, 0]
        return found


def make_records(scene: Scene, most: int = MOST_DRAWN) -> Records:
    """The records of a scene: of what can be seen, the most opaque and largest where that is more than `most`."""
    gaussians, parameters = scene.gaussians, scene.parameters
    seen = gaussians.drawable & (gaussians.opacities >= MIN_OPACITY)
    rows = seen.nonzero().squeeze(1)
    left_out = max(0, len(rows) - most)
    if left_out > 0:
        largest = gaussians.scales[rows].double().topk(2, dim=1).values.prod(dim=1)
        rows = rows[(gaussians.opacities[rows] * largest).topk(most).indices].sort().values
    means = gaussians.means[rows].double().cpu().numpy()
    units = Units.of(scene.train.cameras, means)
    constant = parameters["features_dc"][rows].float()
    rgb = constant * SH_C0 + 0.5 if scene.has_harmonics else torch.sigmoid(constant)
    table = np.zeros((len(rows), 8), np.uint32)
    table[:, :3] = np.ascontiguousarray(units.to_browser(means), np.float32).view(np.uint32)
    factors = cholesky(gaussians, rows) * units.factor
    table[:, 4:7] = np.ascontiguousarray(factors.clip(-65504, 65504), np.float16).view(np.uint32)
    alpha = _bytes(gaussians.opacities[rows].cpu().numpy())
    return Records(rows.cpu().numpy(), table, alpha, _bytes(rgb.nan_to_num().cpu().numpy()), left_out, units)


def cholesky(gaussians: GaussianScene, rows: torch.Tensor) -> Float[np.ndarray, "m 6"]:
    """L00, L10, L20, L11, L21, L22 with L L^T the covariance, in the scene's own units; flat Gaussians are given a
    thickness of 1e-4 of their size.
    """
    quats = torch.nn.functional.normalize(gaussians.quats[rows].double(), dim=1).cpu().numpy()
    scales = gaussians.scales[rows].double().cpu().numpy()
    scales = np.maximum(scales, np.maximum(_THINNEST * scales.max(axis=1, initial=0, keepdims=True), 1e-30))
    size = scales.max(axis=1, initial=0)
    w, x, y, z = quats.T
    rotation = np.stack(
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
         2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
         2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=1,
    ).reshape(-1, 3, 3)  # fmt: skip
    axes = rotation * (scales / size[:, None])[:, None, :]
    a, b, c = axes[:, 0], axes[:, 1], axes[:, 2]
    first = np.sqrt((a * a).sum(1))  # Gram and Schmidt: no difference of squares, so that thin ones stay positive
    unit = a / first[:, None]
    l10, l20 = (b * unit).sum(1), (c * unit).sum(1)
    rest = b - l10[:, None] * unit
    second = np.sqrt((rest * rest).sum(1))
    unit = rest / np.maximum(second, 1e-300)[:, None]
    l21 = (c * unit).sum(1)
    last = c - l20[:, None] * (a / first[:, None]) - l21[:, None] * unit
    third = np.sqrt((last * last).sum(1))
    return np.stack([first, l10, l20, second, l21, third], axis=1) * size[:, None]


def _bytes(values: np.ndarray) -> np.ndarray:
    return (values.clip(0, 1) * 255).round().astype(np.uint8)


# What a state looks like: a colour for every Gaussian, and a legend in words and colours.


Look = Literal["rgb", "overlay", "prompts", "reliability"]
LOOKS: tuple[Look, ...] = get_args(Look)
"""colours: the scene itself. overlay: relevancy of what is selected. prompts: the colour of the most relevant prompt.
reliability: R, on a fixed scale."""
_MAP = "viridis"
_HAND = (1.0, 0.75, 0.1)
_LEAST_SPAN = 0.05
_FAINT, _SEEN = 64, 160
"""Opacities of 255: a selection whose median is below the first is drawn with the second."""
_WEAKEST = 0.45
"""Opacity of the overlay at the threshold; it is 1 at the best match."""


def painted(records: Records, state: State) -> tuple[UInt8[np.ndarray, "m 3"], Bool[np.ndarray, " m"]]:
    """Colours of the records, and which of them are drawn."""
    rows = records.rows
    drawn = _array(state.drawn)[rows]
    colours = records.colours
    if state.color_mode == "reliability":
        return _ramp(_array(state.space.field.scalars.reliability)[rows]), drawn
    if state.color_mode == "rgb":
        return colours, drawn
    chosen = _array(state.selection)[rows]
    grey = np.repeat((colours @ np.array([0.3, 0.59, 0.11]) * 0.8).astype(np.uint8)[:, None], 3, axis=1)
    share, over = _overlay(state, rows) if state.color_mode == "overlay" else _prompts(state, rows)
    mixed = (1 - share[:, None]) * grey + share[:, None] * over
    return np.where(chosen[:, None], mixed.round().astype(np.uint8), grey), drawn


def opacities(records: Records, state: State) -> UInt8[np.ndarray, " m"]:
    """Opacities of the records: their own, but what is selected by hand and faint, such as floaters, is drawn so that
    it can be seen.
    """
    chosen = _array(state.selection)[records.rows]
    by_hand = state.color_mode == "overlay" and (state.answer is None or not state.prompts_select)
    if not by_hand or not chosen.any() or np.median(records.alpha[chosen]) >= _FAINT:
        return records.alpha
    return np.where(chosen, np.maximum(records.alpha, _SEEN), records.alpha).astype(np.uint8)


def coloured(state: State) -> State:
    """The state, with what is selected in colours where it would not be seen."""
    return replace(state, color_mode="overlay") if state.color_mode == "rgb" else state


def scale(state: State) -> tuple[float, float]:
    """Relevancies of the first and the last colour of the overlay: the threshold, and the best match in the scene."""
    answer = state.answer
    if answer is None:
        return 0.0, 1.0
    relevancy = answer.relevancy[answer.valid]
    relevancy = relevancy if state.shown is None else relevancy[:, state.shown]
    low = answer.question.threshold
    return low, max(float(relevancy.max()) if relevancy.numel() > 0 else low, low + _LEAST_SPAN)


def legend(state: State) -> str:
    """Return the color bar with the values at its ends, as MDX.

    It is empty if the scene keeps its own colors, or if colors only mark the selection.
    """
    by_hand = state.answer is None or not state.prompts_select
    if state.color_mode in ("rgb", "prompts") or (state.color_mode == "overlay" and by_hand):
        return ""
    low, high, what = (0.0, 1.0, "reliability R") if state.color_mode == "reliability" else (*scale(state), "relevancy")
    stops = ",".join(f"rgb({r},{g},{b})" for r, g, b in _ramp(np.linspace(0, 1, 6)).tolist())
    style = f'{{{{background: "linear-gradient(to right,{stops})", height: "0.6em", borderRadius: "3px"}}}}'
    return f"<div style={style}></div>\n\n{low:.2f} {what} {high:.2f}"


def _overlay(state: State, rows: np.ndarray) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, "m 3"]]:
    if state.answer is None or not state.prompts_select:
        return np.ones(len(rows)), np.broadcast_to(np.array(_HAND) * 255, (len(rows), 3))
    answer = state.answer
    relevancy = _array(answer.relevancy.amax(dim=1) if state.shown is None else answer.relevancy[:, state.shown])[rows]
    low, high = scale(state)
    step = ((relevancy - low) / (high - low)).clip(0, 1)
    return _WEAKEST + (1 - _WEAKEST) * step, _ramp(step).astype(float)


def _prompts(state: State, rows: np.ndarray) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, "m 3"]]:
    colours = np.array([_HAND])
    best = np.zeros(len(rows), int)
    if state.answer is not None and state.prompts_select:
        colours = np.array(prompt_rgb_tuples(state.answer.texts))
        relevancy = state.answer.relevancy.where(state.answer.selected, -9.0)
        best = _array(relevancy.argmax(dim=1))[rows] if state.shown is None else np.full(len(rows), state.shown)
    return np.full(len(rows), 0.85), colours[best] * 255


def _ramp(values: np.ndarray) -> UInt8[np.ndarray, "m 3"]:
    return _colour_map()[(np.nan_to_num(values).clip(0, 1) * 255).round().astype(int)]


@cache
def _colour_map() -> UInt8[np.ndarray, "256 3"]:
    from matplotlib import colormaps  # noqa: PLC0415 (--help should not wait for it)

    return (colormaps[_MAP](np.arange(256))[:, :3] * 255).round().astype(np.uint8)


def _array(values: Tensor) -> np.ndarray:
    return values.detach().cpu().numpy()


# What a link carries: the question and the camera, as the query of an address.


_LONGEST = 6000
"""Characters; a server refuses lines of 8 KB."""
Finite = Annotated[float, msgspec.Meta(ge=-1e30, le=1e30)]
Place = tuple[Finite, Finite, Finite]


class View(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A camera, in the scene's own units."""

    position: Place
    look_at: Place
    up: Place
    fov: Annotated[float, msgspec.Meta(gt=0, lt=3.14)]

    @property
    def looks(self) -> bool:
        """Whether it looks anywhere: not at where it is, and not along its vertical."""
        ahead = np.subtract(self.look_at, self.position)
        return bool(np.linalg.norm(np.cross(ahead, self.up)) > 0)


class Link(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """A question and a camera."""

    prompts: str = ""
    clicks: dict[str, Annotated[int, msgspec.Meta(ge=0)]] = {}
    """The clicks among the prompts, by the Gaussians that were clicked."""
    threshold: Finite | None = None
    """The threshold that the person chose; None: the default one."""
    min_reliability: Annotated[float, msgspec.Meta(ge=0, le=1)] = 0.0
    look: str = "overlay"
    view: View | None = None


class Hello(msgspec.Struct, frozen=True):
    """What the page says when it opens, and again when a key is pressed or let go that clicks go by."""

    token: Annotated[str, msgspec.Meta(min_length=1, max_length=100)]
    link: Annotated[str, msgspec.Meta(max_length=_LONGEST)] = ""
    webgl: bool = True
    held: Literal["", "Add", "Take away"] = ""
    """What the key does that is held down."""


def link_of(state: State, clicks: Mapping[str, int], view: View) -> Link:
    """A link to what a person sees.

    Args:
        clicks: Gaussians that were clicked, by the names of the prompts.
    """
    question = state.query
    if question is None:
        return Link(view=view, look=state.color_mode)
    asked = {name: gaussian for name, gaussian in clicks.items() if name in question.texts}
    line = join_prompts(question.texts)
    threshold = None if question.gated else question.threshold
    return Link(line, asked, threshold, question.min_reliability, state.color_mode, view)


def write_link(link: Link) -> str:
    """As the query of an address.

    Raises:
        ValueError: a question that is too long for an address.

    >>> read_link(write_link(Link("red, blue"))).prompts
    'red, blue'
    """
    found = "q=" + base64.urlsafe_b64encode(msgspec.json.encode(link)).decode().rstrip("=")
    if len(found) > _LONGEST:
        raise InputError(
            f"These prompts make a link of {len(found):,} characters; browsers and servers take {_LONGEST:,}."
        )
    return found


def read_link(query: str) -> Link | None:
    """The inverse of `write_link`; None for a query that is no link of ours.

    Raises:
        ValueError: a link that is cut off or damaged.
    """
    if not query.startswith("q="):
        return None
    text = query.removeprefix("q=")
    try:
        return msgspec.json.decode(base64.urlsafe_b64decode(text + "=" * (-len(text) % 4)), type=Link)
    except (binascii.Error, ValueError, RecursionError) as error:
        raise InputError(f"The link of this page cannot be read ({error}); copy it again.") from error


def read_hello(text: str) -> Hello:
    """Return the first message of a page.

    Raises:
        ValueError: the text is not such a message.
    """
    try:
        return msgspec.json.decode(text, type=Hello)
    except (ValueError, RecursionError) as error:
        raise InputError(f"the page says {text[:80]!r}, which is no greeting: {error}") from error


# What all pages of a run share, and what is kept of one person.


@dataclass(frozen=True, eq=False)
class Run:
    """What all persons share."""

    folder: Path
    scene: Scene
    space: SelectionContext
    records: Records
    texts: Callable[[], Any]
    """The encoder of texts, loaded when it is first called."""
    readonly: bool = False
    votes: Callable[[], RecordedVotes] | None = None
    """What photographs said in the lift, opened when they are first wanted; None: nobody knows."""
    reading: threading.Lock = dataclasses.field(default_factory=threading.Lock)

    def weights(self, origin: Sequence[float], direction: Sequence[float]) -> Float[torch.Tensor, " n"]:
        """Of the Gaussians on a ray of the browser."""
        start = torch.from_numpy(self.records.units.to_scene(origin))
        return ray_weights(self.scene.gaussians, start, torch.tensor(direction, dtype=torch.float64))

    @cached_property
    def floaters(self) -> Bool[torch.Tensor, " n"]:
        """Gaussians that likely belong to no surface; takes seconds."""
        return find_floaters(self.scene.gaussians, self.space.field.scalars).mask

    def opened_votes(self) -> RecordedVotes:
        """What photographs said in the lift.

        Raises:
            ValueError: nobody knows.
        """
        if self.votes is None:
            raise InputError("This viewer was opened without the photographs of the run.")
        return self.votes()

    def read(self, texts: Sequence[str]) -> Any:
        """Texts to vectors, one at a time: an encoder must not be loaded twice."""
        with self.reading:
            return self.texts().rows(texts)

    def stored(self) -> dict[str, Any]:
        """Vectors of the prompts that the run stores."""
        return {row.text: row.vector for row in prompts_of_query(load_query(self.folder / FIELD_FOLDER))}

    def known(self, clicks: Mapping[str, int]) -> dict[str, Any]:
        """Vectors that need no encoder: of stored prompts, and of clicks.

        Raises:
            ValueError: a click on a Gaussian that this scene does not have.
        """
        for name, gaussian in clicks.items():
            if gaussian >= len(self.space):
                raise InputError(f"{name}: this scene has no Gaussian {gaussian:,}; the link is of another one")
        rows = self.space.field.directions(torch.tensor(list(clicks.values()), dtype=torch.long)).cpu().numpy()
        return {**self.stored(), **{name: row for name, row in zip(clicks, rows) if np.any(row)}}

    def save(self, question: Query | None) -> str:
        """Stores prompts beside those that the run stores; a message.

        Raises:
            ValueError: nothing is asked, or this may not be done; as `merge_queries`.
        """
        if self.readonly:
            raise InputError("This page may only look; nothing is stored in the run.")
        stored = store_query(self.folder / FIELD_FOLDER, question)
        return f"The run stores {stored} now, for ns-render and ns-viewer to draw."

    def exported(self, mask: Bool[torch.Tensor, " n"], name: str, state: State) -> tuple[str, bytes, str]:
        """Some Gaussians as a PLY file: its name, its content, and a message.

        Raises:
            ValueError: there are none, or none is ever drawn.
        """
        if not bool(mask.any()):
            raise InputError("Nothing is selected; there is nothing to export.")
        file, content, count = splat_bytes(TrainedSplat.of(self.scene), state, mask, name)
        faint = int(mask.sum()) - count
        why = f" {faint:,} more are too faint to be drawn (opacity below 1/255)." if faint > 0 else ""
        return file, content, f"{file} with {count:,} Gaussians goes to your downloads.{why}"


@dataclass(eq=False)
class Memory(Session):
    """What is kept of a person when the connection is lost; a click by the Gaussian that was clicked."""

    view: View | None = None
    link: str = ""
    """The last link that was followed or made here; it says nothing new."""
    page: int | None = None
    """Connection that currently shows this session."""
