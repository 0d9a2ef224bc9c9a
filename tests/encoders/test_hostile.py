"""Files that are damaged, absurd or no files: only our own errors leave the loaders."""

import io
import itertools
import zipfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from normlift_ns.encoders.color import ColorEncoder
from normlift_ns.encoders.langsplat import LangSplat
from normlift_ns.encoders.text_files import TextEmbeddingFile
from normlift_ns.segmentation.regions import LabelFiles, read_image
from tests.encoders.tiny import noise, refused
from tests.hostile import damaged, fuzz, no_files, survives
from tests.random_scenes import unit_rows
from tests.segmentation.test_regions import grey_png

IMAGE = noise(6, 8)
NAME = "images/a.png"
MAP = np.arange(48).reshape(6, 8) // 7


def stored(write: Callable[..., object], *content: object, **more: object) -> bytes:
    """What a function writes to a file."""
    buffer = io.BytesIO()
    write(buffer, *content, **more)
    return buffer.getvalue()


def npy(array: np.ndarray) -> bytes:
    return stored(np.save, array)


def npz(**arrays: np.ndarray) -> bytes:
    return stored(np.savez_compressed, **arrays)


def read_map(path: Path) -> None:
    for resample in (False, True):
        LabelFiles(path.parent, resample=resample).labels(IMAGE, NAME)
    LabelFiles(path.parent).size(NAME)


def read_features(path: Path) -> None:
    source = LangSplat(path.parent, ColorEncoder(), "l", resample=True)
    source.available([NAME])
    source.size(NAME)
    source.view(IMAGE, NAME)


def write_features(path: Path) -> None:
    np.save(path.with_name("a_s.npy"), np.stack([MAP] * 4).astype("f4"))
    np.save(path.with_name("a_f.npy"), unit_rows(7, 20, 0).float().numpy())


LOADERS: list[tuple[str, Callable[[Path], object], Callable[[Path], object]]] = [
    ("a.npy", lambda path: np.save(path, MAP), read_map),
    ("a.png", lambda path: Image.fromarray((300 * MAP).astype(np.uint16)).save(path), read_map),
    ("a_s.npy", write_features, read_features),
    ("a_f.npy", write_features, read_features),
    ("t.npz", lambda path: np.savez(path, fox=np.arange(4.0)), lambda path: TextEmbeddingFile(path).text(["fox"])),
    ("p.jpg", lambda path: Image.fromarray(IMAGE.numpy()).save(path, "png"), read_image),
]
"""Names of files, what writes whole ones, and what reads them."""


def test_damaged_files_and_what_is_none_raise_our_errors_only(tmp_path: Path) -> None:
    for number, (name, write, read) in enumerate(LOADERS):
        path = tmp_path / str(number) / name
        path.parent.mkdir()
        write(path)
        load = partial(read, path)
        load()
        fuzz(15, damaged(path.read_bytes()), path, load)
        path.unlink()
        for _ in no_files(path):
            refused(load, str(path.parent), error=Exception)
            survives(load)


def test_bombs_programs_and_lossy_pictures_are_refused_by_name(tmp_path: Path) -> None:
    """Pictures of few bytes have any size; and Pillow gives PostScript to Ghostscript, whatever the file is called."""
    path = tmp_path / "a.png"
    for side in (12_000, 20_000, 2**31 - 1):
        path.write_bytes(grey_png(side, side, 8, bytes(2**20)))
        refused(lambda: LabelFiles(tmp_path, resample=True).labels(IMAGE, NAME), str(path), "too large")
    path.write_bytes(b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 8 6\n%%EndComments\nshowpage\n")
    refused(lambda: read_image(path), str(path), "cannot be read as an image")
    refused(lambda: LabelFiles(tmp_path).labels(IMAGE, NAME), "label map", str(path), "cannot be read as an image")
    Image.fromarray(MAP.astype(np.uint8)).save(path, "jpeg")
    refused(lambda: LabelFiles(tmp_path).labels(IMAGE, NAME), "label map", str(path), "PNG")


def test_values_beyond_32_bits_and_odd_backgrounds(tmp_path: Path) -> None:
    dtypes = (np.int64, np.uint64, np.int16, np.uint8, bool)
    for dtype, background in itertools.product(dtypes, (0, -1, 254, 10**12, -(10**40))):
        high = 1 if dtype is bool else np.iinfo(dtype).max
        np.save(tmp_path / "a.npy", np.array([[0, high, high], [0, 0, 1]], dtype))
        found = LabelFiles(tmp_path, background).labels(noise(2, 3), NAME)[0, 0]
        assert (found[0, 1] == found[0, 2]) and (found[0, 0] == -1) == (background == 0), (dtype, background)
        assert (found[1, 2] == found[0, 1]) == (high == 1), (dtype, background)


def entry(name: str, content: bytes, *more: bytes) -> bytes:
    """An archive with such a member, or several of that name."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for one in (content, *more):
            archive.writestr(f"{name}.npy", one)
    return buffer.getvalue()


@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_entries_of_text_vectors_are_checked_before_they_are_read(tmp_path: Path) -> None:
    ones = npy(np.ones(4))
    for content, parts in (
        (entry("fox", npy(np.ones(150_000))), ["'fox'", "1,200,128", "1,048,576"]),
        (entry("fox", b"no array"), ["'fox'", "NPY"]),
        (entry("fox", ones[:-3]), ["'fox'", "float64 needs 32 bytes", "29"]),
        (entry("fox", ones, npy(np.arange(4.0))), ["two vectors for 'fox'"]),
        (npz(fox=np.ones(4, np.longdouble)), ["'fox'", np.dtype(np.longdouble).name]),
        (npz(fox=np.ones((2, 4))), ["'fox'", "float64", "(2, 4)"]),
        (npz(fox=np.ones(4, int)), ["'fox'", "int64", "(4,)"]),
        (npz(fox=np.zeros(4)), ["'fox'", "zero or not finite"]),
        (npz(fox=np.array([1, np.nan])), ["'fox'", "zero or not finite"]),
        (npz(fox=np.array([{}], dtype=object)), ["'fox'", "objects"]),
        (npz(fox=np.ones(4), mug=np.ones(5)), ["different lengths (4, 5)"]),
        (b"PK no archive", ["NPZ"]),
    ):
        (tmp_path / "t.npz").write_bytes(content)
        refused(lambda: TextEmbeddingFile(tmp_path / "t.npz").text(["fox"]), "t.npz", *parts)
    refused(lambda: TextEmbeddingFile(Path("nowhere.npz")), "nowhere.npz", "--text-embeddings", error=FileNotFoundError)
