"""The LERF-OVS protocol by hand: labels, thresholds, cleaning, localisation, averages."""

import json
import math
from itertools import product

import pytest
import torch

from normlift_ns.errors import InputError
from normlift_ns.evaluation import lerf


def write_frame(folder, stem, objects, width=40, height=30):
    info = {"name": f"{stem}.jpg", "width": width, "height": height}
    folder.mkdir(exist_ok=True)
    (folder / f"{stem}.json").write_text(json.dumps({"info": info, "objects": objects}))
    return folder / f"{stem}.json"


def square(category, x, y, size=5, **more):
    corners = [[x, y], [x + size, y], [x + size, y + size], [x, y + size]]
    return {"category": category, "segmentation": corners, **more}


def test_polygons_are_filled_joined_and_scaled(tmp_path):
    egg = square("egg", 20, 10, bbox=[20, 10, 25, 15])
    file = write_frame(tmp_path / "ramen", "frame_00006", [square("egg", 2, 3), egg, square("bowl", 4, 4)])
    frame = lerf.read_frame(file, 40, 30)
    assert list(frame.masks) == ["egg", "bowl"]
    egg = torch.zeros(30, 40, dtype=torch.bool)
    egg[3:9, 2:8] = egg[10:16, 20:26] = True  # fillPoly draws its outline too
    assert torch.equal(frame.masks["egg"], egg)
    assert frame.boxes["egg"] == [(2, 3, 7, 8), (20, 10, 25, 15)]
    half = lerf.read_frame(file, 20, 15)
    assert half.masks["egg"].shape == (15, 20)
    assert half.boxes["egg"][1] == (10, 5, 12.5, 7.5)
    with pytest.raises(InputError, match=r"40 x 30 .* 40 x 40"):
        lerf.read_frame(file, 40, 40)


def test_files_that_do_not_fit(tmp_path):
    with pytest.raises(FileNotFoundError, match="no label files"):
        lerf.read_frames(tmp_path)
    file = write_frame(tmp_path, "frame_3", [square("bowl", 4, 4), square("egg", -20, 3)])
    with pytest.raises(InputError, match=r"frame_3\.json .*'egg' .*outside"):
        lerf.read_frame(file, 40, 30)
    good = write_frame(tmp_path, "frame_1", [square("egg", 0, 0)])
    bad = write_frame(tmp_path, "frame_2", [])
    assert lerf.match_views([good, bad], ["images/frame_1.jpg"]) == ({good: "images/frame_1.jpg"}, ["frame_2"])
    with pytest.raises(InputError, match="no label file in") as caught:
        lerf.match_views([good, bad], [f"image_{letter}.jpg" for letter in "abcd"])
    assert "image_c" in str(caught.value) and "image_d" not in str(caught.value)  # three are enough
    with pytest.raises(InputError, match=r"frame_1\.json .*a/frame_1\.jpg and b/frame_1\.jpg"):
        lerf.match_views([good], ["a/frame_1.jpg", "b/frame_1.jpg"])
    assert lerf.match_views([good], ["a/frame_1.jpg", "a/frame_2.jpg", "b/frame_2.jpg"])[1] == []


def frame_of(masks, boxes=None):
    return lerf.LabeledFrame("f", masks, boxes or {name: [(0.0, 0.0, 1.0, 1.0)] for name in masks})


def test_margin_over_the_best_background_word():
    truth = torch.tensor([[True, True, False, False]])
    prompt = torch.tensor([[[0.30], [0.215], [0.23], [0.10]]])
    background = torch.tensor([[[0.20, 0.1], [0.1, 0.20], [0.20, 0.2], [0.2, 0.2]]])
    scores = lerf.FrameScores(frame_of({"egg": truth}), prompt, background)
    (row,) = lerf.frame_rows(scores, "background", margin=0.02, clean=False)
    assert (row["iou"], row["accuracy"], row["localized"]) == (1 / 3, 1 / 2, 1.0)
    (row,) = lerf.frame_rows(scores, "background", margin=0.0, clean=False)
    assert row["iou"] == 2 / 3  # SFS's margin lets the second pixel in


def test_langsplat_reading():
    relevancy = torch.zeros(90, 90)
    relevancy[30:60, 30:60] = 1.0
    average, mixed = lerf.box_filtered(relevancy)
    assert float(average.max()) == pytest.approx(1, abs=1e-5)
    assert float(mixed[45, 31]) == pytest.approx((1 + float(average[45, 31])) / 2)
    truth = relevancy.bool()
    frame = frame_of({"egg": truth}, {"egg": [(30.0, 30.0, 59.0, 59.0)]})
    scores = lerf.FrameScores(frame, relevancy[..., None], relevancy[..., None][..., :0])
    (row,) = lerf.frame_rows(scores, "langsplat", margin=0, clean=False)
    assert 0.8 < row["iou"] < 0.87  # corners, where the mean is below 0.4, are cut off: 15 % of the square
    assert row["localized"] == 1
    elsewhere = scores._replace(frame=frame_of({"egg": truth}, {"egg": [(0.0, 0.0, 9.0, 9.0)]}))
    assert lerf.frame_rows(elsewhere, "langsplat", margin=0, clean=False)[0]["localized"] == 0
    assert lerf.in_boxes([(1.0, 0.0, 2.0, 1.0)], 3, 4).nonzero().tolist() == [[0, 1], [0, 2], [1, 1], [1, 2]]


def smoothed(mask):
    """LangSplat's majority, pixel by pixel: windows end before the last row and the last column."""
    height, width = mask.shape
    found = torch.zeros_like(mask)
    for i, j in product(range(height), range(width)):
        window = mask[max(0, i - 3) : min(i + 4, height - 1), max(0, j - 3) : min(j + 4, width - 1)]
        found[i, j] = 2 * int(window.sum()) > window.numel()
    return found


def test_the_majority_is_langsplats_up_to_the_border_and_of_nothing():
    for seed in range(4):
        g = torch.Generator().manual_seed(seed)
        height, width = (int(x) for x in torch.randint(2, 30, (2,), generator=g))
        relevancy = torch.rand(height, width, generator=g)
        scaled = (relevancy - relevancy.min()) / (relevancy - relevancy.min()).max()
        expected = smoothed(2 * scaled - 1 > 0.4)
        none = relevancy[..., None][..., :0]
        assert torch.equal(lerf.prompt_mask(relevancy, none, "langsplat", margin=0, instances=1), expected)
    nothing = torch.zeros(4, 4, dtype=torch.bool)  # of two empty masks, SFS's code gives 0, LangSplat's 0 by 0
    scores = lerf.FrameScores(frame_of({"egg": nothing}), torch.zeros(4, 4, 1), torch.ones(4, 4, 8))
    assert lerf.frame_rows(scores, "background", margin=0, clean=False)[0]["iou"] == 0
    assert math.isnan(lerf.frame_rows(scores, "langsplat", margin=0, clean=False)[0]["iou"])


def row(scene, frame, category, iou):
    facts = {"scene": scene, "frame": f"{scene}/{frame}", "category": category}
    return {**facts, "iou": iou, "accuracy": iou, "localized": 1.0}


def test_scenes_are_averaged_as_the_paper_does_and_pooled_beside_it():
    rows = [row("s", "a", "egg", 1.0), row("t", "a", "egg", 0.0), row("t", "b", "egg", 0.5), row("t", "b", "cup", 0.5)]
    frames = lerf.summarize_lerf(rows, "frames", {})
    found = [(scene["scene"], scene["frames"], scene["miou"]) for scene in frames.scenes]
    assert found == [("s", 1, 1), ("t", 2, 1 / 4)]
    assert frames.results["miou"] == (1 + 1 / 4) / 2
    assert frames.results["miou_pooled"] == (1 + 0 + 1 / 2) / 3  # three frames
    for order, mean, pooled in (("pairs", (1 + 1 / 3) / 2, 2 / 4), ("categories", (1 + 3 / 8) / 2, (0.5 + 0.5) / 2)):
        results = lerf.summarize_lerf(rows, order, {}).results
        assert (results["miou"], results["miou_pooled"]) == (mean, pooled), order
