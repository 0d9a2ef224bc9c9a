"""The colour encoder against its own formulas."""

import json
import math
from importlib import import_module
from importlib.resources import files

import numpy as np
import pytest
import torch

from normlift_ns.encoders.color import KERNEL_SIGMA, ColorEncoder, embed_colors, find_color_names, shading_coordinates
from tests.encoders.tiny import refused

COLOUR = ColorEncoder()


def lab(colours) -> np.ndarray:
    return import_module("skimage.color").rgb2lab(np.asarray(colours, dtype=np.float64))


def test_every_name_of_the_survey_is_understood():
    table = json.loads(files("normlift_ns.encoders").joinpath("xkcd.json").read_text())
    assert {f"xkcd:{name}": colour for name, colour in table.items()} == import_module("matplotlib.colors").XKCD_COLORS
    assert len(table) == 949
    for name in table:
        words = name.replace("/", " ")
        assert find_color_names(words) == [words]


def test_the_cosine_is_the_kernel_within_the_documented_error():
    rng = np.random.default_rng(0)
    a, b = rng.random((2, 1000, 3))
    near = (a + 0.05 * rng.standard_normal(a.shape)).clip(0, 1)
    for pair in ((a, b), (a, near), (a**3, b**3)):  # cubes: dark colours
        first, second = map(lab, pair)
        apart = shading_coordinates(first) - shading_coordinates(second)
        kernel = np.exp(-(apart**2).sum(axis=1) / (2 * KERNEL_SIGMA**2))
        error = np.abs((embed_colors(first) * embed_colors(second)).sum(axis=1) - kernel)
        assert np.abs(np.linalg.norm(embed_colors(first), axis=1) - 1).max() < 1e-12
        assert error.max() < 4e-3
        assert np.quantile(error, 0.99) < 1e-3


def test_numbers_of_familiar_colours():
    cosine = COLOUR.text(["red"]) @ COLOUR.text(["red", "dark red", "orange", "brown", "yellow", "blue"]).T
    assert cosine[0].tolist() == pytest.approx([1, 0.87, 0.58, 0.34, 0.04, 0.01], abs=0.01)
    cosine = COLOUR.text(["white"]) @ COLOUR.text(["grey", "black"]).T
    assert cosine[0].tolist() == pytest.approx([0.43, 0.00], abs=0.01)
    # Several names answer alike
    black, white, both = COLOUR.text(["black", "white", "a black and white cat"])
    apart = (black @ white).item()
    assert (both @ black).item() == pytest.approx(math.sqrt((1 + apart) / 2), abs=1e-5)
    assert (both @ white).item() == pytest.approx((both @ black).item(), abs=1e-5)


def test_a_region_is_its_mean_cielab_colour():
    colours = np.array([(230, 26, 51), (26, 51, 179), (102, 204, 77)], np.uint8)
    image = torch.from_numpy(colours)[None].expand(2, 3, 3)
    labels = torch.tensor([[[0, 0, 1], [-1, 0, -1]]], dtype=torch.int32)
    exact = lab(colours / 255)
    expected = torch.from_numpy(embed_colors(np.stack([(exact[0] + 2 * exact[1]) / 3, exact[2]])))
    torch.testing.assert_close(COLOUR.encode(image, labels), expected.float(), rtol=0, atol=1e-6)
    assert COLOUR.encode(image, torch.full_like(labels, -1)).shape == (0, 343)


def test_prompts_are_reduced_to_names():
    for prompt, found in {
        "Dark-Red Shoes!": ["dark red"], "a black and white cat": ["black", "white"], "light gray": ["light grey"],
        "robin's egg blue": ["robin's egg blue"], "blue/green": ["blue green"], "redwood": [], "": [],
    }.items():  # fmt: skip
        assert find_color_names(prompt) == found, prompt


def test_what_names_no_colour_is_refused_with_near_names():
    for prompts, parts in (
        (["red", 10_000 * "x"], [f"'{39 * 'x'}…'"]),
        (["red", "darkred chair"], ["'darkred chair'", "dark red", "--encoder open_clip"]),
        (["bleu"], ["'bleu'", "blue"]),
        (["7"], ["red, dark green, sky blue"]),
        ([], []),
        ([""], []),
        ("red", ["['red']"]),
    ):
        refused(lambda prompts=prompts: COLOUR.text(prompts), *parts)
    assert COLOUR.rows(["shit brown"]).shape == (1, 343)  # coarse names are understood, but not offered
    for text in ("wooden shield", "pupe", "shift", "vomitt"):
        message = refused(lambda text=text: COLOUR.rows([text]), text)
        assert not any(word in message.split("such as")[1] for word in ("shit", "poo", "vomit", "puke"))
