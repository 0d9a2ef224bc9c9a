"""An agent that does not know the scene counts, finds, looks and exports, by the client of the official package."""

import asyncio
import json
import sys
from importlib.util import find_spec
from typing import Any

import pytest

from normlift_ns import open_run
from normlift_ns.server.app import ServerOptions, WarmServer
from normlift_ns.server.runs import RunStore
from tests.server.pages import make_served, make_server, running

pytestmark = pytest.mark.skipif(find_spec("mcp") is None, reason="mcp is not installed")


def texts(result: Any) -> Any:
    return json.loads(result.content[0].text)


async def walk(target: Any) -> list[str]:
    """Lists, finds, counts, looks, measures and exports; returns the names of exported files."""
    from mcp import Client  # noqa: PLC0415 (slow)

    async with Client(target) as agent:
        tools = {tool.name: tool for tool in (await agent.list_tools()).tools}
        assert all(len(tool.description or "") > 60 for tool in tools.values())
        (run,) = texts(await agent.call_tool("list_runs", {}))
        assert "red" in run["saved_prompts"] and run["num_gaussians"] > 1000
        which = {"run": run["id"]}
        found = texts(await agent.call_tool("find", {**which, "prompts": ["red", "purple"]}))["results"]
        assert [row["text"] for row in found] == ["red", "purple"] and found[0]["verdict"] == "found"
        objects = texts(await agent.call_tool("list_objects", {**which, "prompts": ["red"]}))["objects"]
        first = objects[0]
        assert first["count"] == max(one["count"] for one in objects) and first["min"][0] < first["max"][0]
        picture = await agent.call_tool("render", {**which, "prompts": ["red"], "object_number": 1})
        assert picture.content[0].type == "image" and len(picture.content[0].data) > 1000
        sides = {"start": first["min"], "end": first["max"]}
        assert texts(await agent.call_tool("measure", {**which, **sides}))["distance"] > 0
        why = await agent.call_tool("explain", {**which, "prompts": ["red"]})
        assert "images" in texts(why)["text"] and [one.type for one in why.content[1:]] == ["image"] * 3
        for arguments, words in (
            ({"run": "../other", "prompts": ["red"]}, "no run"),
            ({**which, "prompts": ["red"], "object_number": 99}, "no object 99"),
        ):
            wrong = await agent.call_tool("list_objects" if "object_number" not in arguments else "explain", arguments)
            text = wrong.content[0].text
            assert wrong.is_error and words in text and "/" not in text.split("run")[0]
        resource = await agent.read_resource(f"normlift://runs/{run['id']}/catalog")
        assert len(json.loads(resource.contents[0].text)["objects"]) > 0
        if "export" not in tools:
            return []
        names = [texts(await agent.call_tool("export", {**which, "prompts": ["red"]}))["file"] for _ in range(2)]
        assert not (await agent.call_tool("export", {**which, "prompts": ["red"], "object_number": 1})).is_error
        return names


def test_an_agent_walks_over_http(lifted, tmp_path):
    from normlift_ns.server.mcp_tools import http_options  # noqa: PLC0415

    server = WarmServer(RunStore([lifted], open_run), ServerOptions(port=0))
    with running(server, **http_options(server, tmp_path / "exports")) as port:
        first, second = asyncio.run(walk(f"http://127.0.0.1:{port}/mcp"))
    assert first != second and (tmp_path / "exports" / first).read_bytes()[:3] == b"ply"
    assert {path.suffix for path in (tmp_path / "exports").iterdir()} == {".ply"}


def test_a_read_only_server_and_one_without_a_folder_export_nothing(tmp_path):
    from normlift_ns.server.mcp_tools import make_mcp  # noqa: PLC0415

    served = make_served(tmp_path)
    for options, folder in (({"read_only": True}, tmp_path), ({}, None)):
        tools = asyncio.run(make_mcp(make_server(served, **options), folder).list_tools())
        assert "export" not in {tool.name for tool in tools} and len(tools) == 7


def test_elsewhere_mcp_needs_the_token(tmp_path):
    from starlette.testclient import TestClient  # noqa: PLC0415

    from normlift_ns.server.mcp_tools import http_options  # noqa: PLC0415

    server = make_server(make_served(tmp_path), host="0.0.0.0", access_token="secret")
    hello = {"jsonrpc": "2.0", "id": 1, "method": "tools/list"}
    kinds = {"Accept": "application/json, text/event-stream"}
    with TestClient(server.app(**http_options(server, None)), base_url="http://localhost") as client:
        for token, status in (("", 401), ("secre", 401), ("secret", 200)):
            answer = client.post("/mcp", json=hello, headers={**kinds, "Authorization": f"Bearer {token}"})
            assert answer.status_code == status, answer.text
        evil = {**kinds, "Authorization": "Bearer secret", "Origin": "https://evil.example"}
        assert client.post("/mcp", json=hello, headers=evil).status_code == 403


@pytest.mark.slow
def test_an_agent_starts_the_command(lifted, tmp_path):
    from mcp import StdioServerParameters  # noqa: PLC0415 (slow)

    command = ["-m", "normlift_ns.cli.serve", str(lifted), "--mcp", "--export-dir", str(tmp_path / "out")]
    first, second = asyncio.run(walk(StdioServerParameters(command=sys.executable, args=command)))
    assert {first, second} < {path.name for path in (tmp_path / "out").iterdir()}
