"""Drawings of a panel say what the numbers say, and hold no markup of strangers."""

import base64
import io
import re
from xml.etree import ElementTree

import numpy as np
import pytest
import torch
from PIL import Image

from normlift_ns.query.engine import relevancy_histogram
from normlift_ns.session import actions
from normlift_ns.session.prompts import Prompt, build_query
from normlift_ns.session.state import State
from normlift_ns.viewer.widgets import diagnostics_mdx, histogram_svg, image_mdx
from tests.session.worlds import read, world

SVG = "{http://www.w3.org/2000/svg}"


def drawn(threshold: float = 0.5) -> tuple[ElementTree.Element, np.ndarray]:
    values = np.concatenate([np.full(900, 0.1), np.full(90, 0.3), np.full(10, 0.9)])
    found = relevancy_histogram(values, np.ones(1000, bool), threshold, (0.4, 0.8))
    assert found is not None
    return ElementTree.fromstring(histogram_svg(found, (1.0, 0.5, 0.0))), found.counts


def test_bars_are_as_high_as_the_logarithm_and_coloured_above_the_threshold():
    picture, counts = drawn()
    bars = picture.findall(f"{SVG}rect")[1:]
    assert len(bars) == int((counts > 0).sum()) == 3
    heights = np.array([float(bar.get("height", "")) for bar in bars])
    expected = np.log1p([900, 90, 10])
    assert heights / heights[0] == pytest.approx(expected / expected[0], abs=0.01)
    assert [bar.get("fill") for bar in bars] == ["#8c8c8c", "#8c8c8c", "#ff8000"]


def test_the_line_is_at_the_threshold():
    for threshold in (-0.2, 0.1, 0.5, 1.0):
        picture, _ = drawn(threshold)
        low, high = min(0.1, threshold), max(0.9, threshold)
        *_, line = picture.findall(f"{SVG}path")
        assert line.get("stroke-dasharray") is None
        x = float(re.findall(r"M([\d.]+)", line.get("d", ""))[0])
        assert x == pytest.approx(min(max((threshold - low) / (high - low) * 280, 1), 279), abs=0.06)
        texts = [text.text for text in picture.findall(f"{SVG}text")]
        assert texts == [f"> {threshold:.2f}", f"{low:.2f}", f"{high:.2f}"]
    found = relevancy_histogram(np.full(5, 0.25), np.ones(5, bool), 0.25, (0.4, 0.8))
    assert found is not None
    assert len(ElementTree.fromstring(histogram_svg(found, (0, 0, 1))).findall(f"{SVG}rect")) == 2


def test_a_photograph_is_made_small_enough_for_a_panel():
    image = torch.zeros(900, 1200, 3, dtype=torch.uint8)
    image[:, 600:] = torch.tensor([255, 176, 0], dtype=torch.uint8)
    data = re.findall(r"data:image/jpeg;base64,([^\"]+)", image_mdx(image))
    found = Image.open(io.BytesIO(base64.b64decode(data[0])))
    assert found.size == (480, 360)
    assert np.abs(np.asarray(found)[180, 400].astype(int) - (255, 176, 0)).max() < 12
    small = image_mdx(torch.zeros(30, 40, 3, dtype=torch.uint8))
    assert Image.open(io.BytesIO(base64.b64decode(re.findall('base64,([^"]+)', small)[0]))).size == (40, 30)


def test_names_of_prompts_stay_text():
    space = world()
    hostile = "<img src=x onerror=alert(1)> {alert(1)} ![](http://a)"
    prompts = [Prompt(hostile, read(["red"])[0]), *(Prompt(str(i), read(["blue"])[0]) for i in range(4))]
    state = actions.ask(State(space), *build_query(space.field, prompts, read, negatives=(), threshold=0.5))
    text = diagnostics_mdx(state)
    rest = re.sub(
        r'<img src="data:image/svg\+xml;base64,[\w+/=]+" style=\{\{[^}]*\}\} />|<span [^>]*>■</span>', "", text
    )
    assert not set(re.sub(r"&#\d+;", "", rest)) & set("{}<>`![]()")
    assert text.count("<img") == 3
    assert "2 more" in rest
    assert diagnostics_mdx(actions.show_prompt(state, 4)).count("<img") == 1
    assert diagnostics_mdx(State(space)) == ""
