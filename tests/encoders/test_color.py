"""The colour encoder against its own formulas."""

import json
import math
from importlib import import_module
from importlib.resources import files

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from normlift_ns.encoders import color as space
from normlift_ns.encoders.color import KERNEL_SIGMA, ColorEncoder, find_color_names
from tests.encoders.tiny import refused

COLOUR = ColorEncoder()
rgb = st.tuples(*[st.floats(0, 1, width=32)] * 3)


def lab(colours) -> torch.Tensor:
    rgb2lab = import_module("skimage.color").rgb2lab
    return torch.from_numpy(rgb2lab(torch.as_tensor(colours, dtype=torch.float64).numpy()))


def embed(colours: torch.Tensor) -> torch.Tensor:
    return torch.from_numpy(space.embed_colors(colours.numpy()))


def shading_coordinates(colours: torch.Tensor) -> torch.Tensor:
    return torch.from_numpy(space.shading_coordinates(colours.numpy()))


@pytest.fixture(scope="module")
def survey() -> dict[str, str]:
    return import_module("matplotlib.colors").XKCD_COLORS


def test_every_name_of_the_survey_is_understood(survey):
    table = json.loads(files("normlift_ns.encoders").joinpath("xkcd.json").read_text())
    assert {f"xkcd:{name}": colour for name, colour in table.items()} == survey
    for name in survey:
        words = name.removeprefix("xkcd:").replace("/", " ")
        assert find_color_names(words) == [words]
    assert len(survey) == 949


def test_coarse_names_are_understood_but_not_offered():
    colour = ColorEncoder()
    assert colour.rows(["shit brown"]).shape == (1, 343)
    for text in ("wooden shield", "pupe", "shift", "vomitt"):
        message = refused(lambda text=text: colour.rows([text]), text)
        assert not any(word in message.split("such as")[1] for word in ("shit", "poo", "vomit", "puke"))


def test_the_cosine_is_the_kernel_within_the_documented_error():
    generator = torch.Generator().manual_seed(0)
    a, b = torch.rand(2, 1000, 3, generator=generator, dtype=torch.float64)
    near = (a + 0.05 * torch.randn(a.shape, generator=generator, dtype=torch.float64)).clamp(0, 1)
    for pair in ((a, b), (a, near), (a**3, b**3)):  # cubes: dark colours
        first, second = map(lab, pair)
        apart = shading_coordinates(first) - shading_coordinates(second)
        kernel = torch.exp(-(apart**2).sum(dim=1) / (2 * KERNEL_SIGMA**2))
        error = ((embed(first) * embed(second)).sum(dim=1) - kernel).abs()
        assert (torch.linalg.vector_norm(embed(first), dim=1) - 1).abs().max() < 1e-12
        assert error.max() < 4e-3
        assert error.quantile(0.99) < 1e-3


@given(st.tuples(*[st.floats(0.5, 1)] * 3), st.floats(0.3, 1))
def test_shade_changes_lightness_only(colour, shade):
    linear = torch.tensor(colour, dtype=torch.float64) ** 2.2 * 0.9
    both = lab(torch.stack([linear, shade * linear]) ** (1 / 2.4) * 1.055 - 0.055)
    lit, shaded = shading_coordinates(both)
    assert shaded[1:].tolist() == pytest.approx(lit[1:].tolist(), abs=1e-3)
    assert (shaded / lit)[0].item() == pytest.approx((both[1] / both[0])[0].item(), rel=1e-4)
    assert both[1, 0].item() + 16 == pytest.approx((both[0, 0].item() + 16) * shade ** (1 / 3), abs=1e-3)


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
    colours = lab([(0.9, 0.1, 0.2), (0.1, 0.2, 0.7), (0.4, 0.8, 0.3)])
    exact = torch.from_numpy(import_module("skimage.color").lab2rgb(colours.numpy()))
    image = (exact * 255).round().to(torch.uint8)[None].expand(2, 3, 3)
    labels = torch.tensor([[[0, 0, 1], [-1, 0, -1]]], dtype=torch.int32)
    exact = lab(image[0].double() / 255)
    expected = embed(torch.stack([(exact[0] + 2 * exact[1]) / 3, exact[2]]))
    torch.testing.assert_close(COLOUR.encode(image, labels), expected.float(), rtol=0, atol=1e-6)
    assert COLOUR.encode(image, torch.full_like(labels, -1)).shape == (0, 343)


def test_the_vectors_of_an_image_do_not_depend_on_others_that_are_read_at_once():
    g = torch.Generator().manual_seed(0)
    views = [
        (
            torch.randint(0, 256, (30, 40, 3), generator=g, dtype=torch.uint8),
            torch.arange(40).expand(1, 30, 40).int() // 8,
        )
        for _ in range(20)
    ]
    space._anchors.cache_clear()
    together = list(COLOUR.encode_each(iter(views)))
    for (image, labels), rows in zip(views, together, strict=True):
        assert torch.equal(rows, COLOUR.encode(image, labels))


def test_basic_colours_are_found_in_shade(survey):
    names = ["red", "orange", "yellow", "green", "blue", "purple", "pink", "brown", "black", "white", "grey"]
    colour = torch.tensor([list(bytes.fromhex(survey[f"xkcd:{name}"][1:])) for name in names]) / 255
    for shade in (0.8, 0.9, 1.0):  # of sRGB: down to three fifths of the light
        image = (colour * shade * 255).round().to(torch.uint8)[None]
        labels = torch.arange(len(names), dtype=torch.int32)[None, None]
        best = (COLOUR.encode(image, labels) @ COLOUR.text(names).T).argmax(dim=1)
        assert [names[i] for i in best] == names


def test_prompts_are_reduced_to_names():
    for prompt, found in {
        "orange": ["orange"],
        "dark red shoes": ["dark red"],
        "Dark-Red Shoes!": ["dark red"],
        "a black and white cat": ["black", "white"],
        "robin's egg blue": ["robin's egg blue"],
        "light gray": ["light grey"],
        "blue/green": ["blue green"],
        "redwood": [],
        "": [],
    }.items():
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
