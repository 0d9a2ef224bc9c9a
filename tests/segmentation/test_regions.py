"""Superpixels, grid and label files."""

import os
import struct
import zlib
from typing import Any, cast

import numpy as np
import torch
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from scipy import ndimage
from skimage.color import rgb2lab

from normlift_ns.segmentation import regions
from normlift_ns.segmentation.regions import COMPACTNESS, Grid, LabelFiles, Superpixels, read_image
from tests.encoders.tiny import noise, refused


def assert_compact(labels: torch.Tensor) -> None:
    assert labels.dtype == torch.int32
    present = labels[labels >= 0].unique()
    assert present.tolist() == list(range(len(present)))


@given(st.integers(1, 90), st.integers(1, 90), st.integers(1, 400))
def test_grid_cells_are_squares_of_one_size(height, width, count):
    labels = Grid(count).labels(torch.zeros(height, width, 3, dtype=torch.uint8), "")[0, 0]
    assert_compact(labels)
    side = max(1, round((height * width / count) ** 0.5))
    assert (labels == labels[0, 0]).sum() == min(side, height) * min(side, width)
    assert int(labels.max()) + 1 == -(-height // side) * -(-width // side)
    assert Grid(2).labels(torch.zeros(2, 3, 3, dtype=torch.uint8), "").tolist() == [[[[0, 0, 1]] * 2]]


def test_superpixels_are_the_nearest_centers_of_a_loop_in_float64():
    height, width, side = 46, 61, (46 * 61 / 24) ** 0.5
    image = np.array(Image.fromarray(noise(6, 7).numpy()).resize((width, height), Image.Resampling.BICUBIC))
    y, x = np.mgrid[:height, :width]
    rows, columns = round(height / side), round(width / side)
    (row, v), (column, u) = divmod(y, -(-height // rows)), divmod(x, -(-width // columns))
    points = np.dstack([rgb2lab(image) / COMPACTNESS, y / side, x / side])
    labels, sampled = row * columns + column, (u % 2 == 0) & (v % 2 == 0)
    for _ in range(6):
        centers = np.full((rows * columns, 5), np.inf)
        for cell in np.unique(labels[sampled]):
            centers[cell] = points[sampled & (labels == cell)].mean(axis=0)
        distance = np.square(points[:, :, None] - centers).sum(axis=3)
        cells = np.arange(rows * columns)
        far = np.maximum(abs(cells // columns - row[..., None]), abs(cells % columns - column[..., None])) > 1
        labels = np.where(far, np.inf, distance).argmin(axis=2)
    expected = regions._join_fragments(labels.astype(np.int32), 0.25 * side**2)
    assert (regions.superpixels(torch.from_numpy(image), 24) == expected).mean() > 0.998  # ties are broken by rounding


def test_superpixels_keep_to_edges_also_of_tiny_images():
    image = torch.full((60, 81, 3), 40, dtype=torch.uint8)
    image[:, 37:] = 215
    labels = Superpixels(30).labels(image, "")[0, 0]
    assert_compact(labels)
    assert set(labels[:, :37].unique().tolist()).isdisjoint(labels[:, 37:].unique().tolist())
    assert 20 <= int(labels.max()) + 1 <= 45
    for size in ((1, 1), (1, 40), (40, 1), (7, 5), (33, 64)):
        for image in (torch.full((*size, 3), 9, dtype=torch.uint8), noise(*size)):
            labels = Superpixels(256).labels(image, "")[0, 0]
            assert labels.shape == size
            assert_compact(labels)
            assert int(labels.min()) == 0
    # Connected and of similar size, also in noise
    image = noise(97, 130) // 16
    image[:, 60:] += 200
    labels = Superpixels(40).labels(image, "")[0, 0]
    assert torch.equal(labels, Superpixels(40).labels(image, "")[0, 0])
    for region in range(int(labels.max()) + 1):
        _, pieces = cast(tuple[Any, int], ndimage.label(labels == region))
        assert pieces == 1
    size = labels.flatten().bincount()
    assert 30 <= len(size) <= 60
    assert size.min() >= 0.25 * 97 * 130 / 40


MAP = np.array([[0, 7, 7], [3, 0, 200]])
IMAGE = torch.zeros(2, 3, 3, dtype=torch.uint8)
COMPACT = [[-1, 1, 1], [0, -1, 2]]


def test_label_files_of_every_integer_type(tmp_path):
    palette = Image.fromarray(MAP.astype(np.uint8), mode="P")
    palette.putpalette(np.random.default_rng(0).integers(0, 256, 768).astype(np.uint8).tobytes())
    pictures = [palette, Image.fromarray(MAP.astype(np.uint8)), Image.fromarray(MAP.astype(np.uint16))]
    arrays = [MAP.astype(kind) for kind in ("u1", "u8", "i4", ">i8")]
    arrays += [np.asfortranarray(MAP), (MAP - 1000 * (MAP == 0)).astype(np.int16)]  # -1000 for none
    for content in (*pictures, *arrays):
        path = tmp_path / ("a.npy" if isinstance(content, np.ndarray) else "a.png")
        np.save(path, content) if isinstance(content, np.ndarray) else content.save(path)
        labels = LabelFiles(tmp_path).labels(IMAGE, "images/a.jpg")[0, 0]
        assert labels.dtype == torch.int32
        assert labels.tolist() == COMPACT, content
        path.unlink()
    Image.fromarray(MAP == 7).save(tmp_path / "a.png")  # of one bit: one region
    assert LabelFiles(tmp_path).labels(IMAGE, "a.jpg")[0, 0].tolist() == [[-1, 0, 0], [-1, -1, -1]]
    Image.fromarray(np.array([[256, 512, 65535]], dtype=np.uint16)).save(tmp_path / "a.png")
    assert LabelFiles(tmp_path).labels(torch.zeros(1, 3, 3), "a.jpg")[0, 0].tolist() == [[0, 1, 2]]


def grey_png(width: int, height: int, bits: int, rows: bytes) -> bytes:
    head = struct.pack(">IIBBBBB", width, height, bits, 0, 0, 0, 0)
    parts = [(b"IHDR", head), (b"IDAT", zlib.compress(rows)), (b"IEND", b"")]
    chunks = [
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data)) for kind, data in parts
    ]
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks)


def test_grey_of_few_bits_is_refused(tmp_path):
    """Readers multiply its values: 1 of 4 bits becomes 17."""
    rows = np.array([[0, 1, 2], [3, 0, 1]], np.uint8)
    for bits in (2, 4):
        packed = [b"\0" + np.packbits(np.unpackbits(row[:, None], axis=1)[:, -bits:].ravel()).tobytes() for row in rows]
        (tmp_path / "a.png").write_bytes(grey_png(3, 2, bits, b"".join(packed)))
        assert np.array(Image.open(tmp_path / "a.png")).max() == 3 * 255 // (2**bits - 1)
        refused(lambda: LabelFiles(tmp_path).labels(IMAGE, "a.jpg"), "a.png", f"{bits} bits")


def test_what_is_no_file_makes_nobody_wait(tmp_path):
    for name in ("a.png", "a.npy"):
        path = tmp_path / name
        for make in (os.mkfifo, os.mkdir, lambda path: path.symlink_to("nowhere")):
            make(path)
            refused(lambda: LabelFiles(tmp_path).files("a.jpg"), f"{path} is not a file", "PNG or NPY")
            path.rmdir() if path.is_dir() else path.unlink()
        with path.open("wb") as file:
            file.truncate(2**32)
        refused(lambda: LabelFiles(tmp_path).files("a.jpg"), name, "4,294,967,296", "2,147,483,648")
        path.unlink()


def test_the_background_is_a_choice(tmp_path):
    np.save(tmp_path / "a.npy", np.array([[-1, 0, 255]]))
    image = torch.zeros(1, 3, 3)
    assert LabelFiles(tmp_path).labels(image, "a.jpg")[0, 0].tolist() == [[-1, -1, 0]]
    assert LabelFiles(tmp_path, background=-1).labels(image, "a.jpg")[0, 0].tolist() == [[-1, 0, 1]]
    assert LabelFiles(tmp_path, background=255).labels(image, "a.jpg")[0, 0].tolist() == [[-1, 0, -1]]


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
    refused(lambda: LabelFiles(tmp_path).labels(image, "a.jpg"), "a.npy", "4x3", "a.jpg is 5x6", "--regions-resample")
    labels = LabelFiles(tmp_path, resample=True).labels(image, "a.jpg")[0, 0]
    # Centres (x + .5) * 4 / 5 = .4, 1.2, 2, 2.8, 3.6 and (y + .5) / 2 = .25, .75, 1.25, ...
    assert labels[0].tolist() == [0, 1, 2, 2, 3]
    assert labels[:, 0].tolist() == [0, 0, 4, 4, 8, 8]
    shrunk = LabelFiles(tmp_path, resample=True).labels(torch.zeros(1, 2, 3), "a.jpg")[0, 0]
    assert shrunk.tolist() == [[0, 1]]  # values 6 and 8, compacted


def header(text: str) -> bytes:
    return b"\x93NUMPY\x02\x00" + struct.pack("<I", len(text)) + text.encode() + bytes(64)


def test_wrong_label_files_say_what_is_wrong(tmp_path):
    for content, parts in (
        (MAP / 2, ["float64"]),
        (np.array([{}]), ["NPY"]),
        (np.arange(3), ["(3,)", "[H, W]", "[levels, H, W]"]),
        (np.zeros((0, 2, 3), int), ["(0, 2, 3)"]),
        (b"\x93NUMPY\x01\x00", ["NPY"]),
        *((header(text), ["NPY"]) for text in ("(" * 3000, "'" * 99, "-" * 4000 + "1", "\\N{x}", "a" * 70000)),
    ):
        if isinstance(content, bytes):
            (tmp_path / "a.npy").write_bytes(content)
        else:
            np.save(tmp_path / "a.npy", content)
        refused(lambda: LabelFiles(tmp_path).labels(IMAGE, "images/a.jpg"), "a.npy", *parts)
    (tmp_path / "a.npy").unlink()
    Image.fromarray(np.zeros((2, 3, 3), np.uint8)).save(tmp_path / "a.png")
    refused(lambda: LabelFiles(tmp_path).labels(IMAGE, "images/a.jpg"), "a.png", "3 channels")
    (tmp_path / "a.png").write_bytes(b"no picture")
    refused(lambda: LabelFiles(tmp_path).labels(IMAGE, "images/a.jpg"), "a.png", "as an image")
    refused(lambda: LabelFiles(tmp_path / "nowhere"), "nowhere", "--regions-dir", error=FileNotFoundError)
    (tmp_path / "a.txt").touch()
    refused(lambda: LabelFiles(tmp_path / "a.txt"), "a.txt is not a folder", "--regions-dir", error=FileNotFoundError)
    parts = ("images/b.jpg", "b.png or b.npy")
    refused(lambda: LabelFiles(tmp_path).labels(IMAGE, "images/b.jpg"), *parts, error=FileNotFoundError)
    np.save(tmp_path / "a.npy", MAP)
    Image.fromarray(MAP.astype(np.uint8)).save(tmp_path / "a.png")
    refused(lambda: LabelFiles(tmp_path).labels(IMAGE, "a.jpg"), "a.png", "a.npy", "keep one")


def test_images_are_read_as_rgb_and_named_where_that_fails(tmp_path):
    pixels = Image.fromarray(noise(40, 50).numpy())
    for mode in ("RGB", "RGBA"):
        pixels.convert(mode).save(tmp_path / "a.png")
        assert torch.equal(read_image(tmp_path / "a.png"), noise(40, 50))
    refused(lambda: read_image(tmp_path / "none.jpg"), "none.jpg does not exist", error=FileNotFoundError)
    pixels.save(tmp_path / "a.jpg")
    (tmp_path / "a.jpg").write_bytes((tmp_path / "a.jpg").read_bytes()[:-400])
    refused(lambda: read_image(tmp_path / "a.jpg"), "a.jpg", "truncated")
