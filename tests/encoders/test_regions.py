"""Superpixels, grid and label files."""

import os
import struct
import zlib

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from PIL import Image

from normlift_ns.encoders import read_image
from normlift_ns.encoders.regions import Grid, LabelFiles, Superpixels


def noise(height: int, width: int) -> torch.Tensor:
    return torch.randint(0, 256, (height, width, 3), generator=torch.Generator().manual_seed(1), dtype=torch.uint8)


def assert_compact(labels: torch.Tensor) -> None:
    assert labels.dtype == torch.int32
    present = labels[labels >= 0].unique()
    assert present.tolist() == list(range(len(present)))


@settings(max_examples=50, deadline=None)
@given(st.integers(1, 90), st.integers(1, 90), st.integers(1, 400))
def test_grid_cells_are_squares_of_one_size(height, width, count):
    labels = Grid(count).labels(torch.zeros(height, width, 3, dtype=torch.uint8), "")[0, 0]
    assert_compact(labels)
    side = max(1, round((height * width / count) ** 0.5))
    assert (labels == labels[0, 0]).sum() == min(side, height) * min(side, width)
    assert int(labels.max()) + 1 == -(-height // side) * -(-width // side)


def test_grid_by_hand():
    labels = Grid(6).labels(torch.zeros(4, 5, 3, dtype=torch.uint8), "")[0, 0]
    assert labels.tolist() == [[0, 0, 1, 1, 2], [0, 0, 1, 1, 2], [3, 3, 4, 4, 5], [3, 3, 4, 4, 5]]


def test_superpixels_keep_to_edges():
    image = torch.full((60, 81, 3), 40, dtype=torch.uint8)
    image[:, 37:] = 215
    labels = Superpixels(30).labels(image, "")[0, 0]
    assert_compact(labels)
    assert set(labels[:, :37].unique().tolist()).isdisjoint(labels[:, 37:].unique().tolist())
    assert 20 <= int(labels.max()) + 1 <= 45


@pytest.mark.parametrize("size", [(1, 1), (1, 40), (40, 1), (7, 5), (33, 64)])
@pytest.mark.parametrize("flat", [True, False])
def test_superpixels_of_tiny_images(size, flat):
    image = torch.full((*size, 3), 9, dtype=torch.uint8) if flat else noise(*size)
    labels = Superpixels(256).labels(image, "")[0, 0]
    assert labels.shape == size
    assert_compact(labels)
    assert int(labels.min()) == 0


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Grid(0), "at least 1, got 0"),
        (lambda: Superpixels(-3), "at least 1, got -3"),
        (lambda: Superpixels(3, compactness=0), "must be positive, got 0"),
    ],
)
def test_impossible_settings_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


MAP = np.array([[0, 7, 7], [3, 0, 200]])
IMAGE = torch.zeros(2, 3, 3, dtype=torch.uint8)
COMPACT = [[-1, 1, 1], [0, -1, 2]]


def palette_png(path):
    picture = Image.fromarray(MAP.astype(np.uint8), mode="P")
    picture.putpalette(np.random.default_rng(0).integers(0, 256, 768).astype(np.uint8).tobytes())
    picture.save(path)


@pytest.mark.parametrize(
    ("file", "write"),
    [
        ("a.png", lambda path: Image.fromarray(MAP.astype(np.uint8)).save(path)),
        ("a.png", lambda path: Image.fromarray(MAP.astype(np.uint16)).save(path)),
        ("a.png", palette_png),
        ("a.npy", lambda path: np.save(path, MAP.astype(np.uint8))),
        ("a.npy", lambda path: np.save(path, MAP.astype(np.uint64))),
        ("a.npy", lambda path: np.save(path, MAP.astype(np.int32))),
        ("a.npy", lambda path: np.save(path, MAP.astype(">i8"))),
        ("a.npy", lambda path: np.save(path, np.asfortranarray(MAP))),
        ("a.npy", lambda path: np.save(path, (MAP - 1000 * (MAP == 0)).astype(np.int16))),  # -1000 for none
    ],
)
def test_label_files_of_every_integer_type(tmp_path, file, write):
    write(tmp_path / file)
    labels = LabelFiles(tmp_path).labels(IMAGE, "images/a.jpg")[0, 0]
    assert labels.dtype == torch.int32
    assert labels.tolist() == COMPACT


@pytest.mark.parametrize("bits", [2, 4])
def test_grey_of_few_bits_is_refused(tmp_path, bits):
    """Readers multiply its values: 1 of 4 bits becomes 17."""
    rows = np.array([[0, 1, 2], [3, 0, 1]], np.uint8)
    packed = [b"\0" + np.packbits(np.unpackbits(row[:, None], axis=1)[:, -bits:].ravel()).tobytes() for row in rows]
    head = struct.pack(">IIBBBBB", 3, 2, bits, 0, 0, 0, 0)
    parts = [(b"IHDR", head), (b"IDAT", zlib.compress(b"".join(packed))), (b"IEND", b"")]
    chunks = [
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data)) for kind, data in parts
    ]
    (tmp_path / "a.png").write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(chunks))
    assert np.array(Image.open(tmp_path / "a.png")).max() == 3 * 255 // (2**bits - 1)
    with pytest.raises(ValueError, match=rf"a\.png is a grey PNG of {bits} bits, whose values readers multiply"):
        LabelFiles(tmp_path).labels(IMAGE, "a.jpg")


@pytest.mark.parametrize("suffix", ["png", "npy"])
def test_what_is_no_file_makes_nobody_wait(tmp_path, suffix):
    path = tmp_path / f"a.{suffix}"
    for make in (lambda: os.mkfifo(path), path.mkdir, lambda: path.symlink_to(tmp_path / "nowhere")):
        make()
        with pytest.raises(ValueError, match=rf"label map .*a\.{suffix} is no file; expected a PNG or NPY file"):
            LabelFiles(tmp_path).files("a.jpg")
        path.rmdir() if path.is_dir() else path.unlink()
    with path.open("wb") as file:
        file.truncate(2**32)
    with pytest.raises(ValueError, match="has 4,294,967,296 bytes, expected 2,147,483,648 at most"):
        LabelFiles(tmp_path).files("a.jpg")


def test_large_16_bit_ids_stay_apart(tmp_path):
    Image.fromarray(np.array([[256, 512, 65535]], dtype=np.uint16)).save(tmp_path / "a.png")
    assert LabelFiles(tmp_path).labels(torch.zeros(1, 3, 3), "a.jpg")[0, 0].tolist() == [[0, 1, 2]]


def test_1_bit_masks_are_one_region(tmp_path):
    Image.fromarray(MAP == 7).save(tmp_path / "a.png")
    assert LabelFiles(tmp_path).labels(IMAGE, "a.jpg")[0, 0].tolist() == [[-1, 0, 0], [-1, -1, -1]]


def test_the_background_is_a_choice(tmp_path):
    np.save(tmp_path / "a.npy", np.array([[-1, 0, 255]]))
    image = torch.zeros(1, 3, 3)
    assert LabelFiles(tmp_path).labels(image, "a.jpg")[0, 0].tolist() == [[-1, -1, 0]]
    assert LabelFiles(tmp_path, background=-1).labels(image, "a.jpg")[0, 0].tolist() == [[-1, 0, 1]]
    assert LabelFiles(tmp_path, background=255).labels(image, "a.jpg")[0, 0].tolist() == [[-1, 0, -1]]


@settings(max_examples=50, deadline=None)
@given(arrays(np.int16, st.tuples(st.integers(1, 6), st.integers(1, 6)), elements=st.integers(-3, 3)))
def test_labels_are_equal_where_values_are(tmp_path_factory, values):
    folder = tmp_path_factory.mktemp("labels")
    np.save(folder / "a.npy", values)
    labels = LabelFiles(folder).labels(torch.zeros(*values.shape, 3), "a.jpg")[0, 0]
    assert_compact(labels)
    flat, found = values.ravel(), labels.numpy().ravel()
    assert ((found == -1) == (flat <= 0)).all()
    kept = flat > 0
    assert ((found[kept, None] == found[kept]) == (flat[kept, None] == flat[kept])).all()


def test_a_map_without_any_region(tmp_path):
    np.save(tmp_path / "a.npy", np.zeros((2, 3), dtype=int))
    assert LabelFiles(tmp_path).labels(IMAGE, "a.jpg")[0, 0].unique().tolist() == [-1]


def test_levels_of_one_file(tmp_path):
    np.save(tmp_path / "a.npy", np.stack([5 * np.ones_like(MAP), MAP]))
    maps = LabelFiles(tmp_path, level=1).labels(IMAGE, "a.jpg")
    assert maps.tolist() == [[[[0, 0, 0]] * 2], [COMPACT]]
    assert torch.equal(LabelFiles(tmp_path).labels(IMAGE, "a.jpg"), maps)
    assert LabelFiles(tmp_path, level=1).chosen == (1,)
    assert LabelFiles(tmp_path).chosen == ()
    assert LabelFiles(tmp_path).identity == LabelFiles(tmp_path, level=1).identity


def test_the_longest_matching_path_wins(tmp_path):
    for i, folder in enumerate(["", "left", "images/left"], start=1):
        (tmp_path / folder).mkdir(parents=True, exist_ok=True)
        np.save(tmp_path / folder / "0001.v2.npy", np.full((2, 3), i))
    files = LabelFiles(tmp_path)
    assert files.path("images/left/0001.v2.jpg") == tmp_path / "images/left/0001.v2.npy"
    assert files.path("images_2/left/0001.v2.jpg") == tmp_path / "left/0001.v2.npy"
    assert files.path("/elsewhere/right/0001.v2.jpg") == tmp_path / "0001.v2.npy"
    assert files.files("../images/0001.v2.jpg") == (tmp_path / "0001.v2.npy",)


def test_another_size_is_refused_or_resampled_when_asked(tmp_path):
    np.save(tmp_path / "a.npy", np.arange(1, 13).reshape(3, 4))
    image = torch.zeros(6, 5, 3)
    with pytest.raises(ValueError, match=r"a\.npy is 4x3 \(width x height\), its image a\.jpg is 5x6; .*--regions-res"):
        LabelFiles(tmp_path).labels(image, "a.jpg")
    labels = LabelFiles(tmp_path, resample=True).labels(image, "a.jpg")[0, 0]
    # Centres (x + .5) * 4 / 5 = .4, 1.2, 2, 2.8, 3.6 and (y + .5) / 2 = .25, .75, 1.25, ...
    assert labels[0].tolist() == [0, 1, 2, 2, 3]
    assert labels[:, 0].tolist() == [0, 0, 4, 4, 8, 8]
    shrunk = LabelFiles(tmp_path, resample=True).labels(torch.zeros(1, 2, 3), "a.jpg")[0, 0]
    assert shrunk.tolist() == [[0, 1]]  # values 6 and 8, compacted


@pytest.mark.parametrize(
    ("file", "write", "message"),
    [
        ("a.npy", lambda path: np.save(path, MAP / 2), "holds float64; expected an integer type"),
        ("a.npy", lambda path: np.save(path, np.array([["a"]])), "expected an integer type"),
        ("a.npy", lambda path: np.save(path, np.array([{}]), allow_pickle=True), "damaged or no NPY"),
        ("a.npy", lambda path: np.save(path, np.arange(3)), r"has shape \(3,\), expected \[H, W\] or \[levels, H, W\]"),
        ("a.npy", lambda path: np.save(path, np.zeros((0, 2, 3), int)), r"has shape \(0, 2, 3\)"),
        ("a.npy", lambda path: path.write_bytes(b""), "damaged or no NPY"),
        ("a.npy", lambda path: path.write_bytes(b"\x93NUMPY\x01\x00"), "damaged or no NPY"),
        ("a.png", lambda path: Image.fromarray(np.zeros((2, 3, 3), np.uint8)).save(path), "has 3 colour channels"),
        ("a.png", lambda path: path.write_bytes(b"no picture"), "damaged or no picture"),
    ],
)
def test_wrong_label_files_say_what_is_wrong(tmp_path, file, write, message):
    write(tmp_path / file)
    with pytest.raises(ValueError, match=f"{file}.*{message}"):
        LabelFiles(tmp_path).labels(IMAGE, "images/a.jpg")


def test_missing_and_ambiguous_label_files(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"nowhere does not exist \(--regions-dir\)"):
        LabelFiles(tmp_path / "nowhere")
    with pytest.raises(FileNotFoundError, match=r"images/b\.jpg has no label map in .*expected b\.png or b\.npy"):
        LabelFiles(tmp_path).labels(IMAGE, "images/b.jpg")
    np.save(tmp_path / "a.npy", MAP)
    Image.fromarray(MAP.astype(np.uint8)).save(tmp_path / "a.png")
    with pytest.raises(ValueError, match=r"two label maps, .*a\.png and .*a\.npy; keep one"):
        LabelFiles(tmp_path).labels(IMAGE, "a.jpg")


def test_images_are_read_as_rgb(tmp_path):
    pixels = noise(4, 5)
    Image.fromarray(pixels.numpy()).save(tmp_path / "a.png")
    assert torch.equal(read_image(tmp_path / "a.png"), pixels)
    Image.fromarray(pixels.numpy()).convert("RGBA").save(tmp_path / "b.png")
    assert torch.equal(read_image(tmp_path / "b.png"), pixels)


def test_unreadable_images_are_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"none\.jpg does not exist"):
        read_image(tmp_path / "none.jpg")
    Image.fromarray(noise(200, 200).numpy()).save(tmp_path / "a.jpg")
    whole = (tmp_path / "a.jpg").read_bytes()
    (tmp_path / "a.jpg").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match=r"a\.jpg is damaged or no picture \(.*truncated"):
        read_image(tmp_path / "a.jpg")
