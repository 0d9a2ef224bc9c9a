"""Starlette application for the web page, its sessions and the HTTP API, and the server that runs it."""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import html
import ipaddress
import mimetypes
import re
import secrets
import socket
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import anyio
import torch
import uvicorn
from anyio import CapacityLimiter
from starlette.applications import Starlette
from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import FileResponse, HTMLResponse, JSONResponse, PlainTextResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocket, WebSocketDisconnect
from uvicorn.protocols.http.h11_impl import H11Protocol

import normlift_ns
from normlift_ns.errors import InputError, describe_error
from normlift_ns.server.host_check import accepted_names, refuse_request
from normlift_ns.server.http_api import api_routes
from normlift_ns.server.runs import RunStore, ServedRun, without_paths
from normlift_ns.server.session import PageLimits, PageSession

PAGE_FOLDER = Path(normlift_ns.__file__).parent / "page"
"""Folder of the built web page."""
BUILD_COMMAND = "python setup.py build_page"
CONTENT_SECURITY_POLICY = (
    "default-src 'none'; script-src 'self' 'wasm-unsafe-eval'; worker-src 'self' blob:; img-src 'self' data: blob:; "
    "connect-src 'self' blob: data:; style-src 'self' 'unsafe-inline'; font-src 'self'; base-uri 'none'; "
    "form-action 'none'; frame-ancestors 'none'"
)
MAX_BODY = 4 * 2**20
"""Maximum size of a request body and of a WebSocket message, in bytes."""
MAX_PAGES = 64
"""Maximum number of open pages."""
MAX_CONNECTIONS = 512
REQUEST_TIMEOUT = 120.0
"""Maximum duration of a request in seconds, after which the server responds with status 504."""
_HEADER_TIMEOUT, _BODY_TIMEOUT, _KEEP_ALIVE = 10.0, 20.0, 20
_MAX_DOWNLOADS, _MAX_DOWNLOAD_BYTES = 16, 2**29
_TRIM_INTERVAL = 2.0
_IDLE_SECONDS = 1.0
"""Seconds without a request before the server computes data in advance."""
_QUICK_THREADS = 4
_THREADS = max(2, torch.get_num_threads() // 2)
"""Number of threads for queries, and number of additional threads for slower work. A thread may use several cores."""
_HEADERS = {
    "Content-Security-Policy": CONTENT_SECURITY_POLICY, "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer", "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin", "X-Frame-Options": "DENY",
}  # fmt: skip

T = TypeVar("T")


@dataclass(frozen=True)
class ServerOptions:
    """Options of the server."""

    host: str = "127.0.0.1"
    port: int = 7008
    allowed_hosts: tuple[str, ...] = ()
    read_only: bool = False
    access_token: str = field(default_factory=lambda: secrets.token_urlsafe(18))
    """Token for MCP, and for requests that write into a run; not required if the server listens on localhost only."""

    @property
    def is_local(self) -> bool:
        """True if only this machine can reach the server."""
        try:
            return self.host == "localhost" or ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return False

    def knows(self, access: str) -> bool:
        """Return True if `access` is the access token."""
        return secrets.compare_digest(access.encode(), self.access_token.encode())

    def may_write(self, access: str) -> bool:
        """Return True if a request with the token `access` may write into a run."""
        return not self.read_only and (self.is_local or self.knows(access))


class Guard:
    """ASGI middleware that checks Host and Origin headers, limits request size and time, and adds security headers."""

    def __init__(self, app: ASGIApp, names: frozenset[str]) -> None:
        self._app, self._names = app, names

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one HTTP request or WebSocket connection."""
        if scope["type"] not in ("http", "websocket"):
            return await self._app(scope, receive, send)
        headers = Headers(scope=scope)
        refused = refuse_request(headers.getlist("host"), headers.getlist("origin"), self._names)
        if scope["type"] == "websocket":
            if refused is None:
                return await self._app(scope, receive, send)
            return await _refuse_websocket(scope, receive, send, refused)
        if refused is not None:
            return await PlainTextResponse(f"403: {refused}\n", 403, _HEADERS)(scope, receive, send)
        length = headers.get("content-length", "0")
        if not length.isdecimal() or len(length) > 20 or int(length) > MAX_BODY:
            response = JSONResponse(
                {"error": f"The request body exceeds the limit of {MAX_BODY:,} bytes."}, 413, _HEADERS
            )
            return await response(scope, receive, send)
        started = False

        async def send_with_headers(message: Message) -> None:
            nonlocal started
            if message["type"] == "http.response.start":
                started = True
                given = {name for name, _ in message["headers"]}
                new = ((name.lower().encode(), value.encode()) for name, value in _HEADERS.items())
                message["headers"] = [*message["headers"], *(pair for pair in new if pair[0] not in given)]
            await send(message)

        try:
            with anyio.fail_after(REQUEST_TIMEOUT):
                await self._app(scope, _limited(receive), send_with_headers)
        except TimeoutError:
            if not started:
                text = (
                    f"The request took longer than the limit of {REQUEST_TIMEOUT:g} seconds. Requests with fewer "
                    "prompts or smaller images take less time."
                )
                await JSONResponse({"error": text}, 504, _HEADERS)(scope, receive, send)
        return None


class _PromptProtocol(H11Protocol):
    """HTTP protocol that closes a connection if request headers do not arrive in time; uvicorn has no such timeout."""

    _deadline: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Start the timeout for the first request."""
        super().connection_made(transport)
        self._watch()

    def data_received(self, data: bytes) -> None:
        """Handle data, and run the timeout until the headers of a request are complete."""
        super().data_received(data)
        self._watch()

    def connection_lost(self, exc: Exception | None) -> None:
        """Stop the timeout."""
        self._stop_watching()
        super().connection_lost(exc)

    def _watch(self) -> None:
        busy = self.cycle is not None and not self.cycle.response_complete
        if busy or self.transport.get_protocol() is not self:  # a request has arrived, or this is a websocket now
            self._stop_watching()
        elif self._deadline is None:
            self._deadline = self.loop.call_later(_HEADER_TIMEOUT, self.transport.close)

    def _stop_watching(self) -> None:
        if self._deadline is not None:
            self._deadline.cancel()
            self._deadline = None


def _limited(receive: Receive) -> Receive:
    """Wrap `receive` to raise HTTPException if the body is too large or arrives too slowly."""
    total = 0

    async def limited() -> Message:
        nonlocal total
        if total < 0:
            return await receive()
        try:
            with anyio.fail_after(_BODY_TIMEOUT):
                message = await receive()
        except TimeoutError:
            raise HTTPException(408, "The request body did not arrive in time. Send the request again.") from None
        if message["type"] == "http.request":
            total += len(message.get("body", b""))
            if total > MAX_BODY:
                raise HTTPException(413, f"The request body exceeds the limit of {MAX_BODY:,} bytes.")
            total = total if message.get("more_body") else -1
        return message

    return limited


def _accepts_gzip(header: str) -> bool:
    """Return True if an Accept-Encoding header lists gzip with a weight above 0.

    >>> [_accepts_gzip(one) for one in ("br, gzip;q=0.8", "GZIP", "gzip;q=0", "gzip; q=0.0", "br", "")]
    [True, True, False, False, False, False]
    """
    return re.search(r"(?:^|,)\s*gzip\s*(?!;\s*q=0(?:\.0*)?\s*(?:,|$))(?:[;,]|$)", header, re.IGNORECASE) is not None


async def _refuse_websocket(scope: Scope, receive: Receive, send: Send, reason: str) -> None:
    await receive()
    if "websocket.http.response" in scope.get("extensions", {}):
        headers = [(b"content-type", b"text/plain; charset=utf-8")]
        await send({"type": "websocket.http.response.start", "status": 403, "headers": headers})
        await send({"type": "websocket.http.response.body", "body": f"403: {reason}\n".encode()})
    else:
        await send({"type": "websocket.close", "code": 1008, "reason": reason[:120]})


class WarmServer:
    """HTTP server for lifted runs, with the web page, its sessions and the HTTP API on one port.

    Args:
        runs: Store of the runs.
        options: Address, port and write access.
    """

    def __init__(self, runs: RunStore, options: ServerOptions) -> None:
        self.runs, self.options = runs, options
        self.limits = PageLimits(
            CapacityLimiter(_QUICK_THREADS),
            CapacityLimiter(_THREADS),
            CapacityLimiter(_THREADS),
            self.may_write,
            self.offer,
        )
        self._opening = CapacityLimiter(MAX_PAGES)
        self._downloads: OrderedDict[str, tuple[str, bytes]] = OrderedDict()
        self._pages, self._next_trim = 0, 0.0
        self._num_working, self._last_work = 0, 0.0
        self._server: uvicorn.Server | None = None

    def app(self, extra_routes: Sequence[Any] = (), lifespan: Any = None) -> ASGIApp:
        """Return the ASGI application.

        Args:
            extra_routes: Routes in addition to those of the page and the API.
            lifespan: Starlette lifespan context of the application.
        """
        routes = [
            Route("/", self._page), Route("/assets/{path:path}", self._asset), Route("/favicon.ico", _no_icon),
            Route("/api/runs", self._list_runs), Route("/api/runs/{run}/geometry", self._geometry),
            Route("/api/runs/{run}/cameras", self._cameras),
            Route("/api/runs/{run}/images/{index:int}", self._image),
            Route("/api/downloads/{key}/{name}", self._download),
            WebSocketRoute("/api/runs/{run}/session", self._session),
            *api_routes(self), *extra_routes,
        ]  # fmt: skip
        handlers: dict[Any, Any] = {
            Exception: _failed,
            HTTPException: _http_error,
            InputError: _failed,
            OSError: _failed,
        }
        app = Starlette(routes=routes, exception_handlers=handlers, lifespan=lifespan)
        return Guard(app, accepted_names(self.options.host, self.options.allowed_hosts))

    async def run_of(self, name: str) -> ServedRun:
        """Return the run with the id `name`, and open it if necessary.

        Raises:
            HTTPException: No run has this id (status 404).
        """
        if name not in self.runs.ids:
            raise HTTPException(404, f"The server has no run {name[:80]!r}. Choose one of: {', '.join(self.runs.ids)}.")
        return await anyio.to_thread.run_sync(self.runs.get, name, limiter=self._opening, abandon_on_cancel=True)

    async def in_thread(self, work: Callable[[], T], *, slow: bool = True) -> T:
        """Call `work` in a thread, and return its result.

        Args:
            slow: True to use the threads for slow work, False to use those for queries.
        """
        limiter = self.limits.slow if slow else self.limits.asking
        self._num_working += 1
        try:
            result = await anyio.to_thread.run_sync(work, limiter=limiter, abandon_on_cancel=True)
        finally:
            self._num_working, self._last_work = self._num_working - 1, time.monotonic()
        if time.monotonic() > self._next_trim:
            self._next_trim = time.monotonic() + _TRIM_INTERVAL
            await anyio.to_thread.run_sync(_trim_memory, limiter=self.limits.slow, abandon_on_cancel=True)
        return result

    def warm_up(self) -> None:
        """Compute in advance the data that the first pages need, mostly while no request is in progress."""
        self.runs.warm_up(self._wait_until_idle)

    def _wait_until_idle(self) -> None:
        while self._num_working > 0 or time.monotonic() < self._last_work + _IDLE_SECONDS:
            time.sleep(_IDLE_SECONDS / 10)

    def may_write(self, access: str) -> bool:
        """Return True if a request with the token `access` may write into a run."""
        return self.options.may_write(access)

    def offer(self, name: str, content: bytes) -> str:
        """Store a file for download, and return its URL path.

        If the stored files exceed a limit on their number or total size, the oldest ones are deleted.
        """
        key = secrets.token_urlsafe(16)
        self._downloads[key] = name, content
        while len(self._downloads) > 1 and (
            len(self._downloads) > _MAX_DOWNLOADS
            or sum(len(one) for _, one in self._downloads.values()) > _MAX_DOWNLOAD_BYTES
        ):
            self._downloads.popitem(last=False)
        return f"/api/downloads/{key}/{name}"

    async def _page(self, request: Request) -> Response:
        index = PAGE_FOLDER / "index.html"
        if index.is_file():
            return FileResponse(index, headers={"Cache-Control": "no-cache"})
        text = f"The web page is not built. Build it with: {BUILD_COMMAND}"
        return HTMLResponse(f"<!doctype html><title>normlift</title><p>{html.escape(text)}</p>")

    async def _asset(self, request: Request) -> Response:
        folder = PAGE_FOLDER / "assets"
        path = folder / request.path_params["path"]
        if ".." in path.parts or not path.is_file() or folder.resolve() not in path.resolve().parents:
            raise HTTPException(404)
        headers = {"Cache-Control": "no-cache", "Vary": "Accept-Encoding"}
        compressed = path.with_name(f"{path.name}.gz")
        if compressed.is_file() and _accepts_gzip(request.headers.get("accept-encoding", "")):
            media_type = mimetypes.guess_type(path.name)[0]
            return FileResponse(compressed, headers={**headers, "Content-Encoding": "gzip"}, media_type=media_type)
        return FileResponse(path, headers=headers)

    async def _list_runs(self, request: Request) -> Response:
        """List the runs that can be opened; if there are none, raise the first error.

        The method holds one run at a time, because all runs together may exceed the memory limit.
        """
        runs, errors = [], []
        for name in self.runs.ids:
            try:
                describe = partial((await self.run_of(name)).describe, read_only=self.options.read_only)
                runs.append(await self.in_thread(describe))
            except (InputError, OSError) as error:
                errors.append(error)
        if len(runs) == 0 and len(errors) > 0:
            raise errors[0]
        return JSONResponse({"runs": runs})

    async def _geometry(self, request: Request) -> Response:
        run = await self.run_of(request.path_params["run"])
        content, digest = await self.in_thread(lambda: run.geometry)
        lifetime = "max-age=31536000, immutable" if request.query_params.get("digest") == digest else "no-cache"
        headers = {"ETag": f'"{digest}"', "Cache-Control": f"private, {lifetime}"}
        if request.headers.get("if-none-match") == f'"{digest}"':
            return Response(status_code=304, headers=headers)
        return Response(content, headers=headers, media_type="application/octet-stream")

    async def _cameras(self, request: Request) -> Response:
        train = (await self.run_of(request.path_params["run"])).run.scene.train
        cameras = [
            {"name": name, "world_to_camera": camera.world_to_camera.tolist(), "K": camera.K.tolist(),
             "width": camera.width, "height": camera.height}
            for name, camera in zip(train.names, train.cameras)
        ]  # fmt: skip
        return JSONResponse({"cameras": cameras})

    async def _image(self, request: Request) -> Response:
        run, size = await self.run_of(request.path_params["run"]), request.query_params.get("max_size", "1024")
        if not size.isdecimal() or len(size) > 4 or not 16 <= int(size) <= 4096:
            raise InputError(f"max_size must be a whole number from 16 to 4096, got {size[:20]!r}.")
        content = await self.in_thread(partial(run.image, request.path_params["index"], int(size)))
        return Response(content, headers={"Cache-Control": "private, max-age=3600"}, media_type="image/jpeg")

    async def _download(self, request: Request) -> Response:
        name, content = self._downloads.get(request.path_params["key"], (None, b""))
        if name != request.path_params["name"]:
            raise HTTPException(404, "This download has expired. Export the Gaussians again.")
        headers = {"Content-Disposition": f'attachment; filename="{name}"', "Cache-Control": "no-store"}
        return Response(content, headers=headers, media_type="application/octet-stream")

    async def _session(self, websocket: WebSocket) -> None:
        try:
            await websocket.accept()
            if self._pages >= MAX_PAGES:
                return await websocket.close(1013, f"The limit of {MAX_PAGES} open pages is reached. Close one.")
            self._pages += 1
            try:
                run = await self.run_of(websocket.path_params["run"])
                await PageSession(run, websocket, self.limits).run()
            finally:
                self._pages -= 1
        except (WebSocketDisconnect, anyio.BrokenResourceError):
            return None
        except HTTPException as error:
            return await websocket.close(1008, error.detail[:120])
        except Exception as error:
            ended = all(isinstance(one, WebSocketDisconnect) for one in getattr(error, "exceptions", [error]))
            return None if ended else await _close(websocket, error)

    def start(self, extra_routes: Sequence[Any] = (), lifespan: Any = None) -> int:
        """Start the server in a thread, and return its port: `options.port` or, if it is in use, the next free one.

        For port 0, the operating system chooses a free port.

        Raises:
            InputError: Neither the port nor any of the 99 ports after it is available.
        """
        listener = _bind(self.options.host, self.options.port)
        config = uvicorn.Config(
            self.app(extra_routes, lifespan), log_config=None, log_level="error", access_log=False, server_header=False,
            http=_PromptProtocol, ws="websockets-sansio", ws_max_size=MAX_BODY, ws_per_message_deflate=False,
            ws_ping_interval=20.0, timeout_keep_alive=_KEEP_ALIVE, timeout_graceful_shutdown=2,
            limit_concurrency=MAX_CONNECTIONS,
        )  # fmt: skip
        self._server = uvicorn.Server(config)
        threading.Thread(target=self._server.run, args=([listener],), daemon=True).start()
        return listener.getsockname()[1]

    def stop(self) -> None:
        """Stop the server."""
        if self._server is not None:
            self._server.should_exit = True


def _trim_memory() -> None:
    """Return freed memory to the operating system; glibc would keep hundreds of megabytes of it."""
    with contextlib.suppress(AttributeError, OSError, TypeError):  # another C library
        ctypes.CDLL(None).malloc_trim(0)


async def _close(websocket: WebSocket, error: BaseException) -> None:
    """Close a WebSocket with the message of an error as the reason, unless it is closed already."""
    while isinstance(getattr(error, "exceptions", None), tuple):
        error = error.exceptions[0]  # type: ignore[attr-defined]
    late = isinstance(error, TimeoutError)
    reason = "The page started too slowly." if late else without_paths(describe_error(error)[0])
    try:
        await websocket.close(1008 if isinstance(error, InputError | TimeoutError) else 1011, reason[:120])
    except RuntimeError:  # already closed
        return


def _bind(host: str, port: int) -> socket.socket:
    """Return a socket that listens on `port` or, if it is in use, on the next free one of the 99 ports after it.

    For port 0, the operating system chooses a free port.

    Raises:
        InputError: None of these ports is available.
    """
    family, kind, protocol, _, address = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)[0]
    for number in [0] if port == 0 else range(port, min(port + 100, 65536)):
        listener = socket.socket(family, kind, protocol)
        try:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.bind((address[0], number, *address[2:]))
            listener.listen(256)
        except OSError:
            listener.close()
        else:
            return listener
    last = min(port + 99, 65535)
    found = f"None of the ports from {port} to {last} is" if 0 < port < last else f"Port {port} is not"
    raise InputError(f"{found} available. Choose another port.")


async def _no_icon(request: Request) -> Response:
    return Response(status_code=204)


async def _http_error(request: Request, error: HTTPException) -> Response:
    return JSONResponse({"error": error.detail}, error.status_code)


async def _failed(request: Request, error: Exception) -> Response:
    """Return the message of an error as a JSON response, without absolute paths."""
    message, code = describe_error(error)
    return JSONResponse({"error": without_paths(message)}, 400 if code == 1 else 500)
