"""LangSplat's files: as its preprocessing writes them, as other programs do, broken ones, and our own.

The files are put together byte by byte, so that reading is tested without our writing.
"""

from __future__ import annotations

import io
import json
import struct
import warnings
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch

from normlift_ns.encoders import LangSplat, RegionFeatures, SourceOptions, make_source, write_langsplat
from normlift_ns.encoders.clip.encoder import OpenClipEncoder
from normlift_ns.encoders.colour import ColourEncoder
from normlift_ns.encoders.regions import Grid, LabelFiles
from normlift_ns.encoders.texts.files import TextVectors, write_text_vectors

NAME = "images/frame_00001.jpg"
HEIGHT, WIDTH, D = 3, 4, 512
IMAGE = torch.zeros(HEIGHT, WIDTH, 3, dtype=torch.uint8)
X = -1
# Rows 0, 1 are masks of the whole output, 2 and 3 subparts, 4 a part, 5 and 6 wholes.
DEFAULT = [[0, 0, 1, 1], [0, 0, 1, X], [X, X, X, X]]
S = [[2, X, X, X], [X, X, 3, X], [X, X, X, X]]
M = [[4, 4, X, X], [4, X, X, X], [X, X, X, X]]
L = [[5, 5, 6, 6], [5, 5, 6, 6], [5, 5, X, X]]
CHANNELS = [DEFAULT, S, M, L]
T = 7


def npy(descr: str, shape: tuple[int, ...], data: bytes) -> bytes:
    """An NPY file of version 1.0."""
    header = f"{{'descr': '{descr}', 'fortran_order': False, 'shape': {shape}, }}"
    header += " " * (-(len(header) + 11) % 64) + "\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header.encode("latin1") + data


def rows(count: int = T) -> list[list[float]]:
    """Vectors as LangSplat leaves them: of unit length in half precision, stored as float32."""
    drawn = torch.randn(count, D, generator=torch.Generator().manual_seed(0))
    return torch.nn.functional.normalize(drawn, dim=1).half().float().tolist()


def put_table(folder: Path, table: list[list[float]], stem: str = "frame_00001", kind: str = "f") -> None:
    data = b"".join(struct.pack(f"<{len(row)}{kind}", *row) for row in table)
    size = {"f": 4, "d": 8, "e": 2}[kind]
    (folder / f"{stem}_f.npy").write_bytes(npy(f"<f{size}", (len(table), len(table[0]) if table else D), data))


def put_map(
    folder: Path, channels: list = CHANNELS, stem: str = "frame_00001", kind: str = "f", descr: str = "<f4"
) -> None:
    values = [value for channel in channels for row in channel for value in row]
    shape = (len(channels), len(channels[0]), len(channels[0][0]))
    (folder / f"{stem}_s.npy").write_bytes(
        npy(descr, shape, struct.pack(f"{descr[0].replace('|', '=')}{len(values)}{kind}", *values))
    )


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    put_map(tmp_path)
    put_table(tmp_path, rows())
    return tmp_path


def source(folder: Path, level: str = "l", **options: object) -> LangSplat:
    return LangSplat(folder, ColourEncoder(), level, **options)  # type: ignore[arg-type]


def pixels(view) -> torch.Tensor:
    """Feature of every pixel, [H, W, D]; 0 for none."""
    region = torch.cat([view.region_of_cell[0], torch.tensor([-1])])[view.labels.long()]
    return torch.cat([view.features, torch.zeros(1, view.features.shape[1])])[region.long()]


def expected(channel: list, table: list[list[float]] | None = None) -> torch.Tensor:
    """The same by hand, with rows of exact unit length."""
    unit = torch.nn.functional.normalize(torch.tensor(table or rows(), dtype=torch.float64), dim=1)
    return torch.cat([unit, torch.zeros(1, D, dtype=torch.float64)])[torch.tensor(channel)]


def assert_close(view, features: torch.Tensor, tolerance: float = 1e-3) -> None:
    assert torch.allclose(pixels(view).double(), features, atol=tolerance, rtol=tolerance)


@pytest.mark.parametrize(("level", "channel"), [("default", DEFAULT), ("s", S), ("m", M), ("l", L)])
def test_a_level_is_its_channel(folder, level, channel):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = source(folder, level)
        assert found.available([NAME]) == [NAME]
        view = found.view(IMAGE, NAME)
    assert_close(view, expected(channel))
    assert len(view.features) == len({value for row in channel for value in row if value >= 0})
    assert torch.equal(view.labels, source(folder).view(IMAGE, NAME).labels)  # one partition for all levels
    assert ((view.features.double().norm(dim=1) - 1).abs() < 1e-3).all()


def test_sum_adds_all_levels_up(folder):
    total = sum(expected(channel) for channel in CHANNELS)
    features = torch.nn.functional.normalize(total, dim=2)
    view = source(folder, "sum").view(IMAGE, NAME)
    assert_close(view, features)
    assert (view.features.double().norm(dim=1) - 1).abs().max() < 1e-6
    # Nine combinations of rows occur, and no pixel is without any but the last two.
    assert (pixels(view).norm(dim=2) == 0).tolist() == [[False] * 4, [False] * 4, [False, False, True, True]]
    assert len(view.features) == len({tuple(c[y][x] for c in CHANNELS) for y in range(3) for x in range(4)}) - 1


def test_opposite_vectors_cancel_in_the_sum(tmp_path):
    table = rows()
    table[5] = [-value for value in table[0]]
    put_map(tmp_path, [DEFAULT, [[X] * 4] * 3, [[X] * 4] * 3, L])
    put_table(tmp_path, table)
    view = source(tmp_path, "sum").view(IMAGE, NAME)
    assert (pixels(view)[:2, :2] == 0).all()
    assert (pixels(view)[:2, 2:3].norm(dim=2) > 0.99).all()


@pytest.mark.parametrize(
    ("kind", "descr"),
    [("f", "<f4"), ("d", "<f8"), ("e", "<f2"), ("i", "<i4"), ("q", "<i8"), ("h", "<i2"), ("b", "|i1"), ("i", ">i4")],
)
def test_maps_of_every_type(folder, kind, descr):
    (folder / "frame_00001_s.npy").unlink()
    put_map(folder, kind=kind, descr=descr)
    for level, channel in zip(("default", "s", "m", "l"), CHANNELS):
        assert_close(source(folder, level).view(IMAGE, NAME), expected(channel))


def test_unsigned_maps_wrap_minus_one_around(folder):
    """-1 becomes 255, which is past the table."""
    put_map(folder, [[[value % 256 for value in row] for row in c] for c in CHANNELS], kind="B", descr="|u1")
    with pytest.warns(UserWarning, match=r"_s\.npy: channels 0, 1, 2, 3 hold ids past the 7 rows of its table \(255\)"):
        assert_close(source(folder).view(IMAGE, NAME), expected(L))


@pytest.mark.parametrize("kind", ["f", "d", "e"])
def test_tables_of_every_type(folder, kind):
    put_table(folder, rows(), kind=kind)
    assert_close(source(folder).view(IMAGE, NAME), expected(L))


def test_rows_of_any_length_are_normalised(folder):
    """As where CLIP vectors were not; those of unit length stay as they are, bit for bit."""
    table = rows()
    table[5] = [10 * value for value in table[5]]
    put_table(folder, table)
    view = source(folder).view(IMAGE, NAME)
    assert_close(view, expected(L), 1e-6 + 5e-4)
    assert torch.equal(view.features[1], torch.tensor(table[6]))
    assert abs(float(view.features[0].double().norm()) - 1) < 1e-6


def test_half_precision_ids_beyond_2048_are_refused(tmp_path):
    put_table(tmp_path, rows(2100))
    put_map(tmp_path, [[[2050, 3]]], kind="e", descr="<f2")
    with pytest.raises(ValueError, match=r"_s\.npy holds float16 with ids of 2048 and more, which are rounded"):
        source(tmp_path).view(torch.zeros(1, 2, 3, dtype=torch.uint8), NAME)
    put_map(tmp_path, [[[2050, 3]]])
    assert source(tmp_path).view(torch.zeros(1, 2, 3, dtype=torch.uint8), NAME).features.shape == (2, D)


@pytest.mark.parametrize("level", ["default", "s", "m", "l", "sum"])
@pytest.mark.parametrize("channels", [1, 4])
def test_one_channel_serves_every_level(folder, level, channels):
    """One channel, or the same one four times."""
    put_map(folder, [L] * channels)
    assert_close(source(folder, level).view(IMAGE, NAME), expected(L))


def test_a_map_without_channels(folder):
    flat = [value for row in L for value in row]
    (folder / "frame_00001_s.npy").write_bytes(npy("<i4", (HEIGHT, WIDTH), struct.pack("<12i", *flat)))
    assert_close(source(folder).view(IMAGE, NAME), expected(L))


@pytest.mark.parametrize("place", [".", "language_features", "language_features/language_features"])
def test_the_folder_may_be_doubled(tmp_path, place):
    (tmp_path / place).mkdir(parents=True, exist_ok=True)
    put_map(tmp_path / place)
    put_table(tmp_path / place, rows())
    assert_close(source(tmp_path).view(IMAGE, NAME), expected(L))


def test_maps_of_another_resolution(folder):
    large = source(folder).view(torch.zeros(2 * HEIGHT, 2 * WIDTH, 3, dtype=torch.uint8), NAME)
    assert_close(large, expected(L).repeat_interleave(2, 0).repeat_interleave(2, 1))
    stretched = torch.zeros(HEIGHT, 2 * WIDTH, 3, dtype=torch.uint8)
    with pytest.raises(ValueError, match=r"_s\.npy is 4x3 \(width x height\), its image 8x3: another aspect ratio"):
        source(folder).view(stretched, NAME)
    assert_close(source(folder, resample=True).view(stretched, NAME), expected(L).repeat_interleave(2, 1))


def test_regions_that_vanish_in_a_small_image_have_no_rows(folder):
    view = source(folder, "s", resample=True).view(torch.zeros(1, 1, 3, dtype=torch.uint8), NAME)
    assert view.features.shape == (1, D)  # row 3 of the table, at the centre


def test_missing_frames_are_listed_and_refused_or_left_out(folder):
    names = [NAME, "images/frame_00002.jpg", "images/frame_00003.jpg"]
    put_map(folder, stem="frame_00003")  # without its table
    listed = r"2 of 3 images have no features in .*: images/frame_00002\.jpg, images/frame_00003\.jpg"
    with pytest.raises(FileNotFoundError, match=listed + r"\. Expected .*--features-missing skip"):
        source(folder).available(names)
    with pytest.warns(UserWarning, match=listed + "; they are left out"):
        assert source(folder, missing="skip").available(names) == [NAME]
    with pytest.raises(FileNotFoundError, match="1 of 1 images have no features"):
        source(folder, missing="skip").available(names[1:2])
    with pytest.raises(FileNotFoundError, match=r"frame_00002\.jpg has no features"):
        source(folder).view(IMAGE, names[1])


def test_names_end_at_the_first_dot_or_the_last(folder):
    put_map(folder, [S], stem="a")
    put_table(folder, rows(), stem="a")
    assert_close(source(folder).view(IMAGE, "a.left.jpg"), expected(S))
    put_map(folder, [M], stem="a.left")
    put_table(folder, rows(), stem="a.left")
    assert_close(source(folder).view(IMAGE, "a.left.jpg"), expected(M))
    with pytest.raises(ValueError, match=r"images x/a\.right\.png and a\.jpg would share the features .*a_s\.npy"):
        source(folder).available(["x/a.right.png", "a.jpg"])


def test_paths_in_names_lead_nowhere_else(folder):
    (folder / "inner").mkdir()
    put_map(folder / "inner", stem="b")
    put_table(folder / "inner", rows(), stem="b")
    for name in ("inner/b.jpg", "../inner/b.jpg", str(folder / "inner" / "b.jpg"), "..", ""):
        with pytest.raises(FileNotFoundError, match="no features"):
            source(folder).available([name])


def test_ids_past_the_table_count_as_unlabelled(folder):
    put_table(folder, rows()[:6])
    with pytest.warns(UserWarning, match=r"_s\.npy: channels 3 hold ids past the 6 rows of its table \(6\), in 4 pix"):
        view = source(folder).view(IMAGE, NAME)
    assert_close(view, expected([[5, 5, X, X], [5, 5, X, X], [5, 5, X, X]]))


@pytest.mark.parametrize("garbage", [float("nan"), float("inf"), -7.0])
def test_garbage_ids_count_as_unlabelled(folder, garbage):
    put_map(folder, [DEFAULT, S, M, [[garbage, 5, 6, 6], *L[1:]]])
    found = source(folder)
    if garbage < 0:
        view = found.view(IMAGE, NAME)
    else:
        with pytest.warns(UserWarning, match=rf"channels 3 hold ids that are not finite \({garbage}\), in 1 pixels"):
            view = found.view(IMAGE, NAME)
    assert_close(view, expected([[X, 5, 6, 6], *L[1:]]))


@pytest.mark.parametrize("wrong", [float("nan"), float("inf"), 0.0])
def test_rows_without_direction_count_as_unlabelled(folder, wrong):
    table = rows()
    table[5] = [wrong] * D if wrong == 0 else [*table[5][:-1], wrong]
    put_table(folder, table)
    with pytest.warns(UserWarning, match=r"_f\.npy: rows 5 of the table are zero or not finite"):
        view = source(folder).view(IMAGE, NAME)
    assert_close(view, expected([[X, X, 6, 6], [X, X, 6, 6], [X] * 4]))
    with pytest.warns(UserWarning, match="rows 5"):
        view = source(folder, "sum").view(IMAGE, NAME)
    without = [[[X if value == 5 else value for value in row] for row in channel] for channel in CHANNELS]
    assert_close(view, torch.nn.functional.normalize(sum(expected(channel) for channel in without), dim=2))


def test_an_image_without_any_mask(tmp_path):
    put_map(tmp_path, [[[X] * WIDTH] * HEIGHT] * 4)
    put_table(tmp_path, [])
    for level in ("l", "sum"):
        view = source(tmp_path, level).view(IMAGE, NAME)
        assert view.features.shape == (0, D)
        assert (view.labels == -1).all()


@pytest.mark.parametrize(
    ("suffix", "content", "message"),
    [
        ("s", npy("<f4", (4, 3, 4), b"\0" * 188), "segment map .*frame_00001_s.npy is damaged or no NPY file"),
        ("s", npy("|O", (4,), b"\x80\x04N."), "segment map .*_s.npy is damaged or no NPY file .*objects"),
        ("s", b"PK\x03\x04", "segment map .*_s.npy is damaged or no NPY file"),
        ("s", b"", "segment map .*_s.npy is damaged or no NPY file"),
        ("s", npy("<f4", (3, 1, 1), b"\0" * 12), r"holds float32 \(3, 1, 1\), expected numbers \[4, H, W\]"),
        ("s", npy("<U1", (4, 1, 1), b"\0" * 16), "holds <U1; expected an integer type or floats"),
        ("s", npy("<f4", (4, 0, 1), b""), r"holds float32 \(4, 0, 1\)"),
        ("f", npy("<f4", (7, D), b"\0" * 100), "feature table .*frame_00001_f.npy is damaged or no NPY file"),
        ("f", npy("<f4", (7, 3), b"\0" * 84), r"feature table .*_f.npy holds float32 \(7, 3\).*language_features_dim3"),
        ("f", npy("<i4", (7, D), b"\0" * 28 * D), r"feature table .*_f.npy holds int32 \(7, 512\), expected floats"),
    ],
)  # fmt: skip
def test_broken_files_are_named_before_the_lift(folder, suffix, content, message):
    (folder / f"frame_00001_{suffix}.npy").write_bytes(content)
    with pytest.raises(ValueError, match=message):
        source(folder).available([NAME])


def test_interpolated_maps_are_refused_with_the_place(folder):
    put_map(folder, [DEFAULT, S, M, [L[0], [5, 5.5, 6, 6], L[2]]])
    with pytest.raises(ValueError, match=r"_s\.npy: channel 3, row 1, column 1 holds 5\.5, which is no id"):
        source(folder).view(IMAGE, NAME)


def test_tables_of_two_encoders_are_refused(folder):
    put_map(folder, stem="b")
    (folder / "b_f.npy").write_bytes(npy("<f4", (1, 768), b"\0" * 4 * 768))
    with pytest.raises(ValueError, match=r"frame_00001_f\.npy have 512 numbers, those of .*b_f\.npy 768"):
        source(folder).available([NAME, "b.jpg"])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"level": "xl"}, "--level of features langsplat is one of default, s, m, l, sum; got 'xl'"),
        ({"missing": "maybe"}, "--features-missing of features langsplat is one of error, skip; got 'maybe'"),
    ],
)
def test_unknown_options(folder, options, message):
    with pytest.raises(ValueError, match=message):
        LangSplat(folder, ColourEncoder(), **options)


def test_a_folder_without_features(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"holds no features of LangSplat \(--features-dir\): no \*_s\.npy"):
        source(tmp_path / "nowhere")


def test_flags_make_the_source(folder):
    options = {"features": "langsplat", "features_dir": folder}
    assert make_source(SourceOptions(**options)) == LangSplat(folder, OpenClipEncoder())
    found = make_source(SourceOptions(**options, level="sum", features_missing="skip", regions_resample=True))
    assert found == LangSplat(folder, OpenClipEncoder(), "sum", "skip", resample=True)
    assert json.loads(json.dumps(found.identity)) == found.identity
    np.savez(folder / "texts.npz", cup=np.ones(D))
    found = make_source(SourceOptions(**options, text_vectors=folder / "texts.npz"))
    assert torch.allclose(found.text(["cup"]), torch.full((1, D), D**-0.5))
    for more, message in (
        ({"regions": "grid"}, "--regions and --regions-dir cut images up, but --features brings regions of its own"),
        ({"regions_dir": folder}, "leave one out"),
        ({"encoder": "colour"}, "encoder 'colour' did not make the features in .*--encoder-model"),
    ):
        with pytest.raises(ValueError, match=message):
            make_source(SourceOptions(**options, **more))
    with pytest.raises(ValueError, match=r"--text-vectors .* is for imported features; add --features langsplat"):
        make_source(SourceOptions(encoder="colour", text_vectors=folder / "texts.npz"))


# Writing.

PHOTO = torch.randint(0, 256, (30, 40, 3), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)


def labels_4(folder: Path, levels: int = 4) -> RegionFeatures:
    rng = np.random.default_rng(0)
    maps = rng.integers(0, 5, (levels, 6, 8)).repeat(5, axis=1).repeat(5, axis=2)
    np.save(folder / "a.npy", maps)
    return RegionFeatures(LabelFiles(folder, level=1), ColourEncoder())


@pytest.mark.parametrize("levels", [4, 2])
def test_a_round_trip_is_exact(tmp_path, levels):
    """Four levels fill four channels, any other number of them the chosen one four times."""
    (tmp_path / "labels").mkdir()
    ours = labels_4(tmp_path / "labels", levels)
    write_langsplat(ours, PHOTO, "images/a.jpg", tmp_path / "out", overwrite=False)
    segments, table = (np.load(tmp_path / "out" / f"a_{x}.npy") for x in "sf")
    assert (segments.dtype, segments.shape, table.dtype) == (np.float32, (4, 30, 40), np.float32)
    assert segments.max() + 1 == len(table)
    for number, level in enumerate(("default", "s", "m", "l")) if levels == 4 else [(1, "l")]:
        regions = LabelFiles(tmp_path / "labels", level=number)
        expected_view = RegionFeatures(regions, ColourEncoder()).view(PHOTO, "images/a.jpg")
        found = source(tmp_path / "out", level).view(PHOTO, "images/a.jpg")
        assert torch.equal(found.features, expected_view.features)
        assert torch.equal(pixels(found), pixels(expected_view))
        if levels == 4:
            assert torch.equal(found.labels, expected_view.labels)
            assert torch.equal(found.region_of_cell, expected_view.region_of_cell)
            start = [0, *np.cumsum([c.max() for c in np.load(tmp_path / "labels" / "a.npy")])]
            channel = segments[number]
            assert channel[channel >= 0].min() == start[number]
            assert channel.max() == start[number + 1] - 1


def test_a_copy_of_langsplats_own_file_is_the_same_level(folder, tmp_path):
    write_langsplat(source(folder), IMAGE, NAME, tmp_path / "copy", overwrite=False)
    first, second = (source(place).view(IMAGE, NAME) for place in (folder, tmp_path / "copy"))
    assert torch.equal(first.features, second.features)
    assert torch.equal(pixels(first), pixels(second))


def test_existing_files_stay_unless_asked(tmp_path):
    ours = RegionFeatures(Grid(4), ColourEncoder())
    for _ in range(2):  # the same content: as where an interrupted lift goes on
        write_langsplat(ours, PHOTO, "a.jpg", tmp_path, overwrite=False)
    other = RegionFeatures(Grid(9), ColourEncoder())
    with pytest.raises(FileExistsError, match=r"a_s\.npy exists with other content; .*--overwrite True"):
        write_langsplat(other, PHOTO, "a.jpg", tmp_path, overwrite=False)
    write_langsplat(other, PHOTO, "a.jpg", tmp_path, overwrite=True)
    assert len(np.load(tmp_path / "a_f.npy")) > 4
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a_f.npy", "a_s.npy"]


def test_several_levels_at_once_have_no_place_in_the_format(tmp_path):
    class Both(LabelFiles):
        chosen = (0, 1)

    labels_4(tmp_path, 2)
    with pytest.raises(ValueError, match="several levels at once cannot be written"):
        write_langsplat(RegionFeatures(Both(tmp_path), ColourEncoder()), PHOTO, "a.jpg", tmp_path, overwrite=False)


# Text vectors.


def test_text_vectors_are_looked_up_and_normalised(tmp_path):
    file = tmp_path / "t.npz"
    np.savez(file, **{"wine bottle": np.arange(4, dtype=np.float16), "a/b": np.array([0, 0, -2.0, 0])})
    texts = TextVectors(file)
    assert texts.names == ("wine bottle", "a/b")
    assert torch.allclose(texts.text(["a/b", "wine bottle"])[0], torch.tensor([0.0, 0, -1, 0]))
    assert torch.allclose(texts.text(["wine bottle"]).norm(dim=1), torch.ones(1))
    with pytest.raises(ValueError, match=r"text 'wine botle' has no vector in .*t\.npz, .*near names: wine bottle"):
        texts.text(["wine botle"])
    with pytest.raises(ValueError, match="no text given"):
        texts.text([])


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (lambda p: p.write_bytes(b"PK no archive"), "damaged or no NPZ file"),
        (
            lambda p: np.savez(p, a=np.array([{}], dtype=object)),
            "damaged or no NPZ file .*of 'a' is none: it holds objects",
        ),
        (lambda p: np.savez(p, a=np.ones(4), b=np.ones(5)), "the same D for every text"),
        (lambda p: np.savez(p, a=np.ones((2, 4))), r"array of 'a' is float64 \(2, 4\)"),
        (lambda p: np.savez(p, a=np.ones(4, int)), r"array of 'a' is int64 \(4,\)"),
        (lambda p: np.savez(p, a=np.zeros(4)), "vector of 'a' is zero or not finite"),
        (lambda p: np.savez(p, a=np.array([1, np.nan])), "vector of 'a' is zero or not finite"),
    ],
)
def test_broken_text_vectors_name_file_and_array(tmp_path, write, message):
    write(tmp_path / "t.npz")
    with pytest.raises(ValueError, match=rf"t\.npz.*{message}"):
        TextVectors(tmp_path / "t.npz").text(["a"])


def test_absent_text_vectors():
    with pytest.raises(FileNotFoundError, match=r"nowhere\.npz does not exist; .*--text-vectors"):
        TextVectors(Path("nowhere.npz"))


def test_damage_of_text_vectors_is_noticed(tmp_path):
    file = tmp_path / "texts.npz"
    write_text_vectors(file, {"fox": torch.tensor([3.0, 4.0]), "file": torch.tensor([0.0, 2.0])})
    expected = TextVectors(file).text(["fox", "file"]).tolist()
    assert np.allclose(expected, [[0.6, 0.8], [0, 1]])
    with pytest.raises(FileExistsError):
        write_text_vectors(file, {})
    whole = file.read_bytes()
    for bit in range(0, 8 * len(whole), 5):  # what does not matter to the vectors may change: the date of an entry
        changed = bytearray(whole)
        changed[bit // 8] ^= 1 << bit % 8
        file.write_bytes(changed)
        try:
            assert TextVectors(file).text(["fox", "file"]).tolist() == expected
        except ValueError as error:
            assert "texts.npz is damaged or no NPZ file" in str(error)
    with zipfile.ZipFile(file, "w") as archive, zipfile.ZipFile(io.BytesIO(whole)) as original:
        for name, other in (("fox.npy", "file.npy"), ("file.npy", "fox.npy")):
            archive.writestr(name, original.read(other))
        archive.comment = original.comment
    with pytest.raises(ValueError, match=r"texts\.npz is damaged .*content has 'normlift_ns xxh3_128:\w+', expected"):
        TextVectors(file).text(["fox"])
