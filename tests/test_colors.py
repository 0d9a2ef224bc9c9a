from __future__ import annotations

import colorsys

import pytest
import torch

from normlift_ns.rendering.colors import COLORMAPS, apply_colormap, colormap_rgb, named_color, prompt_colors

DEUTERANOPE = torch.tensor([[0.367, 0.861, -0.228], [0.280, 0.673, 0.047], [-0.012, 0.043, 0.969]])
"""Linear RGB as people without green cones see it (Machado, Oliveira and Fernandes, 2009)."""


def lightness(colors: torch.Tensor) -> torch.Tensor:
    """CIE L* of sRGB."""
    linear = torch.where(colors <= 0.04045, colors / 12.92, ((colors + 0.055) / 1.055) ** 2.4)
    y = linear @ torch.tensor([0.2126, 0.7152, 0.0722], dtype=linear.dtype)
    return torch.where(y > 0.008856, 116 * y ** (1 / 3) - 16, 903.3 * y)


def test_colours_are_those_of_matplotlib() -> None:
    ends = torch.tensor([[0.267, 0.005, 0.329], [0.993, 0.906, 0.144]])
    torch.testing.assert_close(colormap_rgb("viridis")[[0, 255]], ends, atol=1e-3, rtol=0)


def test_the_default_maps_become_lighter_evenly_for_every_eye() -> None:
    for name in ("viridis", "cividis"):
        for eye in (torch.eye(3), DEUTERANOPE):
            steps = lightness((colormap_rgb(name).double() @ eye.double().T).clamp(0, 1)).diff()
            assert float(steps.min()) > 0
            assert float(steps.std() / steps.mean()) < 0.35
    assert COLORMAPS[0] == "viridis"
    assert float(lightness(colormap_rgb("turbo").double()).diff().min()) < 0  # the measure finds what is uneven


def test_opacity_grows_with_relevancy() -> None:
    opacity = apply_colormap(torch.linspace(-1, 2, 301), (0.0, 1.0), colormap_rgb("viridis"))[1]
    assert float(opacity.diff().min()) >= 0
    assert (float(opacity[0]), float(opacity[-1])) == pytest.approx((0.35, 0.9))
    assert float(apply_colormap(torch.zeros(1), (0.0, 1.0), colormap_rgb("viridis"), min_opacity=0.0)[1]) == 0


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
    mixed = prompt_colors(["red", "fox", "red shoes", "yellow", "lamp"])
    assert float((torch.cdist(mixed, mixed) + torch.eye(5) * 9).min()) > 0.24
