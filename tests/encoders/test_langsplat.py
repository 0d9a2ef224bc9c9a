"""LangSplat's files, put together by numpy, so that reading is tested without our writing; and our own."""

import io
import json
import warnings
import zipfile
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch

from normlift_ns.encoders.base import RegionFeatures
from normlift_ns.encoders.build import make_source
from normlift_ns.encoders.color import ColorEncoder
from normlift_ns.encoders.langsplat import LangSplat, write_langsplat
from normlift_ns.encoders.open_clip_network import OpenClipEncoder
from normlift_ns.encoders.text_files import TextEmbeddingFile, write_text_embeddings
from normlift_ns.options import SourceOptions
from normlift_ns.segmentation.regions import Grid, LabelFiles
from tests.encoders.tiny import noise, refused
from tests.examples import FACTOR
from tests.io.test_digests import flipped

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
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"descr": descr, "fortran_order": False, "shape": shape})
    return stream.getvalue() + data


def rows(count: int = T) -> list[list[float]]:
    """Vectors as LangSplat leaves them: of unit length in half precision, stored as float32."""
    drawn = torch.randn(count, D, generator=torch.Generator().manual_seed(0))
    return torch.nn.functional.normalize(drawn, dim=1).half().float().tolist()


def put_table(folder: Path, table: list[list[float]], stem: str = "frame_00001", descr: str = "<f4") -> None:
    np.save(folder / f"{stem}_f.npy", np.array(table, descr).reshape(-1, D))


def put_map(folder: Path, channels: list = CHANNELS, stem: str = "frame_00001", descr: str = "<f4") -> None:
    np.save(folder / f"{stem}_s.npy", np.array(channels).astype(descr))


def put(folder: Path, channels: list = CHANNELS, table: list[list[float]] | None = None, stem="frame_00001") -> None:
    put_map(folder, channels, stem)
    put_table(folder, rows() if table is None else table, stem)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    put(tmp_path)
    return tmp_path


def source(folder: Path, level: str = "l", **options: object) -> LangSplat:
    return LangSplat(folder, ColorEncoder(), level, **options)  # type: ignore[arg-type]


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


LEVELS = dict(zip(("default", "s", "m", "l"), CHANNELS))


def test_a_level_is_its_channel(folder):
    for level, channel in LEVELS.items():
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
    # Opposite vectors cancel
    table = rows()
    table[5] = [-value for value in table[0]]
    put(folder, [DEFAULT, [[X] * 4] * 3, [[X] * 4] * 3, L], table)
    view = source(folder, "sum").view(IMAGE, NAME)
    assert (pixels(view)[:2, :2] == 0).all()
    assert (pixels(view)[:2, 2:3].norm(dim=2) > 0.99).all()


def test_maps_and_tables_of_every_type(folder):
    for descr in ("<f4", "<f8", "<f2", "<i4", "<i8", "<i2", "|i1", ">i4"):
        put_map(folder, descr=descr)
        for level, channel in LEVELS.items():
            assert_close(source(folder, level).view(IMAGE, NAME), expected(channel))
    for descr in ("<f4", "<f8", "<f2"):
        put_table(folder, rows(), descr=descr)
        assert_close(source(folder).view(IMAGE, NAME), expected(L))
    # -1 becomes 255, which is past the table
    put_map(folder, [[[value % 256 for value in row] for row in c] for c in CHANNELS], descr="|u1")
    with pytest.warns(UserWarning, match=r"_s\.npy has ids past .*ids: 255; channels: 0, 1, 2, 3;"):
        assert_close(source(folder).view(IMAGE, NAME), expected(L))
    # Half precision cannot hold ids beyond 2048
    put_table(folder, rows(2100))
    put_map(folder, [[[2050, 3]]], descr="<f2")
    refused(lambda: source(folder).view(noise(1, 2), NAME), "_s.npy", "float16", "2048")
    put_map(folder, [[[2050, 3]]])
    assert source(folder).view(noise(1, 2), NAME).features.shape == (2, D)


def test_rows_of_any_length_are_normalised(folder):
    """As where CLIP vectors were not; those of unit length stay as they are, bit for bit."""
    table = rows()
    table[5] = [10 * value for value in table[5]]
    put_table(folder, table)
    view = source(folder).view(IMAGE, NAME)
    assert_close(view, expected(L), 1e-6 + 5e-4)
    assert torch.equal(view.features[1], torch.tensor(table[6]))
    assert abs(float(view.features[0].double().norm()) - 1) < 1e-6
    # One channel, the same one four times, or a map without channels, serves every level
    put_table(folder, rows())
    for level in (*LEVELS, "sum"):
        for channels in (1, 4):
            put_map(folder, [L] * channels)
            assert_close(source(folder, level).view(IMAGE, NAME), expected(L))
    put_map(folder, L, descr="<i4")
    assert_close(source(folder).view(IMAGE, NAME), expected(L))


def test_the_folder_may_be_doubled(tmp_path):
    for place in (".", "language_features", "language_features/language_features"):
        there = tmp_path / str(len(place)) / place
        there.mkdir(parents=True)
        put(there)
        assert_close(source(tmp_path / str(len(place))).view(IMAGE, NAME), expected(L))


def test_maps_of_another_resolution(folder):
    large = source(folder).view(torch.zeros(2 * HEIGHT, 2 * WIDTH, 3, dtype=torch.uint8), NAME)
    assert_close(large, expected(L).repeat_interleave(2, 0).repeat_interleave(2, 1))
    stretched = torch.zeros(HEIGHT, 2 * WIDTH, 3, dtype=torch.uint8)
    refused(lambda: source(folder).view(stretched, NAME), "_s.npy is 4x3", "8x3")
    assert_close(source(folder, resample=True).view(stretched, NAME), expected(L).repeat_interleave(2, 1))
    # Regions that vanish have no rows
    view = source(folder, "s", resample=True).view(torch.zeros(1, 1, 3, dtype=torch.uint8), NAME)
    assert view.features.shape == (1, D)  # row 3 of the table, at the centre


def test_missing_frames_are_listed_and_refused_or_left_out(folder):
    names = [NAME, "images/frame_00002.jpg", "images/frame_00003.jpg"]
    put_map(folder, stem="frame_00003")  # without its table
    parts = ("2 of 3", "images/frame_00002.jpg, images/frame_00003.jpg", "--features-missing skip")
    refused(lambda: source(folder).available(names), *parts, error=FileNotFoundError)
    lenient = source(folder, missing="skip")
    with pytest.warns(UserWarning, match=r"2 of 3 .*images/frame_00002\.jpg, images/frame_00003\.jpg"):
        assert lenient.available(names) == [NAME]
    refused(lambda: lenient.available(names[1:2]), "1 of 1", "--features-dir", error=FileNotFoundError)
    refused(lambda: source(folder).view(IMAGE, names[1]), "frame_00002.jpg", error=FileNotFoundError)


def test_names_end_at_the_first_dot_or_the_last(folder):
    put(folder, [S], stem="a")
    assert_close(source(folder).view(IMAGE, "a.left.jpg"), expected(S))
    put(folder, [M], stem="a.left")
    assert_close(source(folder).view(IMAGE, "a.left.jpg"), expected(M))
    names = ["x/a.right.png", "a.jpg"]
    refused(lambda: source(folder).available(names), *names, "a_s.npy")
    # Paths in names lead nowhere else
    (folder / "inner").mkdir()
    put(folder / "inner", stem="b")
    for name in ("inner/b.jpg", "../inner/b.jpg", str(folder / "inner" / "b.jpg"), "..", ""):
        refused(lambda name=name: source(folder).available([name]), "1 of 1", error=FileNotFoundError)


def test_what_names_no_row_counts_as_unlabelled(folder):
    """Ids past the table, garbage in place of ids, rows that are zero or not finite."""
    put_table(folder, rows()[:6])
    with pytest.warns(UserWarning, match=r"_s\.npy has ids past .*ids: 6; channels: 3; pixels: 4"):
        view = source(folder).view(IMAGE, NAME)
    assert_close(view, expected([[5, 5, X, X], [5, 5, X, X], [5, 5, X, X]]))
    put_table(folder, rows())
    for garbage in (float("nan"), float("inf"), -7.0):
        put_map(folder, [DEFAULT, S, M, [[garbage, 5, 6, 6], *L[1:]]])
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            assert_close(source(folder).view(IMAGE, NAME), expected([[X, 5, 6, 6], *L[1:]]))
        assert len(told) == (garbage != -7)
        assert all(f"(ids: {garbage}; channels: 3; pixels: 1)" in str(one.message) for one in told)
    put_map(folder)
    for wrong in (float("nan"), float("inf"), 0.0):
        table = rows()
        table[5] = [wrong] * D if wrong == 0 else [*table[5][:-1], wrong]
        put_table(folder, table)
        with pytest.warns(UserWarning, match=r"_f\.npy has rows .*: 5;"):
            view = source(folder).view(IMAGE, NAME)
        assert_close(view, expected([[X, X, 6, 6], [X, X, 6, 6], [X] * 4]))
        with pytest.warns(UserWarning, match=": 5;"):
            view = source(folder, "sum").view(IMAGE, NAME)
        without = [[[X if value == 5 else value for value in row] for row in channel] for channel in CHANNELS]
        assert_close(view, torch.nn.functional.normalize(sum(expected(channel) for channel in without), dim=2))
    # An image without any mask
    put(folder, [[[X] * WIDTH] * HEIGHT] * 4, [])
    for level in ("l", "sum"):
        view = source(folder, level).view(IMAGE, NAME)
        assert view.features.shape == (0, D) and (view.labels == -1).all()


def test_broken_files_are_named_before_the_lift(folder, tmp_path):
    for suffix, content, parts in (
        ("s", npy("<f4", (4, 3, 4), b"\0" * 188), ["NPY"]),
        ("s", npy("|O", (4,), b"\x80\x04N."), ["NPY", "objects"]),
        ("s", b"", ["NPY"]),
        ("s", npy("<f4", (3, 1, 1), b"\0" * 12), ["float32 (3, 1, 1)", "[4, H, W]"]),
        ("s", npy("<f4", (4, 0, 1), b""), ["float32 (4, 0, 1)"]),
        ("f", npy("<f4", (7, 3), b"\0" * 84), ["float32 (7, 3)", "language_features_dim3"]),
        ("f", npy("<i4", (7, D), b"\0" * 28 * D), ["int32 (7, 512)"]),
    ):
        put_map(folder)
        (folder / f"frame_00001_{suffix}.npy").write_bytes(content)
        what = {"s": "segment map", "f": "feature table"}[suffix]
        refused(lambda: source(folder).available([NAME]), what, f"frame_00001_{suffix}.npy", *parts)
    put(folder, [DEFAULT, S, M, [L[0], [5, 5.5, 6, 6], L[2]]])
    refused(lambda: source(folder).view(IMAGE, NAME), "_s.npy: channel 3, row 1, column 1", "5.5")
    put_map(folder)
    put_map(folder, stem="b")
    (folder / "b_f.npy").write_bytes(npy("<f4", (1, 768), b"\0" * 4 * 768))
    parts = ("frame_00001_f.npy", "512", "b_f.npy have 768")  # of two encoders
    refused(lambda: source(folder).available([NAME, "b.jpg"]), *parts)
    options = {"features": "langsplat", "features_dir": folder}
    refused(lambda: make_source(SourceOptions(**options, level="xl")), "--level", "s, m, l, default, sum", "'xl'")
    refused(lambda: SourceOptions(**options, features_missing="maybe"), "features_missing", "error, skip", "'maybe'")
    refused(lambda: source(tmp_path / "nowhere"), "--features-dir", "*_s.npy", error=FileNotFoundError)


def test_flags_make_the_source(folder):
    options = {"features": "langsplat", "features_dir": folder}
    assert make_source(SourceOptions(**options)) == LangSplat(folder, OpenClipEncoder())
    found = make_source(SourceOptions(**options, level="sum", features_missing="skip", regions_resample=True))
    assert found == LangSplat(folder, OpenClipEncoder(), "sum", "skip", resample=True)
    assert json.loads(json.dumps(found.identity)) == found.identity
    np.savez(folder / "texts.npz", cup=np.ones(D))
    found = make_source(SourceOptions(**options, text_embeddings=folder / "texts.npz"))
    assert torch.allclose(found.text(["cup"]), torch.full((1, D), D**-0.5))
    for given, parts in (
        ({**options, "regions": "grid"}, ["--regions cannot", "--features langsplat"]),
        ({**options, "regions_dir": folder}, ["--regions-dir cannot"]),
        ({**options, "encoder": "color"}, ["--encoder color", "--encoder-model"]),
        ({"encoder": "color", "text_embeddings": folder / "texts.npz"}, ["--text-embeddings", "--features langsplat"]),
    ):
        refused(lambda given=given: make_source(SourceOptions(**given)), *parts)


PHOTO = noise(30, 40)


def labels_4(folder: Path, levels: int = 4) -> RegionFeatures:
    rng = np.random.default_rng(0)
    maps = rng.integers(0, 5, (levels, 6, 8)).repeat(5, axis=1).repeat(5, axis=2)
    np.save(folder / "a.npy", maps)
    return RegionFeatures(LabelFiles(folder, level=1), ColorEncoder())


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
        expected_view = RegionFeatures(regions, ColorEncoder()).view(PHOTO, "images/a.jpg")
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


def test_existing_files_stay_unless_asked(tmp_path):
    ours = RegionFeatures(Grid(4), ColorEncoder())
    for _ in range(2):  # the same content: as where an interrupted lift goes on
        write_langsplat(ours, PHOTO, "a.jpg", tmp_path, overwrite=False)
    other = RegionFeatures(Grid(9), ColorEncoder())
    write = partial(write_langsplat, other, PHOTO, "a.jpg", tmp_path)
    refused(lambda: write(overwrite=False), "a_s.npy", "overwrite=True", error=FileExistsError)
    write(overwrite=True)
    assert len(np.load(tmp_path / "a_f.npy")) > 4
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a_f.npy", "a_s.npy"]
    both = type("Both", (LabelFiles,), {"chosen": (0, 1)})(labels_4(tmp_path, 2).regions.folder)
    several = RegionFeatures(both, ColorEncoder())  # at once, which have no place in the format
    refused(lambda: write_langsplat(several, PHOTO, "a.jpg", tmp_path, overwrite=False), "several selected levels")


def test_damage_of_text_vectors_is_noticed(tmp_path):
    file = tmp_path / "texts.npz"
    write_text_embeddings(file, {"fox": torch.tensor([3.0, 4.0]), "file": torch.tensor([0.0, -2.0])})
    expected = TextEmbeddingFile(file).text(["fox", "file"]).tolist()
    assert np.allclose(expected, [[0.6, 0.8], [0, -1]])
    assert TextEmbeddingFile(file).texts == ("fox", "file")
    refused(lambda: TextEmbeddingFile(file).text(["fxo"]), "'fxo'", "texts.npz", "fox")
    refused(lambda: TextEmbeddingFile(file).text([]))
    with pytest.raises(FileExistsError):
        write_text_embeddings(file, {})
    whole = file.read_bytes()
    # What is no vector may change, such as the date of an entry
    for bit in range(0, 8 * len(whole), max(1, 41 // FACTOR)):
        file.write_bytes(flipped(whole, bit))
        try:
            assert TextEmbeddingFile(file).text(["fox", "file"]).tolist() == expected
        except ValueError as error:
            assert "texts.npz is damaged or cannot be read as an NPZ file" in str(error)
    with zipfile.ZipFile(file, "w") as archive, zipfile.ZipFile(io.BytesIO(whole)) as original:
        for name, other in (("fox.npy", "file.npy"), ("file.npy", "fox.npy")):
            archive.writestr(name, original.read(other))
        archive.comment = original.comment
    with pytest.raises(ValueError, match=r"texts\.npz is damaged .*digest is 'normlift_ns xxh3_128:\w+', expected"):
        TextEmbeddingFile(file).text(["fox"])
