"""What panels show: why something is selected, and drawings that say what the numbers say, without strange markup."""

import base64
import html
import io
import re
import time
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
import torch
from PIL import Image

from normlift_ns import Evidence
from normlift_ns.analysis.explain import VoteImage, explain_selection
from normlift_ns.core.evidence import Entries
from normlift_ns.errors import InputError
from normlift_ns.query.threshold import relevancy_histogram
from normlift_ns.session import actions
from normlift_ns.session.prompts import Prompt, build_query
from normlift_ns.session.state import State
from normlift_ns.viewer import adapter
from normlift_ns.viewer.widgets import Explanation, diagnostics_mdx, explanation_mdx, histogram_svg, image_mdx
from tests.session.worlds import BLOCK, read, rows, world

NAMES = ("a/[x](y).png", "b.png", "c.png", "d.png", "e.png")


class FakeVotes:
    """Five photographs: the first cube is red in four of them and blue in the last, the second blue in all."""

    names = NAMES

    def __init__(self, problem: Exception | None = None) -> None:
        self.problem = problem
        entries = []
        for view in range(5):
            column = torch.where(torch.arange(2 * BLOCK) < BLOCK, 1 + (view == 4), 2)
            weight = torch.full((2 * BLOCK,), 5.0 - view)
            entries.append(Entries(torch.arange(2 * BLOCK), column, weight, (2,)))
        self.evidence = Evidence.from_entries(entries, 4 * BLOCK)

    def explain(self, selected: torch.Tensor, *, refined: bool = True) -> Any:
        return explain_selection(self.evidence, torch.eye(2).repeat(5, 1), selected)

    def pictures(self, votes: Any) -> Any:
        for vote in votes:
            if self.problem is not None:
                raise self.problem
            yield VoteImage(NAMES[vote.view], vote, torch.full((12, 16, 3), 40 * vote.view, dtype=torch.uint8))


def test_three_that_weigh_most_and_those_that_disagree():
    lines = explanation_mdx(FakeVotes(), rows(0))
    named = [line for line in lines.splitlines() if line.startswith("a&#47;")]
    assert len(named) == 1
    assert not any(set("[]()/") & set(line) for line in named)
    most, different = html.unescape(lines).split("Images that disagree:")
    assert "Strongest support:" in most and "C_inter" in most
    assert "a/[x](y).png: 33% of the weight (320 pixels, 1 region), cosine 1.00" in most
    assert [name in most for name in NAMES] == [True, True, True, False, False]
    assert "e.png: 7% of the weight" in different and "of the disagreement" in different
    alike = explanation_mdx(FakeVotes(), rows(1))
    assert "Images that disagree" not in alike
    assert [text.count("data:image/jpeg") for text in (lines, alike)] == [4, 3]  # e.png too, and each once
    for problem in (InputError("they were given from Python"), FileNotFoundError("b.png is missing")):
        text = html.unescape(explanation_mdx(FakeVotes(problem), rows(0)))
        assert f": {problem}" in text and "33% of the weight" in text and "data:image" not in text


def test_reasons_belong_to_their_selection():
    reasons = Explanation(FakeVotes)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="nothing is selected"):
        reasons.compute(reasons.start(State(world())), State(world()))
    assert (reasons.content, reasons.busy) == ("", "")
    state = actions.select(State(world()), rows(0))
    reasons.compute(reasons.start(state), state)
    assert "Strongest support" in reasons.content
    reasons.update(actions.hide(state))  # the selection is the same
    assert reasons.content != ""
    reasons.update(actions.select(state, rows(1)))
    assert reasons.content == ""


@pytest.mark.parametrize("fails", [False, True])
def test_a_late_answer_is_dropped_and_so_is_its_error(fails):
    state = actions.select(State(world()), rows(0))

    class Slow(FakeVotes):
        def explain(self, selected: torch.Tensor, *, refined: bool = True) -> Any:
            assert reasons.busy
            reasons.update(actions.select(state, rows(1)))  # meanwhile
            if fails:
                raise InputError("too late to be told")
            return super().explain(selected, refined=refined)

    reasons = Explanation(Slow)  # type: ignore[arg-type]
    reasons.compute(reasons.start(state), state)
    assert (reasons.content, reasons.busy) == ("", "")


SVG = "{http://www.w3.org/2000/svg}"


def test_bars_are_as_high_as_the_logarithm_and_the_line_is_at_the_threshold():
    values = np.concatenate([np.full(900, 0.1), np.full(90, 0.3), np.full(10, 0.9)])
    for threshold in (-0.2, 0.1, 0.5, 1.0):
        found = relevancy_histogram(values, np.ones(1000, bool), threshold, (0.4, 0.8))
        assert found is not None
        picture = ElementTree.fromstring(histogram_svg(found, (1.0, 0.5, 0.0)))
        bars = picture.findall(f"{SVG}rect")[1:]
        assert len(bars) == int((found.counts > 0).sum()) == 3
        heights = np.array([float(bar.get("height", "")) for bar in bars])
        assert heights / heights[0] == pytest.approx(np.log1p([900, 90, 10]) / np.log1p(900), abs=0.01)
        if threshold == 0.5:
            assert [bar.get("fill") for bar in bars] == ["#8c8c8c", "#8c8c8c", "#ff8000"]
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
    ours = r'<img src="data:image/svg\+xml;base64,[\w+/=]+" style=\{\{[^}]*\}\} />|<span [^>]*>■</span>'
    rest = re.sub(ours, "", text)
    assert not set(re.sub(r"&#\d+;", "", rest)) & set("{}<>`![]()")
    assert text.count("<img") == 3
    assert "2 more" in rest
    assert diagnostics_mdx(actions.show_prompt(state, 4)).count("<img") == 1
    assert diagnostics_mdx(State(space)) == ""


def test_messages_are_handled_one_after_the_other(monkeypatch):
    monkeypatch.setattr(adapter, "_MAX_HOLDUP", 60.0)
    executor, handled = ThreadPoolExecutor(4), []
    adapter.handle_in_order(SimpleNamespace(_websock_server=SimpleNamespace(_thread_executor=executor)))

    def handle(number):
        time.sleep(0.05 if number == 0 else 0)
        handled.append(number)

    for future in [executor.submit(handle, number) for number in range(4)]:
        future.result(timeout=20)
    assert handled == [0, 1, 2, 3]
