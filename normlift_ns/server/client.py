"""Python client of the server: `normlift_ns.connect`, and remote runs with methods like those of `LiftedRun`."""

from __future__ import annotations

import http.client
import io
import json
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from threading import Lock
from typing import Any, Literal
from urllib.parse import quote, urlsplit

import msgspec
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from PIL import Image
from safetensors.torch import load as load_safetensors
from torch import Tensor

from normlift_ns.core.arguments import check_arguments
from normlift_ns.core.gaussians import Camera
from normlift_ns.errors import InputError
from normlift_ns.io.atomic import atomic_file, atomic_files
from normlift_ns.io.guard import refuse_inputs
from normlift_ns.options import RelevancyRule, check_path
from normlift_ns.server.schema import (
    MAX_FEATURES,
    Arrays,
    ExplainResult,
    ObjectsResult,
    PromptResult,
    QueryRequest,
    QueryResult,
    Question,
    Selection,
    SelectResult,
    pack_mask,
)  # fmt: skip

_TIMEOUT = 180.0
_MAX_ANSWER = 2**32
"""Maximum size of a response in bytes."""


@check_arguments
@dataclass(frozen=True, eq=False, repr=False)
class RemoteAnswer:
    """Answer from a server; `answer["fox"]` is the result for one prompt."""

    question: Question
    result: QueryResult
    relevancy: Float[Tensor, "n q"]
    selected: Bool[Tensor, "n q"]

    @property
    def texts(self) -> tuple[str, ...]:
        """The prompts."""
        return tuple(self.question.texts)

    @property
    def mask(self) -> Bool[Tensor, " n"]:
        """Mask of the Gaussians that one or more prompts select."""
        return self.selected.any(dim=1)

    def __len__(self) -> int:
        return len(self.texts)

    def __iter__(self) -> Iterator[RemoteFinding]:
        return (RemoteFinding(self, index) for index in range(len(self)))

    def __getitem__(self, text: str) -> RemoteFinding:
        """Return the result for one prompt.

        Raises:
            KeyError: `text` is not a prompt of this answer.
        """
        if text not in self.texts:
            raise KeyError(
                f"{text!r} is not a prompt of this answer; its prompts are {', '.join(map(repr, self.texts))}"
            )
        return RemoteFinding(self, self.texts.index(text))

    def __repr__(self) -> str:
        counts = ", ".join(f"{one.text!r}: {one.result.count:,}" for one in self)
        return f"Answer for {len(self.selected):,} Gaussians; selected: {counts}"


@dataclass(frozen=True, eq=False)
class RemoteFinding:
    """Result for one prompt, like `Finding`; `result` contains its numbers."""

    answer: RemoteAnswer
    index: int

    @property
    def text(self) -> str:
        """The prompt."""
        return self.answer.texts[self.index]

    @property
    def result(self) -> PromptResult:
        """Verdict, summary numbers and histogram of the prompt."""
        return self.answer.result.results[self.index]

    @property
    def relevancy(self) -> Float[Tensor, " n"]:
        """Relevancy of every Gaussian."""
        return self.answer.relevancy[:, self.index]

    @property
    def mask(self) -> Bool[Tensor, " n"]:
        """Mask of the selected Gaussians."""
        return self.answer.selected[:, self.index]

    @property
    def verdict(self) -> str | None:
        """Presence of the prompt in the scene, as in `Finding.verdict`."""
        return self.result.verdict


Part = RemoteAnswer | RemoteFinding | Bool[Tensor, " n"]
"""Part of a scene: an answer, its result for one prompt, or a mask of the Gaussians."""


@dataclass(eq=False, repr=False)
class RemoteRun:
    """Lifted run on a server, with methods like those of `LiftedRun`. Any thread may call the methods.

    >>> from normlift_ns import connect, open_run
    >>> from normlift_ns.server.app import ServerOptions, WarmServer
    >>> from normlift_ns.server.runs import RunStore
    >>> server = WarmServer(RunStore([config], open_run), ServerOptions(port=0))  # as in ns-normlift-serve
    >>> run = connect(f"http://127.0.0.1:{server.start()}")
    >>> answer = run.ask("red", "yellow")
    >>> answer["red"].verdict, run.render("0001", answer["red"]).shape
    ('found', torch.Size([120, 160, 3]))
    >>> server.stop()
    """

    address: str
    """Scheme, host and port of the server."""
    id: str
    access_token: str = ""
    _connection: http.client.HTTPConnection | None = field(default=None, repr=False)
    _lock: Lock = field(default_factory=Lock, repr=False)

    def __repr__(self) -> str:
        return f"RemoteRun {self.id} at {self.address}"

    @property
    def info(self) -> dict[str, Any]:
        """Name, encoder, number of Gaussians, saved prompts and other properties of the run."""
        runs = json.loads(self._get("/api/runs"))["runs"]
        return next(run for run in runs if run["id"] == self.id)

    @check_arguments
    def ask(
        self,
        *texts: str,
        negatives: Sequence[str] | None = None,
        relevancy: RelevancyRule | Literal["auto"] = "auto",
        threshold: float | Literal["auto"] | None = None,
        min_reliability: float = 0.0,
        refined: bool = True,
    ) -> RemoteAnswer:
        """Compute the relevancy and the selection of every Gaussian for each prompt, as `LiftedRun.ask` does.

        Args:
            texts: Prompts; repeated ones count once.
        Raises:
            ValueError: The server rejects the query, for instance because the encoder cannot encode a prompt.
            OSError: The server does not respond.
        """
        arrays: Arrays = "safetensors"
        settings = (None if negatives is None else list(negatives), relevancy, threshold, min_reliability, refined)
        prompts = list(dict.fromkeys(texts))
        body = self._post("query", QueryRequest(prompts, *settings, arrays=arrays))
        tensors, length = load_safetensors(body), int.from_bytes(body[:8], "little")
        metadata = json.loads(body[8 : 8 + length])["__metadata__"]
        result = msgspec.json.decode(metadata["answer"], type=QueryResult)
        return RemoteAnswer(Question(prompts, *settings), result, tensors["relevancy"], tensors["selected"])

    @check_arguments
    def objects(self, part: Part) -> ObjectsResult:
        """List the objects of a selection with their boxes."""
        return msgspec.json.decode(self._post("objects", _selection(part)), type=ObjectsResult)

    def select(self, part: Part | Selection) -> SelectResult:
        """Return the number, center and box of the Gaussians in a selection, such as `Selection(ray=…)`."""
        return msgspec.json.decode(self._post("select", _selection(part)), type=SelectResult)

    @check_arguments
    def catalogue(self, part: RemoteAnswer | RemoteFinding) -> dict[str, Any]:
        """List the objects that the prompts of an answer select, with oriented boxes, as JSON types.

        For a finding, list the objects of all prompts of its answer.
        """
        return json.loads(self._post("catalog", _selection(part).question))

    def inventory(self) -> dict[str, Any]:
        """List the objects of the scene without prompts, as JSON types; see `LiftedRun.inventory`."""
        return json.loads(self._get(self._path("inventory")))

    @check_arguments
    def why(self, part: Part) -> ExplainResult:
        """Explain a selection by the images that voted for it."""
        return msgspec.json.decode(self._post("explain", _selection(part)), type=ExplainResult)

    def floaters(self) -> Bool[Tensor, " n"]:
        """Return the mask of likely floaters, which are Gaussians that are not part of a surface."""
        return torch.from_numpy(np.load(io.BytesIO(self._get(self._path("floaters?arrays=npy")))))

    @check_arguments
    def coverage(self, min_reliability: float | None = None) -> dict[str, Any]:
        """Find regions without reliable evidence, and images and poses that would add evidence.

        Returns:
            The content of `Coverage.to_json`.
        """
        query = "" if min_reliability is None else f"?min_reliability={min_reliability}"
        return json.loads(self._get(self._path("coverage" + query)))

    @check_arguments
    def features(self, start: int = 0, stop: int | None = None) -> Float[Tensor, "m d"]:
        """Return the unit features of the Gaussians `start` to `stop` - 1 (default: all).

        Gaussians without a direction have zeros.

        Raises:
            ValueError: The range is empty or extends beyond the scene.
            OSError: The server does not respond.
        """
        stop = self.info["num_gaussians"] if stop is None else stop
        firsts = range(start, max(stop, start + 1), MAX_FEATURES)
        paths = (self._path(f"features?start={first}&stop={min(stop, first + MAX_FEATURES)}") for first in firsts)
        return torch.cat([torch.from_numpy(np.load(io.BytesIO(self._get(path)))) for path in paths])

    @check_arguments
    def render(
        self, view: str | int | Camera = 0, found: Part | None = None, *, max_size: int = 2048
    ) -> UInt8[Tensor, "h w 3"]:
        """Render the scene from a camera. If `found` is given, only this selection is in color.

        Args:
            view: Camera, or the name or index of a training image.
            found: Selection to show in color (default: all Gaussians, in their trained colors).
            max_size: Maximum longer side of the image in pixels, in 16..2048.
        """
        request: dict[str, Any] = {"max_size": max_size}
        if isinstance(view, Camera):
            size = {"width": view.width, "height": view.height}
            request["camera"] = {"K": view.K.tolist(), "world_to_camera": view.world_to_camera.tolist(), **size}
        else:
            request["view"] = view
        if found is not None:
            request["selection"] = _selection(found)
        with Image.open(io.BytesIO(self._post("render", request))) as image:
            return torch.from_numpy(np.array(image.convert("RGB")))

    @check_arguments
    def export(self, path: str | Path, part: Part | None = None, *, overwrite: bool = False) -> Path:
        """Write the Gaussians of `part` (default: the whole scene) to a PLY file on this machine.

        Raises:
            FileExistsError: The file exists and `overwrite` is False.
            ValueError: The file belongs to a run, a data set or a cache, or the server rejects the request.
            OSError: The file cannot be written, or the server does not respond.
        """
        path = check_path("path", path)
        refuse_inputs([path], instead="name")
        with atomic_file(path, overwrite=overwrite) as draft:
            draft.write_bytes(self._post("export", {} if part is None else _selection(part)))
        return path

    @check_arguments
    def masks(self, folder: str | Path, part: Part, *, overwrite: bool = False) -> list[Path]:
        """Write a PNG mask of `part` for each training image to a folder on this machine, and return the paths."""
        folder = check_path("folder", folder)
        content = msgspec.to_builtins(_selection(part), str_keys=True)
        with zipfile.ZipFile(io.BytesIO(self._post("export", {**content, "format": "masks"}))) as archive:
            names = [
                name for name in archive.namelist() if ".." not in Path(name).parts and not Path(name).is_absolute()
            ]
            paths = [folder / name for name in names]
            refuse_inputs(paths, instead="folder")
            with atomic_files(*paths, overwrite=overwrite) as drafts:
                for draft, name in zip(drafts, names):
                    draft.write_bytes(archive.read(name))
        return paths

    @check_arguments
    def save(self, answer: RemoteAnswer, *, replace: bool = True) -> str:
        """Store the prompts of an answer in the run, and return the number of stored prompts as text.

        This needs the access token unless the server listens on localhost only. A read-only server rejects it.

        Args:
            replace: Replace the prompts that the run already stores, instead of adding new ones to them.
        """
        return json.loads(self._post("save", {"question": answer.question, "replace": replace}))["stored"]

    @check_arguments
    def camera(self, view: str | int) -> Camera:
        """Return the camera of the training image with the name or index `view`.

        Raises:
            ValueError: No image, or more than one image, has this name or index.
            OSError: The server does not respond.
        """
        cameras = json.loads(self._get(self._path("cameras")))["cameras"]
        if isinstance(view, int):
            matches = cameras[view : view + 1] if view >= 0 else []
        else:
            matches = [one for one in cameras if view in (one["name"], Path(one["name"]).name, Path(one["name"]).stem)]
        if len(matches) != 1:
            raise InputError(
                f"view must be the name or index of one training image; {view!r} matches {len(matches) or 'none'} of "
                f"{len(cameras)}"
            )
        found = matches[0]
        pose, K = torch.tensor(found["world_to_camera"]), torch.tensor(found["K"])
        return Camera(K, pose, found["width"], found["height"])

    def _path(self, verb: str) -> str:
        return f"/api/runs/{quote(self.id)}/{verb}"

    def _post(self, verb: str, request: Any) -> bytes:
        return self._send("POST", self._path(verb), msgspec.json.encode(request))

    def _get(self, path: str) -> bytes:
        return self._send("GET", path, None)

    def _send(self, method: str, path: str, body: bytes | None) -> bytes:
        with self._lock:
            try:
                try:
                    status, content = self._exchange(method, path, body)
                except (http.client.RemoteDisconnected, BrokenPipeError, ConnectionResetError):
                    self._close()  # the server closes idle connections
                    status, content = self._exchange(method, path, body)
            except (http.client.HTTPException, OSError) as error:
                self._close()
                raise ConnectionError(
                    f"The server at {self.address} does not respond ({error}). Check the address, and check that "
                    "ns-normlift-serve or ns-normlift-view is running there."
                ) from error
        if status != 200:
            raise InputError(f"The server at {self.address} answered with status {status}: {_reason(content)}")
        return content

    def _exchange(self, method: str, path: str, body: bytes | None) -> tuple[int, bytes]:
        """Send a request; return the status and the body of the response."""
        headers = {"Content-Type": "application/json"}
        headers |= {"Authorization": f"Bearer {self.access_token}"} if self.access_token else {}
        if self._connection is None:
            self._connection = _connect(self.address)
        self._connection.request(method, path, body, headers)
        response = self._connection.getresponse()
        return response.status, response.read(_MAX_ANSWER)

    def _close(self) -> None:
        if self._connection is not None:
            self._connection.close()
        self._connection = None


def _connect(address: str) -> http.client.HTTPConnection:
    parts = urlsplit(address)
    kind = http.client.HTTPSConnection if parts.scheme == "https" else http.client.HTTPConnection
    return kind(parts.hostname or "", parts.port, timeout=_TIMEOUT)


def _reason(content: bytes) -> str:
    text = content.decode("utf8", "replace")[:2000]
    try:
        return str(json.loads(text)["error"])
    except (ValueError, LookupError, TypeError):
        return text.strip()


def _selection(part: Any) -> Selection:
    """Return the `Selection` request for a part of a scene.

    Raises:
        ValueError: `part` is not an answer, a finding, a mask or a `Selection`.
    """
    if isinstance(part, RemoteAnswer):
        return Selection(part.question)
    if isinstance(part, RemoteFinding):
        return Selection(part.answer.question, prompt=part.index)
    if isinstance(part, Tensor) and part.dtype == torch.bool and part.ndim == 1:
        return Selection(mask=pack_mask(part))
    if isinstance(part, Selection):
        return part
    raise InputError(
        "part must be an answer from the server, its result for one prompt, a one-dimensional boolean mask or a "
        f"Selection; got {type(part).__name__}"
    )


@check_arguments
def connect(url: str, run: str | None = None, *, access_token: str = "") -> RemoteRun:
    """Connect to a run on a server that was started with ns-normlift-serve or ns-normlift-view.

    Args:
        url: Address of the server, such as http://localhost:7008.
        run: Id of the run (default: the only run of the server).
        access_token: Token printed by the server; needed to store prompts unless the server listens on localhost only.
    Raises:
        ValueError: The address is not that of a server of normlift_ns, or the server does not have this run.
        OSError: The server does not respond.

    >>> try:
    ...     connect("ftp://localhost")
    ... except ValueError as error:
    ...     print(error)
    url must be the address of a server such as http://localhost:7008, got 'ftp://localhost'
    """
    wrong = InputError(f"url must be the address of a server such as http://localhost:7008, got {url!r}")
    try:
        parts = urlsplit(url if "://" in url else f"http://{url}")
        _ = parts.port
    except ValueError:  # the port is not a number, or the brackets of an IPv6 address do not match
        raise wrong from None
    if parts.scheme not in ("http", "https") or not parts.hostname:
        raise wrong
    remote = RemoteRun(f"{parts.scheme}://{parts.netloc}", run or "", access_token)
    try:
        ids = [one["id"] for one in json.loads(remote._get("/api/runs"))["runs"]]
    except (json.JSONDecodeError, UnicodeDecodeError, TypeError, KeyError):
        raise InputError(f"{remote.address} is not a server of normlift_ns; check the address") from None
    if run is None and len(ids) == 1:
        remote.id = ids[0]
    if remote.id not in ids:
        raise InputError(f"run must be the id of a run on this server, one of {', '.join(ids)}; got {run!r}")
    return remote
