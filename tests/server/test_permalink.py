"""Links hold question and camera, and nothing else is read as one."""

import base64

import pytest
from hypothesis import given
from hypothesis import strategies as st

from normlift_ns.errors import InputError
from normlift_ns.server.permalink import Greeting, Link, PageView, read_link, write_link
from normlift_ns.server.protocol import decode
from tests.hostile import survives

PLACE = st.tuples(*[st.floats(-1e9, 1e9)] * 3)


@given(
    st.text(st.characters(exclude_categories=["Cs"])),
    st.dictionaries(st.text(st.characters(exclude_categories=["Cs"]), max_size=5), st.integers(0, 2**40), max_size=3),
    st.none() | st.floats(-1, 1),
    st.none() | st.builds(PageView, PLACE, PLACE, PLACE, st.floats(0.1, 3)),
)
def test_a_link_is_read_as_it_was_written(prompts, clicks, threshold, view):
    link = Link(prompts, clicks, threshold, 0.5, "prompts", view)
    text = write_link(link)
    for query in (text, f"?{text}", f"?access=a&{text}"):
        assert read_link(query) == link
    assert all(letter.isalnum() or letter in "=-_" for letter in text)


@given(st.text())
def test_other_queries_are_none_or_an_error(text):
    for query in (text, f"q={text}"):
        survives(lambda query=query: read_link(query))


def test_damaged_links_and_other_greetings_are_refused():
    for text in ("", "{}", "[]", '{"token": ""}', '{"token": 1}', '{"token": "' + "x" * 101 + '"}', "[" * 100_000,
                 '{"token": null}', '{"token": "a", "access": 1}'):  # fmt: skip
        with pytest.raises(InputError, match="not valid"):
            decode(text, Greeting)
    for link in (
        '{"view": {"fov": 1e999}}', '{"clicks": {"a": -1}}', '{"threshold": NaN}', "[", '{"min_reliability": 1.1}',
        '{"min_reliability": -0.1}',
    ):  # fmt: skip
        with pytest.raises(InputError, match="cannot be read"):
            read_link("q=" + base64.urlsafe_b64encode(link.encode()).decode())
    with pytest.raises(InputError, match=r"\d,\d{3} characters"):
        write_link(Link("x" * 6000))


def test_a_camera_that_looks_nowhere_is_known_and_others_project_what_they_see():
    for look_at, up, valid in (
        ((0, 1, 0), (0, 0, 1), True), ((1e-9, 0, 0), (0, 0, 1), True), ((0, 0, 0), (0, 0, 1), False),
        ((0, 1, 0), (0, 0, 0), False), ((0, 0, 2), (0, 0, 1), False), ((1e30, 1e30, 0), (0, 0, 1e30), True),
    ):  # fmt: skip
        assert PageView((0, 0, 0), look_at, up, 1.0).is_valid is valid, (look_at, up)
    camera = PageView((1, 2, 3), (1, 5, 3), (0, 0, 1), 1.0, 800, 400).camera(200)
    assert (camera.width, camera.height) == (200, 100)
    seen = camera.world_to_camera.double().numpy() @ [1.0, 5.0, 4.0, 1.0]  # one unit above the target
    assert seen[:3] == pytest.approx([0, -1, 3])
