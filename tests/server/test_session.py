"""Every action of a page does what it says, and pages are apart."""

import threading
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from starlette.websockets import WebSocketDisconnect

from normlift_ns.io.run_dir import FIELD_FOLDER
from normlift_ns.query.question import load_query
from normlift_ns.server import runs
from normlift_ns.server.permalink import read_link
from tests.server.pages import client_of, make_served, make_server, opened
from tests.session.worlds import BLOCK, read, rows
from tests.viewer.test_widgets import FakeVotes


@pytest.fixture
def served(tmp_path):
    return make_served(tmp_path)


@pytest.fixture
def client(served):
    with client_of(make_server(served)) as client:
        yield client


@pytest.fixture
def page(client):
    with opened(client) as page:
        yield page


def ray(served, gaussian: int) -> dict:
    """That of a click on a Gaussian, from above."""
    x, y, z = served.space.means[gaussian].tolist()
    return {"origin": [x, y, z + 5], "direction": [0, 0, -1]}


def from_above(center: float, width: int = 40) -> dict:
    """A camera above a cube that sees 8 x 8 units of it."""
    K = [[50.0, 0, width / 2], [0, 50.0, width / 2], [0, 0, 1]]
    pose = [[1.0, 0, 0, -center], [0, -1, 0, 1.5], [0, 0, -1, 13], [0, 0, 0, 1]]
    return {"K": K, "world_to_camera": pose, "width": width, "height": width}


def test_a_page_begins_at_the_first_image_in_the_colors_of_the_scene(page):
    camera = next(message for message in page.told if message["type"] == "camera")
    assert camera["position"] == pytest.approx([0, 0, 0], abs=1e-6) and camera["up"] == pytest.approx([0, -1, 0])
    assert camera["look_at"][2] > 0 and camera["fov"] == pytest.approx(max(0.3, 2 * np.arctan(6 / 50)))
    assert len(page.codes) == 4 * BLOCK and set(page.codes) == {0}
    assert page.state["color_mode"] == "rgb" and page.state["objects"] == [] and page.state["total"] == 4 * BLOCK
    assert [message["type"] for message in page.told] == ["token", "camera", "codes", "state", "state"]


def test_questions_colors_and_history(page):
    page.do("ask", {"line": "red, zebra; blue"})
    found = {row["text"]: row for row in page.state["prompts"]}
    assert (found["red"]["count"], found["blue"]["count"]) == (2 * BLOCK, BLOCK)
    assert "unknown" in found["zebra"]["error"] and found["zebra"]["count"] is None
    assert page.state["selected"] == page.state["selected_visible"] == 3 * BLOCK
    assert page.state["color_mode"] == "overlay"
    for gaussian, prompt in ((0, "red"), (BLOCK, "blue")):  # one scheme: the chip has the color of the picture
        assert page.color(gaussian)[:3] == [round(255 * x) for x in found[prompt]["color"]]
    assert page.color(3 * BLOCK)[3:] == [0, 1]  # gray
    assert page.state["legend"] is None and len(page.state["histogram"]) == 2
    asked = page.state["threshold"]
    page.do("show_prompt", 0)
    assert page.state["selected"] == 2 * BLOCK and page.state["legend"]["label"] == "relevancy"
    page.do("threshold", 0.9)
    page.do("threshold", 0.9999)  # one step with the one before
    assert [one["text"] for one in page.state["history"]][1:] == ["Ask red, zebra, blue", "Show red", "Threshold 1"]
    page.do("undo")
    assert page.state["threshold"] == asked and page.state["step"] == 2
    page.do("redo")
    assert page.state["threshold"] == 0.9999
    page.do("go_to_step", 1)
    assert page.state["shown"] is None and page.state["line"] == "red, zebra, blue"
    page.do("ask", {"line": "green"})
    assert page.state["selected"] == 0 and page.state["threshold"] < 0.9999  # not that of the question before
    assert "Nothing is selected" in page.refused("isolate")
    page.do("ask", {"line": "red"})
    page.do("ask", {"line": "zebra"})  # the answer before it goes
    assert "unknown" in page.state["prompts"][0]["error"] and page.state["selected"] == 0
    assert page.state["histogram"] is page.state["threshold"] is None and set(page.codes) == {0}
    assert any(message["type"] == "message" and "zebra" in message["text"] for message in page.told)
    page.do("undo")
    assert page.state["selected"] == 2 * BLOCK and page.state["line"] == "red" and page.color(0)[3] > 0
    page.do("clear")
    assert set(page.codes) == {0}  # the colors of the scene
    assert page.state["line"] == "" and page.state["prompts"] == [] and page.state["histogram"] is None


@pytest.mark.parametrize("mode", ["heat", "prompts", "reliability", "pca", "rgb", "overlay"])
def test_color_modes(page, served, mode):
    page.do("ask", {"line": "red"})
    page.do("color_mode", mode)
    page.do("colormap", "inferno")
    assert len(page.palette) <= 255 and int(page.codes.max()) < len(page.palette)
    red, blue, none = (page.color(gaussian) for gaussian in (0, BLOCK, 3 * BLOCK))
    assert (red != blue) == (mode != "rgb")
    reliability = served.space.field.scalars.reliability
    if mode == "reliability":
        assert (page.state["legend"]["low"], page.state["legend"]["high"]) == (0, 1)
        assert red[3] == 1 and none != red and reliability[0] > reliability[3 * BLOCK]
    page.do("hide")
    assert page.color(0) is None and page.color(BLOCK) is not None


def test_clicks_take_away_exactly_what_they_added(page, served):
    def pick(gaussian: int, mode: str = "select") -> int:
        page.do("pick", {**ray(served, gaussian), "mode": mode})
        return page.state["selected"]

    assert pick(0) == BLOCK and page.state["by_hand"] and page.state["color_mode"] == "overlay"
    assert pick(BLOCK, "add") == 2 * BLOCK
    assert pick(0, "remove") == BLOCK
    page.do("ask", {"line": "red"})
    assert pick(0, "add") == 2 * BLOCK and pick(0, "remove") == BLOCK  # the prompt selects it already
    assert "semantics" in page.refused("pick", {**ray(served, 3 * BLOCK), "mode": "add"})
    page.do("pick", {**ray(served, BLOCK), "mode": "like"})
    assert page.state["line"] == "like click 1" and page.state["selected"] == BLOCK
    page.do("invert")
    assert page.state["selected"] == 3 * BLOCK


def test_touching_objects_of_two_prompts_are_two_objects(page, served):
    served.space.means[BLOCK : 2 * BLOCK, 0] -= 96.0  # next to the first cube
    vars(served).pop("drawn_scene", None)
    page.do("ask", {"line": "red, blue"})
    page.do("pick", {**ray(served, 5)})
    assert page.state["selected"] == BLOCK
    page.do("pick", {**ray(served, BLOCK + 5), "mode": "add"})
    page.do("pick", {**ray(served, 5), "mode": "remove"})
    assert page.state["selected"] == BLOCK


def test_regions_take_what_is_visible(page, served):
    whole = [[0, 0], [40, 0], [40, 40], [0, 40]]
    page.do("region", {"polygon": whole, "camera": from_above(1.5)})
    seen = page.state["selected"]
    assert 16 <= seen < BLOCK  # the upper layers, and not what they occlude
    page.do("region", {"polygon": [[0, 0], [20, 0], [20, 40], [0, 40]], "camera": from_above(1.5), "mode": "remove"})
    assert page.state["selected"] == seen // 2
    page.do("brush", {"points": [[12, 5], [12, 35]], "radius": 9, "camera": from_above(1.5), "mode": "add"})
    assert page.state["selected"] == seen
    assert "no visible Gaussians" in page.refused("region", {"polygon": whole, "camera": from_above(50.0)})
    page.do("layer_add", {"name": "top"})
    page.do("clear")
    page.do("layer_visible", {"name": "top", "visible": False})
    assert page.state["layers"] == [{"name": "top", "count": seen, "visible": False}]
    assert page.state["hidden"] == seen == int((page.codes == 255).sum())
    page.do("layer_select", {"name": "top"})
    assert (page.state["selected"], page.state["selected_visible"]) == (seen, 0)
    page.do("layer_remove", {"name": "top"})
    assert page.state["hidden"] == 0 and "no layer" in page.refused("layer_select", {"name": "top"})


def test_objects_have_actions_and_the_pointer_tells_what_it_is_over(page, served):
    page.do("ask", {"line": "red"})
    first, second = page.state["objects"]
    assert (first["name"], first["count"], second["name"]) == ("red 1", BLOCK, "red 2")
    assert first["box"]["min"] == pytest.approx([0, 0, 0]) and first["box"]["max"] == pytest.approx([3, 3, 3])
    over = page.do("hover", ray(served, 0), until="hover")
    assert over["label"] == "red" and over["object"]["name"] == "red 1" and over["distance"] == pytest.approx(2.0)
    assert over["relevancy"] == pytest.approx(1.0) and over["selected"]
    nothing = page.do("hover", {"origin": [0, 0, 50], "direction": [0, 0, 1]}, until="hover")
    assert nothing["label"] is None and nothing["position"] is None
    camera = page.do("go_to", {"id": second["id"]}, until="camera")
    assert camera["look_at"] == pytest.approx([201.5, 1.5, 1.5])
    assert np.linalg.norm(np.subtract(camera["position"], camera["look_at"])) < 50
    page.do("hide", [first["id"]])
    assert page.state["hidden"] == BLOCK and [one["name"] for one in page.state["objects"]] == ["red 1"]
    page.do("object", {"id": first["id"], "mode": "remove"})  # listed before
    assert page.state["selected"] == BLOCK
    assert "no longer listed" in page.refused("isolate", [10**6])
    page.do("show_all")
    page.do("isolate", [second["id"]])
    assert page.state["hidden"] == 3 * BLOCK


def test_floaters_growth_reliability_and_reasons(page, served):
    vars(served)["floaters"] = rows(0, 3)
    page.do("floaters")
    assert page.state["selected"] == 2 * BLOCK
    page.do("undo")
    page.do("ask", {"line": "blue"})
    page.do("reliability", 1.0)
    assert page.state["selected"] == 0
    page.do("reliability", 0.0)
    page.do("grow", -10)
    assert 0 < page.state["selected"] < BLOCK
    page.do("grow", 0)
    served.run.votes = FakeVotes()
    why = page.do("explain", until="explanation")
    assert "images" in why["text"] and why["support"][0]["url"].startswith("data:image/jpeg;base64,")
    served.run.votes = FakeVotes(FileNotFoundError("/data/me/b.png is missing"))
    served.run.scene.train.names[0] = FakeVotes.names[0]
    why = page.do("explain", until="explanation")
    assert "b.png" in why["problem"] and "/data" not in why["problem"] and why["name"] == "blue"
    assert why["support"][0]["url"].startswith("data:image/jpeg;base64,")  # the image without outlines
    assert not {vote["name"] for vote in why["support"]} & {vote["name"] for vote in why["disagreement"]}


def test_downloads_and_stills(page, client, served):
    assert "export" in page.refused("export", {"format": "ply"})
    page.do("ask", {"line": "blue"})
    file = page.do("export", {"format": "ply"}, until="download")
    content = client.get(file["url"])
    assert file["name"] == "blue.ply" and b"vertex 64\n" in content.content
    assert content.headers["content-disposition"] == 'attachment; filename="blue.ply"'
    assert client.get(file["url"] + "x").status_code == 404
    assert "exporter" in page.refused("export", {"format": "exe"})
    page.send("camera", {"position": [101.5, 1.5, 20], "look_at": [101.5, 1.5, 0], "up": [0, 1, 0], "fov": 0.5,
                         "width": 80, "height": 60})  # fmt: skip
    picture = page.do("still", {"max_size": 40, "background": [0, 0, 0]}, until="still")
    assert picture["payload"][:2] == b"\xff\xd8" and picture["revision"] == page.state["revision"]


def test_every_page_has_its_own_question_and_gets_it_back(client, served, monkeypatch):
    with opened(client) as one, opened(client, "two") as two:
        one.do("ask", {"line": "red"})
        two.do("ask", {"line": "blue"})
        one.do("hide")
        assert (one.state["hidden"], two.state["hidden"], two.state["selected"]) == (2 * BLOCK, 0, BLOCK)
        view = {"position": [1, 2, 3], "look_at": [0, 0, 0], "up": [0, 0, 1], "fov": 1.0}
        one.send("camera", view)
        one.do("undo")
        one.do("redo")
        with opened(client) as copy:  # the tab was duplicated
            token = copy.told[0]["token"]
            assert token not in ("", "one") and copy.state["hidden"] == 2 * BLOCK and copy.state["line"] == "red"
            copy.do("ask", {"line": "blue"})
            one.do("show_all")
            assert (one.state["selected"], copy.state["selected"]) == (2 * BLOCK, BLOCK)
    with opened(client) as back:
        camera = next(message for message in back.told if message["type"] == "camera")
        assert camera["position"] == [1, 2, 3] and back.state["line"] == "red" and back.told[0]["token"] == "one"
        assert len(back.state["history"]) == 4
    monkeypatch.setattr(runs, "MAX_MEMORIES", 1)
    with opened(client, "another"):
        assert len(served._memories) == 2


def test_a_link_carries_question_and_camera(client, served):
    with opened(client) as page:
        page.do("ask", {"line": "red, blue"})
        page.do("threshold", 0.25)
        page.send("camera", {"position": [1, 2, 3], "look_at": [0, 0, 0], "up": [0, 0, 1], "fov": 1.0})
        text = page.do("link", until="token")["link"]
    link = read_link(text)
    assert link is not None and (link.prompts, link.threshold) == ("red, blue", 0.25)
    with opened(client, "two", link="?" + text) as other:
        while other.state["prompts"] == []:
            other.receive()
        assert other.state["threshold"] == 0.25 and other.state["selected"] == 3 * BLOCK
        assert next(one for one in other.told if one["type"] == "camera")["position"] == [1, 2, 3]
    with opened(client, "three", link=text[:-7]) as broken:
        assert any("again" in one.get("text", "") for one in broken.told if one["type"] == "message")


def test_saved_prompts(client, served, tmp_path):
    with opened(client) as page:
        assert "save" in page.refused("save_prompts", {"replace": True})
        page.do("ask", {"line": "red"})
        page.do("save_prompts", {"replace": True}, until="message")
    stored = load_query(tmp_path / FIELD_FOLDER)
    assert stored is not None and stored.texts == ("red",)
    with opened(client, "two") as page:
        assert page.state["line"] == "red"
        assert any("Ask" in one.get("text", "") for one in page.told if "text" in one)
    for options, access, allowed in (
        ({"read_only": True}, "", False),
        ({"host": "0.0.0.0", "access_token": "secret"}, "", False),
        ({"host": "0.0.0.0", "access_token": "secret"}, "secret", True),
    ):
        with client_of(make_server(served, **options)) as other, opened(other, "three", access=access) as page:
            assert next(one for one in page.told if one["type"] == "token")["read_only"] != allowed
            page.do("ask", {"line": "blue"})
            answer = page.do("save_prompts", {"replace": True}, until="message")
            assert (answer["kind"] == "done") == allowed
    stored = load_query(tmp_path / FIELD_FOLDER)
    assert stored is not None and stored.texts == ("blue",)


def test_a_late_answer_is_dropped_and_errors_name_no_path(page, served):
    reading, go = threading.Event(), threading.Event()

    def slow(texts):
        reading.set()
        assert go.wait(60)
        return read(texts)

    page.do("ask", {"line": "red"})
    served.run.texts = SimpleNamespace(rows=slow)
    page.send("ask", {"line": "blue"})
    assert reading.wait(60)
    page.do("cancel", until="busy")
    go.set()
    page.do("invert")
    assert [row["text"] for row in page.state["prompts"]] == ["red"]
    gone = FileNotFoundError("/home/me/models/weights.bin is gone")
    served.run.texts = Mock(rows=Mock(side_effect=gone))
    text = page.refused("ask", {"line": "green"})
    assert "weights.bin is gone" in text and "/home" not in text


@pytest.mark.parametrize(
    ("action", "value"),
    [("threshold", "x"), ("threshold", None), ("grow", 10**9), ("pick", {"origin": [0, 0], "direction": [0, 0, 1]}),
     ("pick", {"origin": [0, 0, 0], "direction": [0, 0, 0]}), ("nonsense", 1), ("color_mode", "blue"),
     ("ask", {"line": "x" * 5000}), ("ask", {"line": ""}), ("region", {"polygon": [], "camera": from_above(0)}),
     ("region", {"polygon": [[0, 0]], "camera": {**from_above(0), "K": [[0, 0, 0]] * 3}}), ("go_to", {}),
     ("layer_add", {"name": ""}), ("hide", [-1]), ("still", {"max_size": 10**6}), ("object", {"id": 5})],
)  # fmt: skip
def test_invalid_values_are_refused_and_the_page_goes_on(page, action, value):
    assert len(page.refused(action, value)) > 10
    page.do("ask", {"line": "red"})
    assert page.state["selected"] == 2 * BLOCK


def test_pages_that_do_not_greet_and_unknown_runs_are_closed(client):
    for run, first in (("cubes", '{"action": "undo"}'), ("cubes", "{"), ("nothing", '{"action": "greet"}')):
        with client.websocket_connect(f"ws://localhost:7008/api/runs/{run}/session") as socket:
            socket.send_text(first)
            with pytest.raises(WebSocketDisconnect) as closed:
                socket.receive_text()
            assert closed.value.code == 1008, (run, first)
    assert torch.is_grad_enabled()
