import colorsys

import pytest
import torch

from normlift_ns.rendering.colors import COLORMAPS, colormap_rgb, named_color, prompt_colors


def test_colours_are_those_of_matplotlib() -> None:
    ends = torch.tensor([[0.267, 0.005, 0.329], [0.993, 0.906, 0.144]])
    torch.testing.assert_close(colormap_rgb(COLORMAPS[0])[[0, 255]], ends, atol=1e-3, rtol=0)  # viridis


def test_a_prompt_has_the_color_that_it_names_or_some_other() -> None:
    hues = {"sky blue": 0.58, "yellow": 0.165, "a red mug": 0.0, "dark green bush": 0.33, "Orange": 0.08}
    for text, hue in hues.items():
        color = named_color(text)
        assert color is not None
        assert colorsys.rgb_to_hsv(*color)[0] == pytest.approx(hue, abs=0.03)
        assert prompt_colors(["fox", text])[1].tolist() == pytest.approx(color)
    for text in ("", "fox", "white", "a grey stone floor", "\ud800", "xkcd:", "blue/", "x" * 10_000):
        colors = prompt_colors([text, text])
        assert colors.shape == (2, 3)
        assert 0 <= float(colors.min()) <= float(colors.max()) <= 1


def test_colours_of_prompts_differ() -> None:
    colors = prompt_colors([f"thing {i}" for i in range(64)])
    apart = torch.cdist(colors, colors) + torch.eye(64) * 9
    assert float(apart[:20, :20].min()) > 0.24
    assert float(apart.min()) > 0.05
    assert prompt_colors([]).shape == (0, 3)
    assert (prompt_colors(["fox"]) * 255).round().tolist() == [[230, 159, 0]]  # the first of Okabe and Ito
    mixed = prompt_colors(["red", "fox", "red shoes", "yellow", "lamp"])
    assert float((torch.cdist(mixed, mixed) + torch.eye(5) * 9).min()) > 0.24
