"""What viser's server serves: the files of its page with our script in it, and nothing else."""

from __future__ import annotations

import contextlib
import http
import warnings
from collections.abc import Iterator
from typing import Any
from urllib.parse import unquote

from normlift_ns.viewer.blind.page import with_script


@contextlib.contextmanager
def guarded() -> Iterator[None]:
    """Servers of viser that start within serve the files of its page only, with our script for browsers without WebGL
    in it, and do not compress.

    By itself 0.2.7 serves every file that a path with .. leads to, and spends seconds on compressing colours.
    """
    from viser.infra import _infra as known  # noqa: PLC0415

    _infra: Any = known
    if not hasattr(_infra, "WebSocketServerProtocol"):  # 1.x
        with _guarded_one():
            yield
        return
    module = _infra.websockets.server
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of websockets, whose older half viser calls
        serve = module.serve

    def guarded_serve(handler: Any, host: str, port: int, *, process_request: Any = None, **options: Any) -> Any:
        async def request(path: str, headers: Any) -> Any:
            place = unquote(path.partition("?")[0])
            if headers.get("Upgrade") == "websocket":
                return await process_request(path, headers)
            if ".." in place.split("/") or not place.startswith("/"):
                return http.HTTPStatus.NOT_FOUND, {}, b"404"
            try:
                if place not in ("/", "/index.html"):
                    return await process_request(path, headers)
                status, told, content = await process_request(path, {})  # not compressed
            except (OSError, ValueError):  # such as a folder, or a name that is too long
                return http.HTTPStatus.NOT_FOUND, {}, b"404"
            return status, told, with_script(content)

        return serve(handler, host, port, process_request=request, **{**options, "compression": None})

    module.serve = guarded_serve
    try:
        yield
    finally:
        module.serve = serve


@contextlib.contextmanager
def _guarded_one() -> Iterator[None]:
    """The same of viser 1.x, which lets nobody out of its folder and does not compress."""
    from viser.infra import _infra  # noqa: PLC0415

    one: Any = _infra
    module, Headers, Response = one.websockets.asyncio.server, one.Headers, one.Response
    serve: Any = module.serve
    missing = (http.HTTPStatus.NOT_FOUND, "Not Found", Headers({"Content-Length": "3"}), b"404")

    def guarded_serve(*handlers: Any, process_request: Any = None, **options: Any) -> Any:
        def request(connection: Any, asked: Any) -> Any:
            place = asked.path.partition("?")[0]
            if asked.headers.get("Upgrade") == "websocket":
                return process_request(connection, asked)
            if place.startswith("//"):
                return Response(*missing)
            is_page = place in ("/", "/index.html")
            if is_page:
                asked.headers.pop("Accept-Encoding", None)
            try:
                found = process_request(connection, asked)
            except (OSError, ValueError):  # such as a name that is too long
                return Response(*missing)
            if not is_page:
                return found
            content = with_script(found.body)
            headers = Headers({"Content-Type": "text/html", "Content-Length": str(len(content))})
            return Response(found.status_code, found.reason_phrase, headers, content)

        return serve(*handlers, process_request=request, **options)

    module.serve = guarded_serve
    try:
        yield
    finally:
        module.serve = serve
