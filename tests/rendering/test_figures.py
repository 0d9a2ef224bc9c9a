"""Pictures: their names, what their pixels mean, and texts that are drawn as they are."""

import html
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from normlift_ns.errors import InputError, escape_unprintable
from normlift_ns.query.engine import Answer
from normlift_ns.query.question import Query
from normlift_ns.rendering import figures
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
from tests.test_pipeline import HEIGHT, WIDTH, scene

SHEET = figures.FigureStyle("viridis", (0.0, 1.0), 0.5)


def test_pictures_that_would_replace_each_other_are_refused(tmp_path: Path) -> None:
    for names, texts, twice in (
        (("a.png", "a_0_x.png"), ("x 1 y", "y"), "a_0_x_1_y"),
        (("contact_sheet.png", "b.png"), ("x",), "contact_sheet_0_x"),
    ):
        made, answer = scene(*names), SimpleNamespace(texts=texts)
        with pytest.raises(InputError, match=rf"{twice}\.png"):
            figures.save_overlays(made, answer, figures.training_cameras(made), tmp_path)  # type: ignore[arg-type]
    assert list(tmp_path.iterdir()) == []


def test_a_text_is_drawn_as_it_is() -> None:
    sizes = ((HEIGHT, WIDTH), (1, 300), (300, 1))
    for i, text in enumerate((r"$\frac{$", "$", "a\nb", "[/red]", "\ud800", "x\0y", "", "x" * 3000, "מים")):
        size = sizes[i % 3]
        image, selected = torch.zeros(*size, 3, dtype=torch.uint8), torch.zeros(size, dtype=torch.bool)
        found = figures.FigureHeader(text, "x" * 300)
        assert figures.view_figure(SHEET, found, text, image, image, selected).size[0] > 500, text
        panel = Image.new("RGB", (size[1], size[0]))
        assert figures.contact_sheet(SHEET, found, [panel] * 5, [text] * 5).size[0] > 500, text


def test_the_outline_goes_around_what_is_selected_and_the_photograph_stands_beside_it() -> None:
    red, blue = torch.tensor([200, 10, 10], dtype=torch.uint8), torch.tensor([10, 90, 200], dtype=torch.uint8)
    photograph, overlay = red.expand(60, 80, 3).contiguous(), blue.expand(60, 80, 3).contiguous()
    selected = torch.zeros(60, 80, dtype=torch.bool)
    selected[20:40, 20:60] = True
    page = np.asarray(figures.view_figure(SHEET, figures.FigureHeader("x", "y"), "0001", photograph, overlay, selected))
    left, right = page[:, :656], page[:, 656:]
    assert (left == red.numpy()).all(axis=2).sum() == 640 * 480
    inside = (right == blue.numpy()).all(axis=2)
    rows, columns = np.nonzero(inside)
    found = inside[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
    assert found.shape == (480, 640)
    ends = np.array([(x.min(), x.max()) for x in np.nonzero(~found)])
    assert (abs(ends - [[160, 319], [160, 479]]) <= 4).all()
    assert found[240, 320] and 3 * 900 < (~found).sum() < 7 * 1100  # a closed line of 3 to 7 pixels
    nothing = torch.zeros_like(selected)
    none = np.asarray(figures.view_figure(SHEET, figures.FigureHeader("x", "y"), "0001", None, overlay, nothing))
    assert (none == blue.numpy()).all(axis=2).sum() == 640 * 480


def test_the_title_says_how_much_and_on_what_evidence() -> None:
    scalars = SimpleNamespace(weight=torch.ones(4), n_eff=torch.full((4,), 3.0), reliability=torch.full((4,), 0.5))
    answer = SimpleNamespace(field=SimpleNamespace(scalars=scalars), question=SimpleNamespace(threshold=0.5))
    finding: Any = SimpleNamespace(
        text="x", answer=answer, mask=torch.tensor([True, False, True, False]), fraction=0.5, mean_reliability=0.5,
        peak=0.9, verdict="found",
    )  # fmt: skip
    for facts in ("50.0 %", "R 0.50", "3.0 views", "100 %", "R < 0.6"):
        assert facts in figures.FigureHeader.of(finding).summary
    finding.mask = torch.zeros(4, dtype=torch.bool)
    assert re.fullmatch(r"[^\d]* 0\.5, [^\d]* 0\.90\)", figures.FigureHeader.of(finding).summary)  # threshold and peak
    for verdict in ("found", "probably not here", None):  # None: nobody can tell
        finding.verdict = verdict
        assert figures.FigureHeader.of(finding).title.split("   ·   ") == ["x", verdict][: 1 + (verdict is not None)]


def test_overlay_segmentation_and_reliability_have_colours_of_their_own() -> None:
    rgb, colors = torch.rand(4, 5, 3, generator=torch.Generator().manual_seed(0)), colormap_rgb("viridis")
    grey = rgb.mean(dim=2, keepdim=True).expand_as(rgb)
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

    colors, labels = prompt_colors(["a", "b", "c"]), torch.arange(20).reshape(4, 5) % 3
    found = segmentation(rgb, labels, torch.ones(4, 5, 1), colors)
    torch.testing.assert_close(found, 0.2 * grey + 0.8 * colors[labels])
    torch.testing.assert_close(segmentation(rgb, labels, torch.zeros(4, 5, 1), colors), grey)
    reliability, alpha = torch.full((4, 5, 1), 0.25), torch.full((4, 5), 0.5)  # composited: R is 0.5
    expected = 0.55 * grey + 0.45 * colormap_rgb("cividis")[128].expand(4, 5, 3)
    torch.testing.assert_close(reliability_map(rgb, reliability, alpha), expected)
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


def test_the_scale_is_that_of_all_prompts_and_views_and_not_stretched_to_a_find() -> None:
    assert color_scale(torch.tensor([]), 0.5) == color_scale(torch.tensor([0.1, 0.2]), 0.5) == (0.5, 0.55)
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
