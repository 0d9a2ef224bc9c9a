"""Open runs with the data that their pages share, and a store that keeps several runs within a memory limit."""

from __future__ import annotations

import io
import re
import secrets
import threading
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np
import torch
import xxhash
from jaxtyping import Bool, Float, UInt8
from PIL import Image

from normlift_ns.analysis.objects import find_floaters
from normlift_ns.core.gaussians import MIN_OPACITY, SH_C0, Camera, GaussianScene
from normlift_ns.core.partition import spatial_order
from normlift_ns.data.splat import SplatParameters
from normlift_ns.data.spz import encode_spz
from normlift_ns.errors import InputError
from normlift_ns.io.memory import free_memory
from normlift_ns.io.run_dir import FIELD_FOLDER
from normlift_ns.lifted_run import LiftedRun
from normlift_ns.query.engine import run_query
from normlift_ns.query.question import Query, join_prompts, load_query
from normlift_ns.query.text_encoder import encoder_name, own_words
from normlift_ns.rasterization.rasterize import ray_weights, render
from normlift_ns.server.permalink import PageView
from normlift_ns.server.protocol import NOT_DRAWN, Codes, pca_of
from normlift_ns.session.objects import LookAtTarget, ObjectRow, unoccluded_viewpoint
from normlift_ns.session.outputs import selection_bytes, store_query
from normlift_ns.session.prompts import build_query, encode_prompts, prompts_of_query
from normlift_ns.session.selection import SelectionContext
from normlift_ns.session.state import History, State

MAX_MEMORIES = 64
"""Maximum number of closed pages whose sessions are kept."""
_MAX_RESULTS, _MAX_RESULT_BYTES = 256, 2**26
"""Maximum number and total size in bytes of the cached results of a run."""
_SAMPLE = 4096
_NUM_EXAMPLES, _NUM_CANDIDATES = 4, 24
_BASIC_COLORS = ("red", "orange", "yellow", "green", "blue", "purple", "pink", "brown", "black", "white", "gray")
_FIELDS_OF_VIEW = (0.3, 1.9)
_GRAY_WEIGHTS, _GRAY_DIMMING = (0.3, 0.59, 0.11), 0.8
_JPEG_QUALITY = 85
_POSITION_STEP = 2**-14
"""Rounding step of the positions on the page, as a fraction of the radius of the scene."""
_MEMORY_SHARE = 0.5
"""Default fraction of the free memory that open runs may use."""
_render_lock = threading.Lock()
"""Lock for rendering, because numba's threading layer does not support two renders at the same time."""


T = TypeVar("T")


@dataclass(eq=False)
class PageMemory:
    """Data of the session of one page, kept after the page loses its connection."""

    history: History[State]
    line: str = ""
    """Text of the search box."""
    clicks: dict[str, int] = field(default_factory=dict)
    """Indices of clicked Gaussians, by the prompt texts that stand for the clicks."""
    negatives: tuple[str, ...] | None = None
    """Negative prompts of the next query; None for the defaults."""
    rule: str = "auto"
    min_reliability: float = 0.0
    view: PageView | None = None
    link: str = ""
    """Link that the page opened or created last."""
    page: object | None = None
    """Open page of this session; None if the page is closed."""


@dataclass(eq=False)
class ServedRun:
    """Open run, shared by all pages and requests.

    Args:
        max_gaussians: Maximum number of Gaussians to draw; large and opaque ones have priority.
    """

    id: str
    run: LiftedRun
    max_gaussians: int
    reading: threading.Lock = field(default_factory=threading.Lock)
    """Lock for the text encoder, so that only one thread at a time loads or uses it."""
    analyzing: threading.Lock = field(default_factory=threading.Lock)
    """Lock for computing votes, floaters and the inventory, each of which takes seconds, in one thread at a time."""
    _memories: OrderedDict[str, PageMemory] = field(default_factory=OrderedDict)
    _results: OrderedDict[bytes, tuple[Any, int]] = field(default_factory=OrderedDict)
    _memory_lock: threading.Lock = field(default_factory=threading.Lock)

    @cached_property
    def space(self) -> SelectionContext:
        """Semantic field of the run, with the centers of the Gaussians."""
        return SelectionContext(self.run.field, self.run.scene.gaussians.means.detach())

    @cached_property
    def visible(self) -> Bool[torch.Tensor, " n"]:
        """Mask of the Gaussians that can be drawn and are opaque enough to be visible."""
        gaussians = self.run.scene.gaussians
        return gaussians.drawable & (gaussians.opacities >= MIN_OPACITY)

    @cached_property
    def rows(self) -> np.ndarray:
        """Indices of the Gaussians that pages draw, in a spatial order that compresses well."""
        gaussians, rows = self.run.scene.gaussians, self.visible.nonzero().squeeze(1)
        if len(rows) > self.max_gaussians:
            largest = gaussians.scales[rows].double().topk(2, dim=1).values.prod(dim=1)
            rows = rows[(gaussians.opacities[rows] * largest).topk(self.max_gaussians).indices].sort().values
        return rows[spatial_order(gaussians.means[rows])].cpu().numpy()

    @cached_property
    def drawn_scene(self) -> GaussianScene:
        """Scene of the Gaussians in `rows`, on the CPU."""
        whole, rows = self.run.scene.gaussians, torch.from_numpy(self.rows)
        return whole.to("cpu").select(rows)

    @cached_property
    def geometry(self) -> tuple[bytes, str]:
        """The Gaussians in `rows` as SPZ, in the same order, and the digest of these bytes."""
        scene, rows = self.run.scene, torch.from_numpy(self.rows)
        values = {name: value.detach().float().cpu()[rows] for name, value in scene.parameters.items()}
        if not scene.has_harmonics:
            values["features_dc"] = (torch.sigmoid(values["features_dc"]) - 0.5) / SH_C0
            values["features_rest"] = values["features_rest"][:, :0]
        antialiased, step = scene.rasterize_mode == "antialiased", _POSITION_STEP * self.frame[2]
        content = encode_spz(SplatParameters(**values), antialiased=antialiased, position_step=step)
        return content, xxhash.xxh3_128_hexdigest(content)

    @cached_property
    def frame(self) -> tuple[list[float], list[float], float]:
        """Mean up direction of the cameras, center of the scene, and radius of the scene.

        The center is the median, along each axis, of the positions of the cameras and of a sample of the Gaussians in
        `rows`. The radius is half the side of the cube around the center that contains 80 % of these positions.
        """
        poses = [camera.world_to_camera.double().cpu().numpy() for camera in self.run.scene.train.cameras]
        up = -np.mean([pose[1, :3] for pose in poses], axis=0) if len(poses) > 0 else np.zeros(3)
        up = up / np.linalg.norm(up) if np.linalg.norm(up) > 1e-6 else np.array([0.0, 0.0, 1.0])
        means = self.drawn_scene.means.double().numpy()
        places = np.concatenate(
            [*(np.linalg.inv(pose)[None, :3, 3] for pose in poses), means[:: 1 + len(means) // 10_000]]
        )
        if len(places) == 0:
            return up.tolist(), [0.0, 0.0, 0.0], 1.0
        center = np.median(places, axis=0)
        radius = float(np.quantile(np.abs(places - center).max(axis=1), 0.8))
        return up.tolist(), center.tolist(), radius if radius > 0 else 1.0

    @cached_property
    def first_view(self) -> PageView | None:
        """Camera of the first training image, with its target at the median depth of the scene; None without images."""
        cameras = self.run.scene.train.cameras
        if len(cameras) == 0:
            return None
        pose = np.linalg.inv(cameras[0].world_to_camera.double().cpu().numpy())
        position, ahead = pose[:3, 3], pose[:3, 2]
        depth = (self.drawn_scene.means[::50].double().numpy() - position) @ ahead
        distance = float(np.median(depth[depth > 0])) if (depth > 0).any() else self.frame[2]
        fov = float(np.clip(2 * np.arctan(cameras[0].height / 2 / float(cameras[0].K[1, 1])), *_FIELDS_OF_VIEW))
        places = (position.tolist(), (position + distance * ahead).tolist(), self.frame[0])
        return msgspec.convert(dict(zip(("position", "look_at", "up"), places)) | {"fov": fov}, PageView)

    @cached_property
    def examples(self) -> list[str]:
        """Up to four words that are found in different parts of the scene; [] if the encoder has no vocabulary."""
        color = encoder_name(self.run.field) == "color"
        words = _BASIC_COLORS if color else tuple(own_words(self.run.field))
        if len(words) == 0:
            return []
        sample = torch.from_numpy(self.rows[:: 1 + len(self.rows) // _SAMPLE])
        vectors = torch.nn.functional.normalize(torch.from_numpy(np.asarray(self.read(words))).float())
        cosine = self.run.field.directions(sample).float().cpu() @ vectors.T
        null = self.run.field.null_levels().cpu()[sample]
        lead = cosine - (null if null.shape[1] > 0 else cosine.mean(dim=1, keepdim=True))
        best = torch.quantile(lead, 0.99, dim=0).argsort(descending=True)[:_NUM_CANDIDATES].tolist()
        prompts = encode_prompts(join_prompts([words[index] for index in best]), self.read)
        query = build_query(self.space.field, prompts, self.read)[1]
        found, taken = [], self.space.empty_mask()
        for finding in run_query(self.space.field, self.space.means, query):
            size = int(finding.mask.sum())
            if size > 0 and finding.verdict in ("found", None) and 2 * int((finding.mask & taken).sum()) < size:
                found.append(finding.text)
                taken = taken | finding.mask
        return found[:_NUM_EXAMPLES]

    @cached_property
    def pca(self) -> Float[torch.Tensor, "n 3"]:
        """Three principal components of the feature of every Gaussian, in 0..1."""
        axes, ends = pca_of(self.run.field.directions(torch.from_numpy(self.rows[:: 1 + len(self.rows) // _SAMPLE])))
        values = self.run.field.query(axes).double()
        return ((values - ends[:, 0]) / (ends[:, 1] - ends[:, 0]).clamp(min=1e-9)).clamp(0, 1)

    @cached_property
    def floaters(self) -> Bool[torch.Tensor, " n"]:
        """Mask of the likely floaters, which are Gaussians that are not part of a surface."""
        with self.analyzing:
            return find_floaters(self.run.scene.gaussians, self.run.field.scalars).mask

    def describe(self, *, read_only: bool) -> dict[str, Any]:
        """Return the properties of the run as JSON types, for `GET /api/runs`."""
        (up, center, radius), drawn = self.frame, len(self.rows)
        return {
            "id": self.id, "name": self.run.scene.name, "encoder": encoder_name(self.run.field) or "",
            "num_gaussians": len(self.space), "num_drawn": drawn, "num_left_out": int(self.visible.sum()) - drawn,
            "num_views": len(self.run.scene.train), "saved_prompts": list(self.stored()), "examples": self.examples,
            "read_only": read_only, "up": up, "center": center, "radius": radius, "digest": self.geometry[1],
        }  # fmt: skip

    def weights(self, origin: Sequence[float], direction: Sequence[float]) -> Float[torch.Tensor, " n"]:
        """Return the compositing weights of all Gaussians on a ray; raise ValueError if the direction is zero."""
        if not any(direction):
            raise InputError("The direction of a ray must not be zero.")
        start, ahead = (torch.tensor(x, dtype=torch.float64) for x in (origin, direction))
        return ray_weights(self.run.scene.gaussians, start, ahead)

    def read(self, texts: Sequence[str]) -> Any:
        """Return the embedding of each text."""
        with self.reading:
            return self.run.texts.rows(texts)

    def stored(self) -> dict[str, Any]:
        """Return the embeddings of the prompts stored in the run, by text."""
        return {row.text: row.vector for row in prompts_of_query(load_query(self.run.folder / FIELD_FOLDER))}

    def known(self, clicks: Mapping[str, int]) -> dict[str, Any]:
        """Return the vectors of stored prompts and clicks, by text; they do not need an encoder.

        Raises:
            ValueError: A click refers to a Gaussian that this scene does not have.
        """
        for name, gaussian in clicks.items():
            if gaussian >= len(self.space):
                raise InputError(f"{name}: this scene has no Gaussian {gaussian:,}. The link is for another scene.")
        rows = self.space.field.directions(torch.tensor(list(clicks.values()), dtype=torch.long)).cpu().numpy()
        return {**self.stored(), **{name: row for name, row in zip(clicks, rows) if np.any(row)}}

    def save(self, query: Query | None, *, replaces: bool = False) -> str:
        """Store prompts in the run, and return the number of stored prompts as text; see `store_query`."""
        return store_query(self.run.folder / FIELD_FOLDER, query, replaces=replaces)

    def export(self, state: State, mask: Bool[torch.Tensor, " n"], name: str, kind: str) -> tuple[str, bytes, str]:
        """Return the name and content of a file of Gaussians, and a message for the user; see `selection_bytes`."""
        file, content = selection_bytes(self.run.scene, self.run.field, state, mask, name, kind)
        faint = int((mask & ~self.visible).sum())
        note = f" Left out (opacity below 1/255, or not valid for drawing): {faint:,}." if faint > 0 else ""
        return file, content, f"Downloaded {file}. Gaussians: {int(mask.sum()) - faint:,}.{note}"

    def cached(self, key: bytes, compute: Callable[[], T], size: Callable[[T], int] = lambda result: 0) -> T:
        """Return the result for a key from the cache, or compute and cache it.

        Above a limit on their number or total size, the least recently used results are dropped.

        Args:
            size: Function that returns the size of a result in bytes.
        """
        with self._memory_lock:
            found = self._results.pop(key, None)
        if found is None:
            result = compute()
            found = result, size(result)
        with self._memory_lock:
            self._results[key] = found
            total = sum(count for _, count in self._results.values())
            while len(self._results) > 1 and (total > _MAX_RESULT_BYTES or len(self._results) > _MAX_RESULTS):
                total -= self._results.popitem(last=False)[1][1]
        return found[0]

    def view_of(
        self, target: ObjectRow | LookAtTarget, view: PageView | None, drawn: Bool[torch.Tensor, " n"]
    ) -> PageView:
        """Return a camera that looks at an object or a point from a position with little occlusion, if there is one.

        Args:
            view: Current camera; None for that of the first training image.
            drawn: Mask of the Gaussians that are drawn.
        Raises:
            ValueError: `view` is None, and the run has no training images.
        """
        view = view or self.first_view
        if view is None:
            raise InputError("The run has no training images, so the initial camera is unknown.")
        scene = self.run.scene.gaussians
        position = unoccluded_viewpoint(target, scene, drawn, view.position, view.up, view.fov)
        return msgspec.structs.replace(view, position=position, look_at=tuple(target.center))

    def image(self, index: int, max_size: int) -> bytes:
        """Return a training image as JPEG, with at most `max_size` pixels along its longer side.

        Raises:
            ValueError: The run has no image with this index.
        """
        if not 0 <= index < len(self.run.scene.train):
            raise InputError(
                f"The run has no image {index}. Number of images: {len(self.run.scene.train)}, numbered from 0."
            )
        return to_jpeg(self.run.scene.train[index].image.cpu().numpy(), max_size)

    def still(self, codes: Codes, camera: Camera, background: Sequence[float] = (1.0, 1.0, 1.0)) -> bytes:
        """Render the Gaussians in `rows` in the colors of `codes`, as JPEG."""
        scene, rows = self.run.scene, torch.from_numpy(self.rows)
        kept = torch.from_numpy(codes.codes != NOT_DRAWN)
        own = scene.colors(camera).detach().cpu()[rows][kept].clamp(0, 1)
        table = torch.tensor([*codes.palette], dtype=own.dtype)[torch.from_numpy(codes.codes).long()[kept]]
        gray = (own @ own.new_tensor(_GRAY_WEIGHTS) * _GRAY_DIMMING)[:, None].expand_as(own)
        color = torch.where(table[:, 4:] > 0, gray, own)
        color = color + table[:, 3:4] * (table[:, :3] / 255 - color)
        part = self.drawn_scene.select(kept)
        with _render_lock:
            image, alpha = render(part, camera, color.to(part.means), rasterize_mode=scene.rasterize_mode)
        shown = image + (1 - alpha)[:, :, None] * image.new_tensor(list(background))
        return to_jpeg((shown.clamp(0, 1) * 255).round().to(torch.uint8).numpy())

    def remember(self, token: str, page: object) -> tuple[PageMemory, str]:
        """Return the session of a token, or a new one if the token is unknown, and the token to use from now on.

        If another open page uses the token, for instance because a tab was duplicated, the new page gets a copy of the
        session and a new token.
        """
        with self._memory_lock:
            found = self._memories.get(token)
            if found is not None and found.page is not None:
                token = secrets.token_urlsafe(16)
                copy: dict[str, Any] = {name: value for name, value in vars(found).items() if name != "page"}
                found = PageMemory(**(copy | {"clicks": dict(found.clicks)}))
            if found is None:
                found = PageMemory(History.of(State(self.space), lean=State.without_caches))
            found.page = page
            self._memories[token] = found
            self._memories.move_to_end(token)
            for old in [name for name, memory in self._memories.items() if memory.page is None][:-MAX_MEMORIES]:
                del self._memories[old]
            return found, token

    def warm_up(self, wait: Callable[[], None]) -> None:
        """Compute the geometry and the examples in advance, and then the other data that the first page needs.

        Args:
            wait: Function that blocks until there is time for the next item of the other data.
        """
        _ = self.geometry, self.examples
        for part in (self._compile_renderer, lambda: self.space.neighbor_pairs, lambda: self.pca):
            wait()
            part()

    def _compile_renderer(self) -> None:
        view = self.first_view
        if view is not None:
            codes = Codes([(0, 0, 0, 0.0, 0)], np.zeros(len(self.rows), np.uint8))
            self.still(codes, view.camera(64))
            self.weights(view.position, np.subtract(view.look_at, view.position).tolist())

    @property
    def in_use(self) -> bool:
        """True if a page of this run is open."""
        with self._memory_lock:
            return any(memory.page is not None for memory in self._memories.values())


def to_jpeg(image: UInt8[np.ndarray, "h w 3"], max_size: int | None = None) -> bytes:
    """Encode an image as JPEG, scaled down to at most `max_size` pixels along its longer side."""
    picture, buffer = Image.fromarray(image), io.BytesIO()
    if max_size is not None:
        picture.thumbnail((max_size, max_size))
    picture.save(buffer, "JPEG", quality=_JPEG_QUALITY)
    return buffer.getvalue()


class RunStore:
    """Store of runs by id. It opens runs on first use.

    Above a memory limit, it closes the least recently used runs that have no open page.

    Args:
        configs: Paths of the runs' config.yml files.
        open_run: Function that opens the run of a config.yml.
        max_gaussians: As in `ServedRun`.
        memory_limit: Total size of the open runs, in bytes, above which runs are closed (default: half of the free
            memory).
    """

    def __init__(
        self,
        configs: Sequence[Path],
        open_run: Callable[[Path], LiftedRun],
        *,
        max_gaussians: int = 1_000_000,
        memory_limit: int | None = None,
    ) -> None:
        self._configs = {name: config for name, config in zip(_run_ids(configs), configs)}
        self._open_run, self._max_gaussians = open_run, max_gaussians
        free = min(free_memory().values(), default=2**33)
        self._limit = int(_MEMORY_SHARE * free) if memory_limit is None else memory_limit
        self._open: OrderedDict[str, tuple[ServedRun, int]] = OrderedDict()
        self._lock = threading.Lock()
        self._locks = {name: threading.Lock() for name in self._configs}

    @property
    def ids(self) -> list[str]:
        """Ids of all runs."""
        return list(self._configs)

    @property
    def folders(self) -> list[Path]:
        """Folders of all runs."""
        return [config.absolute().parent for config in self._configs.values()]

    def get(self, name: str) -> ServedRun:
        """Return the run with the id `name`, and open it if necessary.

        Raises:
            ValueError, FileNotFoundError: No run has this id, or the run cannot be opened.
        """
        if name not in self._configs:
            raise InputError(f"The server has no run {name!r}. Choose one of: {', '.join(self.ids)}.")
        with self._locks[name]:
            with self._lock:
                if name in self._open:
                    self._open.move_to_end(name)
                    return self._open[name][0]
            run = self._open_run(self._configs[name])
            served = ServedRun(name, run, self._max_gaussians)
            with self._lock:
                self._open[name] = served, _estimated_bytes(run)
                for other in [one for one in self._open if one != name and not self._open[one][0].in_use]:
                    if sum(size for _, size in self._open.values()) > self._limit:
                        del self._open[other]
            return served

    def warm_up(self, wait: Callable[[], None]) -> None:
        """Compute in advance the data that the first page of each open run needs; see `ServedRun.warm_up`."""
        for name in self.ids:
            with self._lock:
                served, _ = self._open.get(name, (None, 0))
            if served is not None:
                served.warm_up(wait)


def _estimated_bytes(run: LiftedRun) -> int:
    """Estimate the memory of an open run, as twice the size of its checkpoint and field files."""
    files = [run.scene.checkpoint_path, *(run.folder / FIELD_FOLDER).glob("*.safetensors")]
    return 2 * sum(file.stat().st_size for file in files if file.is_file())


def _run_ids(configs: Sequence[Path]) -> list[str]:
    """Return a short unique id for each config, made of the names of its experiment and timestamp folders."""
    names: list[str] = []
    for config in configs:
        parts = config.absolute().parent.parts
        name = re.sub(r"[^A-Za-z0-9._-]+", "-", "-".join(parts[-3::2])).strip("-.") or "run"
        names.append(name if name not in names else f"{name}-{1 + len(names)}")
    return names


@lru_cache(maxsize=1)
def _roots() -> tuple[str, ...]:
    return tuple(sorted((str(Path.home()), str(Path.cwd())), key=len, reverse=True))


def without_paths(text: str) -> str:
    """Shorten absolute paths in a message to their last component.

    >>> without_paths("/home/me/captures/fox/config.yml is missing; see https://example.org/a/b")
    'config.yml is missing; see https://example.org/a/b'
    """
    for root in _roots():
        text = text.replace(root + "/", "/") if len(root) > 1 else text
    text = re.sub(r"(['\"])(?:/|[A-Za-z]:\\)[^'\"]*[/\\]([^'\"/\\]*)\1", r"\1\2\1", text)
    text = re.sub(r"(?<!\w)[A-Za-z]:\\(?:[^\s\\'\"]+\\)*", "", text)
    return re.sub(r"(?<![\w:/.])/(?:[^\s/'\",;:()]+/)*([^\s/'\",;:()]*)", r"\1", text)
