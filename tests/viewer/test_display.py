from __future__ import annotations

import torch

from normlift_ns.asking import Answer
from normlift_ns.question import Question
from normlift_ns.viewer.display import color_scale, colors_of, overlay, palette, segmentation
from normlift_ns.viewer.status import as_text, clipped, report

RGB = torch.rand(4, 5, 3, generator=torch.Generator().manual_seed(0))
GREY = RGB.mean(dim=2, keepdim=True).expand_as(RGB)


def test_the_overlay_colours_the_selection_by_a_fixed_scale() -> None:
    colors = colors_of("viridis")
    relevancy, share = torch.zeros(4, 5), torch.zeros(4, 5, 1)
    relevancy[0] = torch.tensor([-1.0, 0.5, 0.75, 1.0, 7.0])
    share[0] = 1
    share[1, 0], relevancy[1, 0] = 0.5, 1.0
    found = overlay(RGB, relevancy, share, colors, (0.5, 1.0))
    for x, row in enumerate((0, 0, 128, 255, 255)):
        torch.testing.assert_close(found[0, x], 0.2 * GREY[0, x] + 0.8 * colors[row])
    torch.testing.assert_close(found[1, 0], 0.6 * GREY[1, 0] + 0.4 * colors[255])
    torch.testing.assert_close(found[2:], GREY[2:])


def test_colours_are_those_of_matplotlib() -> None:
    torch.testing.assert_close(
        colors_of("viridis")[[0, 255]], torch.tensor([[0.267, 0.005, 0.329], [0.993, 0.906, 0.144]]), atol=1e-3, rtol=0
    )


def test_nothing_found_is_not_stretched_to_a_find() -> None:
    assert color_scale(torch.tensor([0.1, 0.2]), 0.5) == (0.5, 0.55)
    assert color_scale(torch.tensor([]), 0.5) == (0.5, 0.55)
    assert color_scale(torch.tensor([0.1, 0.9]), 0.5) == (0.5, float(torch.tensor(0.9)))


def test_the_segmentation_has_the_colour_of_the_label() -> None:
    colors = palette(3)
    labels = torch.arange(20).reshape(4, 5) % 3
    found = segmentation(RGB, labels, torch.ones(4, 5, 1), colors)
    torch.testing.assert_close(found, 0.2 * GREY + 0.8 * colors[labels])
    torch.testing.assert_close(segmentation(RGB, labels, torch.zeros(4, 5, 1), colors), GREY)


def test_colours_of_prompts_differ() -> None:
    colors = palette(50)
    assert colors.shape == (50, 3)
    assert float(colors.min()) >= 0
    assert float(colors.max()) <= 1
    apart = torch.cdist(colors, colors) + torch.eye(50) * 9
    assert float(apart[:10, :10].min()) > 0.2
    assert float(apart.min()) > 0.03
    assert palette(0).shape == (0, 3)


def test_the_report_counts_and_escapes() -> None:
    relevancy = torch.tensor([[0.9, 0.1], [0.8, 0.7], [0.2, 0.6]])
    question, unused = Question(("a|b", "x" * 90), torch.eye(2)), None
    answer = Answer(question, unused, torch.zeros(3, 3), relevancy, torch.ones(3).bool(), relevancy > 0.5)
    lines = report(answer, None).splitlines()
    assert lines[0] == "**3** of 3 Gaussians selected"
    assert "a&#124;b | 2 | 0.90 |" in lines[-2]
    assert f"{'x' * 39}&#8230; | 2 | 0.70 |" in lines[-1]
    assert report(answer, 1).startswith("**2** of 3")
    assert report(None, None) == "No query yet."
    assert as_text("1 < 2 {}\n") == "1 &#60; 2 &#123;&#125;&#10;"
    assert clipped("a\n  b", 9) == "a b"
