"""The values and the protocol that features come in."""

import subprocess
import sys

import pytest
import torch

from normlift_ns.encoders import RegionFeatures, SourceOptions, ViewFeatures, make_source
from normlift_ns.encoders.colour import ColourEncoder
from normlift_ns.encoders.regions import Grid
from normlift_ns.encoders.texts.prompts import check_prompts

UNIT = torch.nn.functional.normalize(torch.arange(1.0, 7.0).reshape(2, 3), dim=1)


def test_view_features_accept_unlabelled_pixels_and_regions_without_pixels():
    view = ViewFeatures(torch.tensor([[-1, 0], [0, 0]], dtype=torch.int32), UNIT)
    assert view.features.shape == (2, 3)
    ViewFeatures(torch.full((4, 5), -1, dtype=torch.int32), torch.zeros(0, 3))


@pytest.mark.parametrize(
    ("labels", "features", "message"),
    [
        (torch.zeros(2, 2), UNIT, "labels must be a torch.int32 matrix"),
        (torch.zeros(4, dtype=torch.int32), UNIT, "labels must be a torch.int32 matrix"),
        (torch.zeros(2, 2, dtype=torch.int32), UNIT.double(), "features must be a torch.float32 matrix"),
        (torch.full((2, 2), 2, dtype=torch.int32), UNIT, r"in -1\.\.1 \(there are 2 cells\), found 2\.\.2"),
        (torch.full((2, 2), -2, dtype=torch.int32), UNIT, r"found -2\.\.-2"),
        (torch.zeros(2, 2, dtype=torch.int32), 2 * UNIT, r"2 of 2 rows .*\(row 0 has length 2\)"),
        (torch.zeros(2, 2, dtype=torch.int32), UNIT * torch.tensor([[1.0], [torch.nan]]), "row 1 has length nan"),
    ],
)
def test_view_features_refuse_what_does_not_fit(labels, features, message):
    with pytest.raises(ValueError, match=message):
        ViewFeatures(labels, features)


def test_regions_of_cells_must_have_features():
    labels = torch.tensor([[-1, 0], [1, 2]], dtype=torch.int32)
    view = ViewFeatures(labels, UNIT, torch.tensor([[1, -1, 0], [-1, -1, 1]], dtype=torch.int32))
    assert torch.equal(view.region_of_cell, view.regions)
    assert ViewFeatures(labels.clamp(max=1), UNIT).region_of_cell.tolist() == [[0, 1]]
    for regions, message in (
        ([[0, 2, 1]], r"regions must be in -1\.\.1 \(there are 2 feature rows\), found 0\.\.2"),
        ([[0, 1]], r"labels must be in -1\.\.1 \(there are 2 cells\), found -1\.\.2"),
        ([0, 1, 0], "regions must be a torch.int32 matrix"),
    ):
        with pytest.raises(ValueError, match=message):
            ViewFeatures(labels, UNIT, torch.tensor(regions, dtype=torch.int32))


@pytest.mark.parametrize(
    "image", [torch.zeros(4, 5, 4, dtype=torch.uint8), torch.zeros(4, 5, 3), torch.zeros(0, 5, 3, dtype=torch.uint8)]
)
def test_other_images_are_refused_by_name(image):
    with pytest.raises(ValueError, match=r"image a/b\.png must be a uint8 tensor \[H, W, 3\]"):
        RegionFeatures(Grid(4), ColourEncoder()).view(image, "a/b.png")


@pytest.mark.parametrize(
    ("prompts", "message"),
    [([], "no text given"), (["red", " "], "text 2 of 2 is empty"), ("red", r"write \['red'\]")],
)
def test_prompts_must_be_texts(prompts, message):
    with pytest.raises(ValueError, match=message):
        check_prompts(prompts)


def test_view_and_text_share_one_space():
    image = torch.zeros(32, 48, 3, dtype=torch.uint8)
    image[:, :24] = torch.tensor([229, 0, 0], dtype=torch.uint8)  # the survey's red
    image[:, 24:] = torch.tensor([3, 67, 223], dtype=torch.uint8)  # and its blue
    source = make_source(SourceOptions(encoder="colour", regions="grid", region_count=24))
    view = source.view(image, "a.png")
    assert view.labels.shape == (32, 48) and len(view.features) == 24
    cosine = view.features @ source.text(["red", "blue"]).T
    red = view.labels[:, :24].unique().tolist()
    for region in range(24):
        expected = (1, 0) if region in red else (0, 1)
        assert cosine[region].tolist() == pytest.approx(expected, abs=1e-3)


def test_imports_stay_light():
    code = """
import sys, normlift_ns, normlift_ns.encoders
print(sorted({"open_clip", "nerfstudio", "gsplat", "timm"} & {name.partition(".")[0] for name in sys.modules}))
"""
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ran.stdout.strip() == "[]"
