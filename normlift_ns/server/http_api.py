"""Routes of the HTTP API, and its OpenAPI document."""

from __future__ import annotations

import html
import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

import msgspec
import numpy as np
import torch
from safetensors.torch import save as save_safetensors
from starlette.requests import Request
from starlette.responses import HTMLResponse, Response
from starlette.routing import Route

import normlift_ns
from normlift_ns.core.gaussians import Camera
from normlift_ns.errors import InputError
from normlift_ns.evaluation.coverage import coverage
from normlift_ns.server import schema
from normlift_ns.server.describe import explanation_of
from normlift_ns.server.protocol import decode, make_codes
from normlift_ns.server.runs import ServedRun
from normlift_ns.session.state import State

T = TypeVar("T")
_BINARY = "application/octet-stream"
_MAY_NOT_WRITE = (
    "This request may not write into the run: the server is read-only, or the request lacks the header Authorization: "
    "Bearer TOKEN with the access token."
)


@dataclass(frozen=True)
class Content:
    """Response that is not JSON."""

    body: bytes
    media_type: str = _BINARY
    name: str | None = None
    """File name for downloads."""


@dataclass(frozen=True)
class Endpoint:
    """Endpoint of the API for one run."""

    path: str
    summary: str
    request: Any
    """Type of the JSON body; None for GET requests."""
    answer: Any
    """Type of the JSON response; None if the response is a file."""
    work: Callable[[ServedRun, Any], Any]
    """Function of the run and the body, or of the run and the URL query; it returns JSON types or `Content`."""
    writes: bool = False
    """True if the endpoint writes into the run. This needs the access token unless the server is local, and fails on a
    read-only server."""
    parameters: tuple[str, ...] = ()
    """Names of the URL query parameters."""
    slow: bool = True
    """False if the endpoint is as fast as a query."""


def query(served: ServedRun, request: schema.QueryRequest) -> schema.QueryResult | Content:
    """Return the answer to a question, with its arrays if the request asks for them."""
    result, content = schema.answered(served, request)
    if request.arrays == "none":
        return content
    arrays = {"relevancy": result.relevancy.float().cpu().contiguous(), "selected": result.selected.cpu().contiguous()}
    return Content(save_safetensors(arrays, {"answer": msgspec.json.encode(content).decode()}))


def objects(served: ServedRun, selection: schema.Selection) -> schema.ObjectsResult:
    """List the objects of a selection."""
    return schema.objects_result(schema.select_state(served, selection))


def select(served: ServedRun, request: schema.SelectRequest) -> schema.SelectResult | Content:
    """Return the size and position of a selection, or its mask as an NPY file."""
    state = schema.select_state(served, request)
    return schema.select_result(served, state) if request.arrays == "none" else npy(state.selection)


def explain(served: ServedRun, selection: schema.Selection) -> schema.ExplainResult:
    """Explain a selection by the images that voted for it."""
    return msgspec.convert(explanation_of(served, schema.select_state(served, selection)), schema.ExplainResult)


def export(served: ServedRun, request: schema.ExportRequest) -> Content:
    """Return a file of a selection, or of the whole scene if the request has only a format."""
    state = schema.select_state(served, request)
    whole = request == schema.ExportRequest(format=request.format)
    mask = ~served.space.empty_mask() if whole else state.selection
    texts = [] if request.question is None else request.question.texts
    texts = texts if request.prompt is None else texts[request.prompt : request.prompt + 1]
    name = "scene" if whole else " ".join([*texts, *([] if request.object is None else [str(request.object)])])
    file, content, _ = served.export(state, mask, name or "selection", request.format)
    return Content(content, name=file)


def render(served: ServedRun, request: schema.RenderRequest) -> Content:
    """Render the scene or a selection as JPEG."""
    selection = request.selection
    state = State(served.space) if selection is None else schema.select_state(served, selection)
    if selection is not None:
        state = schema.isolated(state) if request.isolate else actions_mode(state, request.mode)
    codes = make_codes(state, served.rows, served.pca if state.color_mode == "pca" else None)
    return Content(served.still(codes, _camera(served, request)), "image/jpeg")


def actions_mode(state: State, mode: str) -> State:
    """Return the state with a different color mode."""
    return schema.replace(state, color_mode=mode)


def _camera(served: ServedRun, request: schema.RenderRequest) -> Camera:
    if request.page_view is not None:
        if not request.page_view.is_valid:
            raise InputError(
                "page_view is not valid: look_at must differ from position, up must not be zero, and the viewing "
                "direction must not be parallel to up."
            )
        return request.page_view.camera(request.max_size)
    camera = served.run.camera(request.view) if request.camera is None else request.camera.camera()
    return camera.downscaled(request.max_size / max(camera.width, camera.height))


def save(served: ServedRun, request: schema.SaveRequest) -> dict[str, str]:
    """Store the prompts of a question in the run."""
    asked = schema.answer(served, request.question).question
    return {"stored": served.save(asked, replaces=request.replace)}


def floaters(served: ServedRun, query: Any) -> schema.SelectResult | Content:
    """Return the size and position of the likely floaters, or their mask as an NPY file."""
    return select(served, schema.SelectRequest(floaters=True, arrays="npy" if query.get("arrays") == "npy" else "none"))


def coverage_of(served: ServedRun, query: Any) -> dict[str, Any]:
    """Find regions without reliable evidence, and images and poses that would add evidence."""
    least = query.get("min_reliability")
    if least is None:
        return coverage(served.run).to_json()
    return coverage(served.run, min_reliability=_number("min_reliability", least)).to_json()


def features(served: ServedRun, query: Any) -> Content:
    """Return the unit features [M, D] of a range of Gaussians as an NPY file, with zeros for those without a direction.

    Raises:
        ValueError: The range is empty, extends beyond the scene, or has more than `schema.MAX_FEATURES` Gaussians.
    """
    count = len(served.space)
    start, stop = (int(_number(name, query.get(name, str(end)))) for name, end in (("start", 0), ("stop", count)))
    if not 0 <= start < stop <= count or stop - start > schema.MAX_FEATURES:
        raise InputError(
            f"start and stop must satisfy 0 <= start < stop <= {count:,} and differ by at most "
            f"{schema.MAX_FEATURES:,}, got {start:,} and {stop:,}."
        )
    return npy(
        served.space.field.directions(torch.arange(start, stop), refined=query.get("refined") != "false").float()
    )


def inventory(served: ServedRun, query: Any) -> dict[str, Any]:
    """List the main objects of the scene, found without prompts, with their boxes."""
    with served.analyzing:
        return served.run.inventory().catalog.to_json()


def catalog(served: ServedRun, question: schema.Question) -> dict[str, Any]:
    """List the objects that prompts select, with oriented boxes and the images that show them."""
    return served.run.catalogue(schema.answer(served, question)).to_json()


def npy(array: torch.Tensor) -> Content:
    """Return an array as an NPY file."""
    buffer = io.BytesIO()
    np.save(buffer, array.cpu().numpy())
    return Content(buffer.getvalue())


def _number(name: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not -1e15 < value < 1e15:
        raise InputError(f"{name} must be a number between -1e15 and 1e15, got {text[:40]!r}.")
    return value


ENDPOINTS = (
    Endpoint("query", "Compute relevancy and selection of every Gaussian for prompts.", schema.QueryRequest,
             schema.QueryResult, query, slow=False),
    Endpoint("objects", "List the objects of a selection with their boxes.", schema.Selection, schema.ObjectsResult,
             objects, slow=False),
    Endpoint("catalog", "List the objects that prompts select, with oriented boxes in scene and capture coordinates, "
             "and with the images that show them. This takes seconds.", schema.Question, dict[str, Any], catalog),
    Endpoint("explain", "Explain a selection by the images that voted for it.", schema.Selection, schema.ExplainResult,
             explain),
    Endpoint("select", "Return the size and position of a selection, or its mask.", schema.SelectRequest,
             schema.SelectResult, select, slow=False),
    Endpoint("render", "Render the scene, a selection or an object as JPEG.", schema.RenderRequest, None, render),
    Endpoint("export", "Return a selection or the whole scene as a file. The format is ply, another splat format such "
             "as glb, or masks for a ZIP file of mask images.", schema.ExportRequest, None, export),
    Endpoint("save", "Store prompts in the run.", schema.SaveRequest, dict[str, str], save, writes=True),
    Endpoint("floaters", "Find likely floaters, which are Gaussians that are not part of a surface.", None,
             schema.SelectResult, floaters, parameters=("arrays",)),
    Endpoint("coverage", "Find regions without reliable evidence. This takes seconds.", None, dict[str, Any],
             coverage_of, parameters=("min_reliability",)),
    Endpoint("features", "Return the unit features [M, D] of the Gaussians start to stop - 1 as a float32 NPY file. "
             "Gaussians without a direction have zeros.", None, None, features,
             parameters=("start", "stop", "refined")),
    Endpoint("inventory", "List up to 20 main objects of the scene, found without prompts. This takes seconds.", None,
             dict[str, Any], inventory),
)  # fmt: skip
"""Endpoints of `/api/runs/{run}/`."""


class Server(Protocol):
    """Interface of `app.WarmServer` for the routes."""

    async def run_of(self, name: str) -> ServedRun:
        """Return the run with the id `name`, and open it if necessary."""
        ...

    async def in_thread(self, work: Callable[[], T], *, slow: bool = True) -> T:
        """Call `work` in a thread, and return its result."""
        ...

    def may_write(self, access: str) -> bool:
        """Return True if a request with the token `access` may write into a run."""
        ...


def api_routes(server: Server) -> list[Route]:
    """Return the routes of the API."""

    def route(endpoint: Endpoint) -> Route:
        async def handle(request: Request) -> Response:
            if endpoint.writes and not server.may_write(_access(request)):
                return _json({"error": _MAY_NOT_WRITE}, 403)
            value = request.query_params if endpoint.request is None else decode(await request.body(), endpoint.request)
            served = await server.run_of(request.path_params["run"])
            result = await server.in_thread(lambda: endpoint.work(served, value), slow=endpoint.slow)
            if not isinstance(result, Content):
                return _json(result)
            given = {} if result.name is None else {"Content-Disposition": f'attachment; filename="{result.name}"'}
            return Response(result.body, headers=given, media_type=result.media_type)

        methods = ["GET" if endpoint.request is None else "POST"]
        return Route(f"/api/runs/{{run}}/{endpoint.path}", handle, methods=methods)

    document = openapi(ENDPOINTS)
    page = _overview(ENDPOINTS)

    async def describe(request: Request) -> Response:
        return _json(document)

    async def overview(request: Request) -> Response:
        return HTMLResponse(page)

    return [Route("/api", overview), Route("/api/openapi.json", describe), *map(route, ENDPOINTS)]


def _access(request: Request) -> str:
    """Return the access token of a request, from the header "Authorization: Bearer TOKEN"."""
    return request.headers.get("authorization", "").removeprefix("Bearer ")


def _json(content: Any, status: int = 200) -> Response:
    return Response(msgspec.json.encode(content), status, media_type="application/json")


def openapi(endpoints: Sequence[Endpoint]) -> dict[str, Any]:
    """Return the OpenAPI document of the endpoints."""
    types = [kind for endpoint in endpoints for kind in (endpoint.request, endpoint.answer) if kind is not None]
    schemas, components = msgspec.json.schema_components(types, ref_template="#/components/schemas/{name}")
    by_type = {repr(kind): schema_of for kind, schema_of in zip(types, schemas)}
    run = {"name": "run", "in": "path", "required": True, "schema": {"type": "string"}}
    error = {"description": "The request is not valid; `error` is the reason.", "content": _body({"type": "object"})}
    paths: dict[str, Any] = {
        "/api/runs": {"get": {"summary": "List the runs.", "responses": {"200": {"description": "Runs"}}}}
    }
    for endpoint in endpoints:
        answer = {_BINARY: {}} if endpoint.answer is None else _body(by_type[repr(endpoint.answer)])
        operation: dict[str, Any] = {
            "summary": endpoint.summary,
            "operationId": endpoint.path,
            "parameters": [
                run,
                *({"name": n, "in": "query", "schema": {"type": "string"}} for n in endpoint.parameters),
            ],
            "responses": {"200": {"description": "Answer", "content": answer}, "400": error},
        }
        if endpoint.request is not None:
            operation["requestBody"] = {"required": True, "content": _body(by_type[repr(endpoint.request)])}
        method = "get" if endpoint.request is None else "post"
        paths[f"/api/runs/{{run}}/{endpoint.path}"] = {method: operation}
    info = {"title": "normlift_ns", "version": normlift_ns.__version__}
    return {"openapi": "3.1.0", "info": info, "paths": paths, "components": {"schemas": components}}


def _body(schema_of: Any) -> dict[str, Any]:
    return {"application/json": {"schema": schema_of}}


def _overview(endpoints: Sequence[Endpoint]) -> str:
    rows = "".join(
        f"<tr><td><code>{'GET' if one.request is None else 'POST'} /api/runs/{{run}}/{one.path}</code></td>"
        f"<td>{html.escape(one.summary)}</td></tr>"
        for one in endpoints
    )
    head = "<!doctype html><html lang=en><title>normlift API</title><h1>API</h1>"
    return f"{head}<p>The schemas are in <a href='/api/openapi.json'>openapi.json</a>.</p><table>{rows}</table></html>"
