import html
import re
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from normlift_ns.errors import escape_unprintable
from normlift_ns.query.engine import Answer
from normlift_ns.query.question import Query
from normlift_ns.rendering.colors import clip_text, colormap_rgb, prompt_colors
from normlift_ns.rendering.figures import (
    Display,
    color_scale,
    make_display,
    overlay,
    reliability_map,
    render_outputs,
    segmentation,
)
from normlift_ns.viewer.widgets import escape_mdx


def pictured() -> tuple[torch.Tensor, torch.Tensor]:
    rgb = torch.rand(4, 5, 3, generator=torch.Generator().manual_seed(0))
    return rgb, rgb.mean(dim=2, keepdim=True).expand_as(rgb)


def test_the_overlay_colours_the_selection_by_a_fixed_scale() -> None:
    rgb, grey = pictured()
    colors = colormap_rgb("viridis")
    relevancy, share = torch.zeros(4, 5), torch.zeros(4, 5, 1)
    relevancy[0] = torch.tensor([-1.0, 0.5, 0.75, 1.0, 7.0])
    share[0] = 1
    share[1, 0], relevancy[1, 0] = 0.5, 1.0
    display = Display(torch.zeros(0, 5), (0.5, 1.0), (0.0, 1.0), "viridis", (), torch.zeros(0, 3))
    found = overlay(display, rgb, relevancy, share)
    for x, (row, opacity) in enumerate(((0, 0.35), (0, 0.35), (128, 0.625), (255, 0.9), (255, 0.9))):
        torch.testing.assert_close(found[0, x], (1 - opacity) * grey[0, x] + opacity * colors[row])
    torch.testing.assert_close(found[1, 0], 0.55 * grey[1, 0] + 0.45 * colors[255])
    torch.testing.assert_close(found[2:], grey[2:])


def test_nothing_found_is_not_stretched_to_a_find() -> None:
    assert color_scale(torch.tensor([0.1, 0.2]), 0.5) == (0.5, 0.55)
    assert color_scale(torch.tensor([]), 0.5) == (0.5, 0.55)
    assert color_scale(torch.tensor([0.1, 0.9]), 0.5) == (0.5, float(torch.tensor(0.9)))


def test_segmentation_and_reliability_have_colours_of_their_own() -> None:
    rgb, grey = pictured()
    colors = prompt_colors(["a", "b", "c"])
    labels = torch.arange(20).reshape(4, 5) % 3
    found = segmentation(rgb, labels, torch.ones(4, 5, 1), colors)
    torch.testing.assert_close(found, 0.2 * grey + 0.8 * colors[labels])
    torch.testing.assert_close(segmentation(rgb, labels, torch.zeros(4, 5, 1), colors), grey)
    colors, alpha = colormap_rgb("cividis"), torch.full((4, 5), 0.5)
    reliability = torch.full((4, 5, 1), 0.25)  # composited: R is 0.5
    found = reliability_map(rgb, reliability, alpha)
    torch.testing.assert_close(found, 0.55 * grey + 0.45 * colors[128].expand(4, 5, 3))
    assert torch.equal(reliability_map(rgb, 0 * reliability, 0 * alpha), grey)


def shown(texts: tuple[str, ...], relevancy: torch.Tensor) -> Answer:
    field: Any = SimpleNamespace(
        scalars=SimpleNamespace(reliability=torch.tensor([0.9, 0.5, 0.2]), n_eff=torch.ones(3), weight=torch.ones(3))
    )
    question = Query(texts, torch.eye(len(texts), 2))
    return Answer(question, field, torch.zeros(3, 3), relevancy, torch.ones(3).bool(), relevancy > 0.5, (1.0, 1.0))


def test_a_viewer_names_pictures_by_text_and_a_command_scalars_by_number() -> None:
    answer = shown(("sky blue", "sky-blue"), torch.tensor([[0.9, 0.1], [0.8, 0.7], [0.2, 0.6]]))
    display = make_display(answer.field, answer)
    image, alpha = torch.rand(200, 300, 7, generator=torch.Generator().manual_seed(1)), torch.ones(200, 300)
    rgb = torch.full((200, 300, 3), 0.5)
    told, seen = (render_outputs(display, rgb, image, alpha, named_by_text=named) for named in (False, True))
    assert list(told)[:2] == ["relevancy_0", "relevancy_1"]
    assert list(seen)[:2] == ["relevancy_sky_blue", "relevancy_sky_blue_2"]
    others = ["reliability", "reliability_value", "n_eff", "selection", "segmentation", "overlay"]
    assert list(told)[2:] == list(seen)[2:] == others
    assert torch.equal(told["relevancy_1"], image[:, :, 1:2])
    for name in ("relevancy_sky_blue", "reliability", "segmentation", "overlay"):
        assert seen[name].shape == (200, 300, 3)
        assert 0 <= float(seen[name].min()) <= float(seen[name].max()) <= 1
        white = (seen[name] > 0.8).all(dim=2)  # letters
        assert int(white[100:, 150:].sum()) >= 20
        assert int(white[:100].sum()) == 0
    small = render_outputs(display, rgb[:100], image[:100], alpha[:100])
    assert not bool((small["overlay"] > 0.8).all(dim=2).any())  # no room for a legend


def test_the_scale_is_that_of_all_prompts_and_views() -> None:
    low = shown(("a", "b"), torch.rand(3, 2) * 0.3)
    assert make_display(low.field, low).map_scale == (0.0, pytest.approx(0.55))
    answer = shown(("a", "b"), torch.tensor([[0.9, 0.1], [0.8, 0.7], [0.2, 0.6]]))
    for one in (None, 0, 1):
        assert make_display(answer.field, answer, shown=one).map_scale == (0.0, pytest.approx(0.9))
    assert make_display(answer.field, answer, shown=1).scale == (0.5, pytest.approx(0.7))
    assert (make_display(answer.field, answer, shown=1).title, make_display(answer.field, answer).title) == (
        "relevancy: b", "relevancy, all prompts",
    )  # fmt: skip


def test_markup_is_text_and_choices_of_a_dropdown_can_be_sent_and_shown() -> None:
    assert escape_mdx("1 < 2 {}\n") == "1 &#60; 2 &#123;&#125;&#10;"
    assert clip_text("a\n  b", 9) == "a b"
    for text in (
        "<script>x</script>", "{1+1}", "| a | b |", "**b**", "a\n# b", "`x`", "\x1b[31m", "\u202ex", "\udc80", "\0",
        "&lt;",
    ):  # fmt: skip
        shown = escape_mdx(text)
        assert re.fullmatch(r"(?:\w| |&#\d+;)*", shown), text
        assert html.unescape(shown) == escape_unprintable(text, keep="\n")
        assert clip_text(text, 40).isprintable(), text
        clip_text(text, 40).encode("utf8")
