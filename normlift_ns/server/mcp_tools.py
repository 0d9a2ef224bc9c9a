"""MCP (Model Context Protocol) tools and resources for lifted runs; needs the package mcp."""

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
    raise InputError(f"--mcp needs the package mcp ({error}). Install it: pip install 'normlift-ns[mcp]'") from None

from starlette.responses import JSONResponse
from starlette.routing import Route
from starlette.types import Receive, Scope, Send

import normlift_ns
from normlift_ns.io.atomic import atomic_file, numbered_paths
from normlift_ns.server import http_api, schema
from normlift_ns.server.app import WarmServer
from normlift_ns.server.protocol import ColorMode, decode
from normlift_ns.server.runs import ServedRun, without_paths

_INSTRUCTIONS = """Search trained 3D scenes (Gaussian splats with semantics) by text.
Start with list_runs. Prompts are short nouns such as "red mug". Some encoders accept only certain words; the error for
other prompts suggests words. The verdict on a prompt is found, weak match or probably not here. list_objects counts and
locates objects, render draws them, and explain returns the training images that support a match. Positions are in scene
units."""
_READS = ToolAnnotations(read_only_hint=True, idempotent_hint=True, open_world_hint=False)
_WRITES = ToolAnnotations(read_only_hint=False, destructive_hint=False, open_world_hint=False)
_MAX_RESULT = 60_000
"""Maximum number of characters in a result."""

Run = Annotated[str, Field(description="Id of the run, from list_runs")]
Prompts = Annotated[list[str], Field(description="Short nouns or phrases to search for", max_length=16)]
ObjectNumber = Annotated[int | None, Field(description="Number of an object from list_objects with the same prompts")]
Coordinates = Annotated[list[float], Field(min_length=3, max_length=3)]


class Tools:
    """MCP tools for lifted runs. The docstring of each method is its description for agents."""

    def __init__(self, server: WarmServer, export_dir: Path | None) -> None:
        self._server, self._export_dir = server, export_dir

    def list_runs(self) -> str:
        """List the available scenes, with their encoders, sizes, saved prompts and example prompts."""
        return _text([self._facts(name) for name in self._server.runs.ids])

    def find(self, run: Run, prompts: Prompts) -> str:
        """Search a scene for prompts. The result for each prompt has a verdict (found, weak match, probably not here),
        and the number of selected Gaussians with their position and size. It also has the highest relevancy and the
        position of the best match."""
        rows = msgspec.to_builtins(schema.answered(self._run(run), _question(prompts))[1])
        for row in rows["results"]:
            row.pop("histogram")
        return _text(rows)

    def list_objects(self, run: Run, prompts: Prompts) -> str:
        """List and count the separate objects that match each prompt, the largest first. Each object has a number, a
        box (min and max corner), a center, a number of Gaussians and the strength of its evidence. Without prompts,
        list the main objects of the scene, which takes up to a minute."""
        if len(prompts) == 0:
            return _text(self.inventory(run))
        return _text(schema.objects_result(schema.select_state(self._run(run), _selection(prompts, None))))

    def explain(self, run: Run, prompts: Prompts, object_number: ObjectNumber = None) -> list[Any]:
        """Explain why a scene matches prompts. The result is the agreement of the training images, and up to three of
        these images with outlines around the supporting regions."""
        result = http_api.explain(self._run(run), _selection(prompts, object_number))
        images = [Image(data=_data(vote.url), format="jpeg") for vote in result.support if vote.url is not None]
        facts = msgspec.to_builtins(result)
        for row in (*facts["support"], *facts["disagreement"]):
            row.pop("url")
        return [_text(facts), *images]

    def render(
        self,
        run: Run,
        view: Annotated[str | int, Field(description="Name or index of the training image whose camera to use")] = 0,
        prompts: Prompts = [],  # noqa: B006 (read only)
        object_number: ObjectNumber = None,
        isolate: Annotated[bool, Field(description="Draw only the matches")] = False,
        mode: ColorMode = "overlay",
    ) -> Image:
        """Render a scene as an image. Matches of prompts are highlighted. With prompts and object_number, the camera
        looks at that object."""
        served = self._run(run)
        chosen = _selection(prompts, object_number) if len(prompts) > 0 else None
        look_at = None if chosen is None or object_number is None else _view_of(served, chosen)
        request = schema.RenderRequest(view, None, look_at, chosen, mode, isolate)
        return Image(data=http_api.render(served, request).body, format="jpeg")

    def find_floaters(self, run: Run) -> str:
        """Return the number, center and box of the likely floaters of a scene. Floaters are Gaussians that are not part
        of a surface."""
        return _text(http_api.floaters(self._run(run), {}))

    def measure(self, run: Run, start: Coordinates, end: Coordinates) -> str:
        """Measure the distance between two positions, in scene units and in units of the original capture. Give the
        positions in scene units, as list_objects does."""
        distance = float(np.linalg.norm(np.subtract(start, end)))
        scale = self._run(run).run.to_capture.scale
        return _text({"distance": distance, "distance_in_capture_units": distance * scale})

    def export(
        self,
        run: Run,
        prompts: Prompts,
        object_number: ObjectNumber = None,
        format: Annotated[str, Field(description="ply, glb, or masks for a ZIP file of mask images")] = "ply",
    ) -> str:
        """Write the Gaussians that match prompts, or one of the matching objects, to a new file, and return its name.
        The file is in the export folder of the server. Existing files are never replaced."""
        if self._export_dir is None:
            raise InputError("This server does not export files. Start it with --export-dir.")
        request = schema.ExportRequest(_question(prompts), object=object_number, format=format)
        content = http_api.export(self._run(run), request)
        name = Path(content.name or "selection").name
        path = next(path for path in numbered_paths(self._export_dir / name) if not path.exists())
        with atomic_file(path) as draft:
            draft.write_bytes(content.body)
        return _text({"file": path.name, "bytes": len(content.body)})

    def inventory(self, run: str) -> dict[str, Any]:
        """Return the main objects of a scene as JSON types."""
        served = self._run(run)
        return served.cached(b"inventory", lambda: http_api.inventory(served, {}))

    def _run(self, name: str) -> ServedRun:
        return self._server.runs.get(name)

    def _facts(self, name: str) -> dict[str, Any]:
        facts = self._run(name).describe(read_only=True)
        return {key: facts[key] for key in ("id", "name", "encoder", "num_gaussians", "num_views", "saved_prompts",
                                            "examples", "center", "radius", "up")}  # fmt: skip


def make_mcp(server: WarmServer, export_dir: Path | None) -> MCPServer:
    """Return an MCP server for the runs of a server.

    Args:
        export_dir: Folder that the tool export writes to. The tool is omitted for None, and on a read-only server.
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
    """Return a coroutine function that calls `function` in a thread.

    For every error, it raises ToolError with the message of the error, without absolute paths.
    """

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
    """Return a camera that looks at an object from a position with little occlusion, if there is one."""
    state = schema.select_state(served, msgspec.structs.replace(selection, object=None))
    return served.view_of(schema.find_object(state, selection.object or 1), None, served.space.empty_mask() == 0)


def _data(url: str) -> bytes:
    from base64 import b64decode  # noqa: PLC0415

    return b64decode(url.partition(",")[2])


def _text(content: Any) -> str:
    """Encode content as JSON with four significant digits, cut off after `_MAX_RESULT` characters."""
    text = msgspec.json.encode(_rounded(msgspec.to_builtins(content))).decode()
    return text if len(text) <= _MAX_RESULT else text[:_MAX_RESULT] + f" … (cut off after {_MAX_RESULT:,} characters)"


def _rounded(content: Any) -> Any:
    if isinstance(content, float):
        return float(f"{content:.4g}")
    if isinstance(content, dict):
        return {key: _rounded(value) for key, value in content.items()}
    return [_rounded(value) for value in content] if isinstance(content, list | tuple) else content


def serve_stdio(server: WarmServer, export_dir: Path | None) -> None:
    """Serve MCP on standard input and output until the agent closes them."""
    anyio.run(make_mcp(server, export_dir).run_stdio_async)


def http_options(server: WarmServer, export_dir: Path | None) -> dict[str, Any]:
    """Return the arguments of `WarmServer.start` that add the MCP endpoint /mcp."""
    mcp = make_mcp(server, export_dir)
    unchecked = TransportSecuritySettings(enable_dns_rebinding_protection=False)  # `app.Guard` checks all requests
    app = mcp.streamable_http_app(json_response=True, stateless_http=True, transport_security=unchecked)
    (route,) = [one for one in app.routes if isinstance(one, Route) and one.path == "/mcp"]

    class Authorized:
        """Endpoint /mcp, which requires the access token unless the server listens on localhost only."""

        async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
            access = dict(scope["headers"]).get(b"authorization", b"").decode("latin-1").removeprefix("Bearer ")
            if server.options.is_local or server.options.knows(access):
                return await route.app(scope, receive, send)
            refused = JSONResponse(
                {"error": "MCP needs the access token in the header Authorization: Bearer TOKEN"}, 401
            )
            return await refused(scope, receive, send)

    return {"extra_routes": [Route("/mcp", Authorized())], "lifespan": lambda app: mcp.session_manager.run()}
