"""Tools and resources of the Model Context Protocol for lifted runs; needs the package mcp."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Annotated, Any

import anyio
import msgspec
import numpy as np

from normlift_ns.errors import InputError, describe_error

try:
    from mcp.server.mcpserver import Image, MCPServer
    from mcp.server.mcpserver.exceptions import ToolError
    from mcp.server.transport_security import TransportSecuritySettings
    from mcp.types import ToolAnnotations
    from pydantic import Field
except ImportError as error:
    raise InputError(f"--mcp needs the package mcp ({error}); run: pip install 'normlift-ns[mcp]'") from None

from starlette.responses import JSONResponse
from starlette.routing import Route
from starlette.types import Receive, Scope, Send

import normlift_ns
from normlift_ns.io.atomic import atomic_file, numbered_paths
from normlift_ns.server import http_api, schema
from normlift_ns.server.app import WarmServer
from normlift_ns.server.coloring import ColorMode
from normlift_ns.server.protocol import decode
from normlift_ns.server.runs import ServedRun, without_paths

_INSTRUCTIONS = """Search trained 3D scenes (Gaussian splats with semantics) by text.
Start with list_runs. Prompts are short nouns such as "red mug"; each run has an encoder that knows certain words, and
answers say which words it does not know. A verdict tells whether a prompt is in the scene: found, weak match or
probably not here. list_objects counts and places objects; render shows them; explain shows the photos that are the
evidence. Positions are in units of the scene."""
_READS = ToolAnnotations(read_only_hint=True, idempotent_hint=True, open_world_hint=False)
_WRITES = ToolAnnotations(read_only_hint=False, destructive_hint=False, open_world_hint=False)
_MAX_RESULT = 60_000
"""Largest number of characters of a result."""

Run = Annotated[str, Field(description="Id of the run, from list_runs")]
Prompts = Annotated[list[str], Field(description="Short nouns or phrases to search for", max_length=16)]
ObjectNumber = Annotated[int | None, Field(description="Number of an object from list_objects with the same prompts")]
Point = Annotated[list[float], Field(min_length=3, max_length=3)]


class Tools:
    """Tools of some runs; the docstring of a method is the description that agents read."""

    def __init__(self, server: WarmServer, export_dir: Path | None) -> None:
        self._server, self._export_dir = server, export_dir

    def list_runs(self) -> str:
        """List the scenes that can be searched, with their encoders, sizes, saved prompts and example prompts."""
        return _text([self._facts(name) for name in self._server.runs.ids])

    def find(self, run: Run, prompts: Prompts) -> str:
        """Search a scene for prompts. Returns for each prompt a verdict (found, weak match, probably not here), the
        number of Gaussians, the position and size of what matches, the highest relevancy (0..1), and the position of
        the nearest match."""
        rows = msgspec.to_builtins(schema.answered(self._run(run), _question(prompts))[1])
        for row in rows["results"]:
            row.pop("histogram")
        return _text(rows)

    def list_objects(self, run: Run, prompts: Prompts) -> str:
        """List and count the separate objects that match prompts, the largest first, each with number, box (min and
        max corner), center, number of Gaussians and strength of evidence. Without prompts, list the main objects of the
        scene, which takes up to a minute."""
        if len(prompts) == 0:
            return _text(self.inventory(run))
        return _text(schema.objects_result(schema.select_state(self._run(run), _selection(prompts, None))))

    def explain(self, run: Run, prompts: Prompts, object_number: ObjectNumber = None) -> list[Any]:
        """Explain why a scene matches prompts: how many photos agree, with up to three photos in which the regions that
        are the evidence are outlined."""
        result = http_api.explain(self._run(run), _selection(prompts, object_number))
        images = [Image(data=_data(vote.url), format="jpeg") for vote in result.support if vote.url is not None]
        facts = msgspec.to_builtins(result)
        for row in (*facts["support"], *facts["disagreement"]):
            row.pop("url")
        return [_text(facts), *images]

    def render(
        self,
        run: Run,
        view: Annotated[str | int, Field(description="Name or index of a training photo whose camera to use")] = 0,
        prompts: Prompts = [],  # noqa: B006 (read only)
        object_number: ObjectNumber = None,
        isolate: Annotated[bool, Field(description="Draw only what matches")] = False,
        mode: ColorMode = "overlay",
    ) -> Image:
        """Render a scene as an image. With prompts, what matches is highlighted; with object_number, the camera looks
        at that object."""
        served = self._run(run)
        chosen = _selection(prompts, object_number) if len(prompts) > 0 else None
        look_at = None if chosen is None or object_number is None else _view_of(served, chosen)
        request = schema.RenderRequest(view, None, look_at, chosen, mode, isolate)
        return Image(data=http_api.render(served, request).body, format="jpeg")

    def find_floaters(self, run: Run) -> str:
        """Count the Gaussians of a scene that likely belong to no surface, and say where they are."""
        return _text(http_api.floaters(self._run(run), {}))

    def measure(self, run: Run, start: Point, end: Point) -> str:
        """Measure the distance of two positions (scene units), also in units of the original capture. Take positions
        from the centers and boxes of list_objects."""
        distance = float(np.linalg.norm(np.subtract(start, end)))
        scale = self._run(run).run.to_capture.scale
        return _text({"distance": distance, "distance_in_capture_units": distance * scale})

    def export(
        self,
        run: Run,
        prompts: Prompts,
        object_number: ObjectNumber = None,
        format: Annotated[str, Field(description="ply, or masks for a ZIP file of images")] = "ply",
    ) -> str:
        """Write what matches prompts, or one object of it, to a new file in the export folder of the server; returns
        the name of the file. No file is ever replaced."""
        if self._export_dir is None:
            raise InputError("This server exports no files; start it with --export-dir.")
        request = schema.ExportRequest(_question(prompts), object=object_number, format=format)
        content = http_api.export(self._run(run), request)
        name = Path(content.name or "selection").name
        path = next(path for path in numbered_paths(self._export_dir / name) if not path.exists())
        with atomic_file(path) as draft:
            draft.write_bytes(content.body)
        return _text({"file": path.name, "bytes": len(content.body)})

    def inventory(self, run: str) -> dict[str, Any]:
        """Return the main objects of a scene."""
        served = self._run(run)
        return served.cached(b"inventory", lambda: http_api.inventory(served, {}))

    def _run(self, name: str) -> ServedRun:
        return self._server.runs.get(name)

    def _facts(self, name: str) -> dict[str, Any]:
        facts = self._run(name).describe(read_only=True)
        return {key: facts[key] for key in ("id", "name", "encoder", "num_gaussians", "num_views", "saved_prompts",
                                            "examples", "center", "radius", "up")}  # fmt: skip


def make_mcp(server: WarmServer, export_dir: Path | None) -> MCPServer:
    """Return the MCP server of some runs.

    Args:
        export_dir: folder below which the tool export writes; None: there is no such tool.
    """
    mcp = MCPServer("normlift", instructions=_INSTRUCTIONS, version=normlift_ns.__version__, log_level="ERROR")
    tools = Tools(server, export_dir)
    reading = (tools.list_runs, tools.find, tools.list_objects, tools.explain, tools.render, tools.find_floaters,
               tools.measure)  # fmt: skip
    for tool in reading:
        mcp.add_tool(_guarded(server, tool), annotations=_READS, structured_output=False)
    if export_dir is not None and not server.options.read_only:
        mcp.add_tool(_guarded(server, tools.export), annotations=_WRITES, structured_output=False)
    json_type: dict[str, Any] = {"mime_type": "application/json"}
    mcp.resource("normlift://runs", description="All scenes", **json_type)(_guarded(server, tools.list_runs))

    def catalog(run: str) -> str:
        return _text(tools.inventory(run))

    about = "Main objects of a scene with boxes"
    mcp.resource("normlift://runs/{run}/catalog", description=about, **json_type)(_guarded(server, catalog))
    return mcp


def _guarded(server: WarmServer, function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a coroutine function that runs a function in a thread; its errors name no paths of this machine."""

    @wraps(function)
    async def run(**arguments: Any) -> Any:
        try:
            return await server.in_thread(lambda: function(**arguments))
        except Exception as error:
            raise ToolError(without_paths(describe_error(error)[0])) from None

    return run


def _question(prompts: list[str]) -> schema.Question:
    return decode(msgspec.json.encode({"texts": prompts}), schema.Question)


def _selection(prompts: list[str], number: int | None) -> schema.Selection:
    return schema.Selection(_question(prompts), object=number)


def _view_of(served: ServedRun, selection: schema.Selection) -> Any:
    """Return a camera that looks at an object from where nothing occludes it."""
    state = schema.select_state(served, msgspec.structs.replace(selection, object=None))
    return served.view_of(schema.find_object(state, selection.object or 1), None, served.space.empty_mask() == 0)


def _data(url: str) -> bytes:
    from base64 import b64decode  # noqa: PLC0415

    return b64decode(url.partition(",")[2])


def _text(content: Any) -> str:
    """Return JSON, bounded in length and with numbers of few digits."""
    text = msgspec.json.encode(_rounded(msgspec.to_builtins(content))).decode()
    return text if len(text) <= _MAX_RESULT else text[:_MAX_RESULT] + " … (cut off: ask for fewer prompts)"


def _rounded(content: Any) -> Any:
    if isinstance(content, float):
        return float(f"{content:.4g}")
    if isinstance(content, dict):
        return {key: _rounded(value) for key, value in content.items()}
    return [_rounded(value) for value in content] if isinstance(content, list | tuple) else content


def serve_stdio(server: WarmServer, export_dir: Path | None) -> None:
    """Speak MCP on standard input and output until the agent closes it."""
    anyio.run(make_mcp(server, export_dir).run_stdio_async)


def http_options(server: WarmServer, export_dir: Path | None) -> dict[str, Any]:
    """Return the arguments of `WarmServer.start` with which it also speaks MCP at /mcp."""
    mcp = make_mcp(server, export_dir)
    unchecked = TransportSecuritySettings(enable_dns_rebinding_protection=False)  # `app.Guard` checks all requests
    app = mcp.streamable_http_app(json_response=True, stateless_http=True, transport_security=unchecked)
    (route,) = [one for one in app.routes if isinstance(one, Route) and one.path == "/mcp"]

    class Authorized:
        """The endpoint; from other machines, it takes requests with the access token only."""

        async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
            access = dict(scope["headers"]).get(b"authorization", b"").decode("latin-1").removeprefix("Bearer ")
            if server.options.is_local or server.options.knows(access):
                return await route.app(scope, receive, send)
            refused = JSONResponse({"error": "This server needs its access token: Authorization: Bearer TOKEN"}, 401)
            return await refused(scope, receive, send)

    return {"extra_routes": [Route("/mcp", Authorized())], "lifespan": lambda app: mcp.session_manager.run()}
