"""Flat options to sources, and what is refused."""

import json
from pathlib import Path

import huggingface_hub
import numpy as np
import pytest

from normlift_ns.encoders import SourceOptions, make_encoder, make_regions, make_source
from normlift_ns.encoders.build import resolve_regions
from normlift_ns.encoders.clip.encoder import OpenClipEncoder
from normlift_ns.encoders.patches import PatchFeatures
from normlift_ns.encoders.regions import Grid, LabelFiles, Superpixels
from normlift_ns.encoders.sam.masks import SamMasks


def test_auto_takes_files_where_a_folder_is_given(tmp_path):
    assert make_regions(SourceOptions(encoder="colour")) == Superpixels(256)
    assert make_regions(SourceOptions(regions_dir=tmp_path)) == LabelFiles(tmp_path)


def test_options_reach_the_regions(tmp_path):
    assert make_regions(SourceOptions(regions="superpixel", region_count=9)) == Superpixels(9)
    assert make_regions(SourceOptions(regions="grid", region_count=9)) == Grid(9)
    options = SourceOptions(
        regions="files", regions_dir=tmp_path, regions_background=-1, regions_resample=True, level="2"
    )
    assert make_regions(options) == LabelFiles(tmp_path, background=-1, level=2, resample=True)


@pytest.mark.parametrize("regions", ["superpixel", "grid", "files"])
def test_identities_are_ready_for_json(tmp_path, regions):
    folder = tmp_path if regions == "files" else None
    identity = make_source(SourceOptions(encoder="colour", regions=regions, regions_dir=folder)).identity
    assert json.loads(json.dumps(identity)) == identity
    assert identity["regions"]["kind"] == regions


def test_a_moved_folder_of_labels_changes_no_identity(tmp_path):
    for name in "ab":
        (tmp_path / name).mkdir()
    a, b = (make_regions(SourceOptions(regions_dir=tmp_path / name)).identity for name in "ab")
    assert a == b


def test_auto_takes_the_best_that_is_there(tmp_path, monkeypatch):
    def chosen(device="cpu", **options):
        return resolve_regions(SourceOptions(**options), device)

    assert chosen() == "patches"
    assert chosen(encoder_model="RN50") == "superpixel"
    assert chosen(encoder="colour") == "superpixel"
    assert chosen(regions_dir=tmp_path) == "files"
    assert chosen(sam_model="weights") == "sam"
    assert chosen(regions="grid", regions_dir=tmp_path) == "grid"
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_CACHE", str(tmp_path))
    assert chosen("cuda") == "patches"
    snapshot = tmp_path / "models--facebook--sam-vit-huge" / "snapshots" / "abc"
    snapshot.mkdir(parents=True)
    (tmp_path / "models--facebook--sam-vit-huge" / "refs").mkdir()
    (tmp_path / "models--facebook--sam-vit-huge" / "refs" / "main").write_text("abc")
    for name in ("config.json", "model.safetensors"):
        (snapshot / name).write_text("")
    assert chosen("cuda") == "sam" and chosen("cuda", encoder="colour") == "superpixel"
    assert chosen() == "patches"


def test_options_reach_sam_and_patches(tmp_path):
    (tmp_path / "sam.pth").write_text("")
    assert make_regions(SourceOptions(regions="sam")) == SamMasks("facebook/sam-vit-huge", "l", "cpu")
    options = SourceOptions(regions="sam", sam_model=str(tmp_path / "sam.pth"), level="default")
    assert make_regions(options) == SamMasks(str(tmp_path / "sam.pth"), "default", "cpu")
    source = make_source(SourceOptions(encoder_model="ViT-B-32", encoder_pretrained="openai", text_template="a {}"))
    assert source == PatchFeatures(OpenClipEncoder("ViT-B-32", "openai", template="a {}"), 1024)
    assert make_source(SourceOptions(region_count=9)) == PatchFeatures(OpenClipEncoder(), 9)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"regions": "patches"}, "--regions patches are for encoders that have features of patches; 'colour' has none"),
        ({"regions": "patches", "level": "l"}, '--level l is for --regions files or sam, not for "patches"'),
        ({"regions": "sam", "level": "2"}, "SAM has the levels default, s, m, l; got '2'"),
        ({"regions": "sam", "regions_dir": Path()}, '--regions-dir . is for --regions files, not for "sam"'),
        ({"regions": "grid", "sam_model": "x/y"}, '--sam-model x/y is for --regions sam, not for "grid"'),
        ({"regions": "patches", "sam_model": "x/y"}, '--sam-model x/y is for --regions sam, not for "patches"'),
        (
            {"encoder": "clip"},
            "unknown encoder 'clip'; --encoder is one of colour, metaclip2, open_clip, siglip, siglip2",
        ),
        (
            {"regions": "slic"},
            "regions must be one of auto, sam, sam3, patches, superpixel, grid, files; got 'slic'",
        ),
        ({"regions": "files"}, 'regions "files" need a folder of label maps.*--regions-dir'),
        ({"regions": "grid", "level": "1"}, '--level 1 is for --regions files or sam, not for "grid"'),
        ({"level": "0"}, '--level 0 is for --regions files or sam, not for "superpixel"'),
        ({"level": "l", "regions_dir": Path()}, "--level of --regions files is the number of a map, .*got 'l'"),
        ({"level": "-1", "regions_dir": Path()}, "number of a map, .*got '-1'"),
        ({"features": "lerf"}, "features must be one of none, langsplat; got 'lerf'"),
        ({"features": "langsplat"}, "features 'langsplat' need their folder: give it with --features-dir"),
        ({"features_dir": Path("f")}, "--features-dir f has no effect without --features langsplat; add that flag"),
    ],
)
def test_bad_options_say_what_to_do(options, message):
    with pytest.raises(ValueError, match=message):
        make_source(SourceOptions(**{"encoder": "colour", **options}))


def test_a_folder_without_use_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"--regions-dir .* is for --regions files"):
        make_regions(SourceOptions(regions="superpixel", regions_dir=tmp_path))


def test_the_colour_encoder_needs_no_options():
    assert np.allclose(make_encoder(SourceOptions(encoder="colour")).text(["red"]).norm(dim=1), 1)
