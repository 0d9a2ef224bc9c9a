"""Flat options to sources, and what is refused."""

import json
from pathlib import Path

import numpy as np
import pytest

from normlift_ns.encoders import SourceOptions, make_encoder, make_regions, make_source
from normlift_ns.encoders.regions import Grid, LabelFiles, Superpixels


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


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"encoder": "clip"}, "unknown encoder 'clip'; --encoder is one of open_clip, colour"),
        (
            {"regions": "slic"},
            "unknown regions 'slic'; --regions is one of auto, sam, patches, superpixel, grid, files",
        ),
        ({"regions": "files"}, 'regions "files" need a folder of label maps.*--regions-dir'),
        ({"regions": "grid", "level": "1"}, '--level 1 is for --regions files or sam, not for "grid"'),
        ({"level": "0"}, '--level 0 is for --regions files or sam, not for "superpixel"'),
        ({"level": "l", "regions_dir": Path()}, "--level of --regions files is the number of a map, .*got 'l'"),
        ({"level": "-1", "regions_dir": Path()}, "number of a map, .*got '-1'"),
        ({"features": "lerf"}, "unknown features 'lerf'; --features is one of none, langsplat"),
        ({"features": "langsplat"}, "features 'langsplat' need their folder: give it with --features-dir"),
        ({"features_dir": Path("f")}, "--features-dir f is without use; add --features langsplat"),
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
