"""Files of features, labels and texts that are damaged, absurd or no files: only our own errors leave the loaders."""

from __future__ import annotations

import io
import struct
import time
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import strategies as st
from PIL import Image

from normlift_ns import InputError
from normlift_ns.core.disk.tensors import load_tensors, save_tensors
from normlift_ns.encoders import LangSplat, RegionFeatures, cached, read_image
from normlift_ns.encoders.colour import ColourEncoder
from normlift_ns.encoders.npy import read_npy
from normlift_ns.encoders.regions import Grid, LabelFiles
from normlift_ns.encoders.texts.files import TextVectors, write_text_vectors
from tests.hostile import EXAMPLES, damaged, fuzz, no_files, survives

IMAGE = torch.randint(0, 256, (6, 8, 3), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)
NAME = "images/a.png"
MAP = np.arange(48).reshape(6, 8) // 7


def npy(array: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array)
    return buffer.getvalue()


def png(array: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(array).save(buffer, "png")
    return buffer.getvalue()


def npz(**arrays: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    return buffer.getvalue()


def map_loader(folder: Path) -> Callable[[], object]:
    def load() -> None:
        LabelFiles(folder).labels(IMAGE, NAME)
        LabelFiles(folder, resample=True).labels(IMAGE, NAME)
        LabelFiles(folder).size(NAME)

    return load


def langsplat_loader(folder: Path) -> Callable[[], object]:
    def load() -> None:
        source = LangSplat(folder, ColourEncoder(), "l", resample=True)
        source.available([NAME])
        source.size(NAME)
        source.view(IMAGE, NAME)

    return load


def table() -> np.ndarray:
    return torch.nn.functional.normalize(torch.arange(7.0 * 20).reshape(7, 20) + 1, dim=1).numpy()


LOADERS: dict[str, tuple[str, bytes, Callable[[Path], Callable[[], object]], dict[str, bytes]]] = {
    "label map, NPY": ("a.npy", npy(MAP), map_loader, {}),
    "label map, 8 bits": ("a.png", png(MAP.astype(np.uint8)), map_loader, {}),
    "label map, 16 bits": ("a.png", png((300 * MAP).astype(np.uint16)), map_loader, {}),
    "segment map": (
        "a_s.npy",
        npy(np.stack([MAP] * 4).astype(np.float32)),
        langsplat_loader,
        {"a_f.npy": npy(table())},
    ),
    "feature table": ("a_f.npy", npy(table()), langsplat_loader, {"a_s.npy": npy(np.stack([MAP] * 4))}),
    "text vectors": (
        "t.npz",
        npz(fox=np.arange(4.0), mug=np.ones(4)),
        lambda folder: lambda: TextVectors(folder / "t.npz").text(["fox"]),
        {},
    ),
    "picture": ("p.jpg", png(IMAGE.numpy()), lambda folder: lambda: read_image(folder / "p.jpg"), {}),
}


@pytest.mark.parametrize("examples", EXAMPLES)
@pytest.mark.parametrize("kind", LOADERS)
def test_damaged_files_raise_our_errors_only(kind: str, examples: int, tmp_path: Path) -> None:
    name, whole, loader, others = LOADERS[kind]
    for other, content in others.items():
        (tmp_path / other).write_bytes(content)
    (tmp_path / name).write_bytes(whole)
    loader(tmp_path)()
    fuzz(examples, damaged(whole), tmp_path / name, loader(tmp_path))


@pytest.mark.parametrize("kind", LOADERS)
def test_what_is_no_file_raises_our_errors_only(kind: str, tmp_path: Path) -> None:
    name, _, loader, others = LOADERS[kind]
    for other, content in others.items():
        (tmp_path / other).write_bytes(content)
    for what in no_files(tmp_path / name):
        with pytest.raises((InputError, FileNotFoundError)) as caught:
            loader(tmp_path)()
        assert str(tmp_path) in str(caught.value), what
        survives(loader(tmp_path))


@pytest.mark.parametrize("examples", EXAMPLES)
def test_any_header_of_an_array_raises_our_errors_only(examples: int, tmp_path: Path) -> None:
    """Headers are Python literals: any literal in place of one."""
    described = st.sampled_from(["<f4", "|O", "<i8", "f4,i4", "<U9999999", "V8", "[('a','<f4')]", "(2,)f4", "<f3", "é"])
    lengths = st.integers(-2, 10**15) | st.booleans() | st.floats() | st.just(10**400)
    fields = st.fixed_dictionaries(
        {"descr": described | st.lists(described) | st.none(), "fortran_order": st.booleans() | st.integers()},
        optional={"shape": st.lists(lengths, max_size=40).map(tuple) | st.lists(lengths) | st.integers(), "x": lengths},
    )
    text = fields.map(repr) | st.sampled_from(["(" * 3000, "{" * 90, "'" * 99, "-" * 4000 + "1", "\\N{x}", "a" * 70000])
    header = text.map(lambda t: b"\x93NUMPY\x02\x00" + struct.pack("<I", len(t.encode())) + t.encode() + bytes(64))
    fuzz(examples, header, tmp_path / "a.npy", lambda: read_npy(tmp_path / "a.npy", "map"))


def test_headers_of_absurd_size_allocate_nothing(tmp_path: Path) -> None:
    header = "{'descr': '<f8', 'fortran_order': False, 'shape': (4, 1000000000, 1000000), }".ljust(117) + "\n"
    (tmp_path / "a.npy").write_bytes(b"\x93NUMPY\x01\x00" + struct.pack("<H", 118) + header.encode() + bytes(80))
    with pytest.raises(InputError, match=r"a\.npy .*4 x 1000000000 x 1000000 float64 take 32,000,\S+ bytes, found 80"):
        LabelFiles(tmp_path).labels(IMAGE, NAME)


def bomb_png(side: int) -> bytes:
    """A picture of side x side zeros, nearly without bytes."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    rows = zlib.compress(bytes(2**20))
    head = struct.pack(">IIBBBBB", side, side, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


@pytest.mark.parametrize("side", [12_000, 20_000, 2**31 - 1])
def test_decompression_bombs_are_refused_by_name(side: int, tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(bomb_png(side))
    with pytest.raises(InputError, match=r"label map .*a\.png is damaged or no picture"):
        LabelFiles(tmp_path, resample=True).labels(IMAGE, NAME)


def test_other_programs_are_never_asked_to_draw_a_picture(tmp_path: Path) -> None:
    """Pillow gives PostScript to Ghostscript, whatever the file is called."""
    (tmp_path / "a.png").write_bytes(b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 8 6\n%%EndComments\nshowpage\n")
    for load in (lambda: LabelFiles(tmp_path).labels(IMAGE, NAME), lambda: read_image(tmp_path / "a.png")):
        with pytest.raises(InputError, match=r"a\.png is damaged or no picture"):
            load()


def test_lossy_label_maps_are_refused(tmp_path: Path) -> None:
    Image.fromarray(MAP.astype(np.uint8)).save(tmp_path / "a.png", "jpeg")
    with pytest.raises(InputError, match=r"label map .*a\.png is damaged or no picture .*such as PNG"):
        LabelFiles(tmp_path).labels(IMAGE, NAME)


@pytest.mark.parametrize("dtype", [np.int64, np.uint64, np.int16, np.uint8, bool])
@pytest.mark.parametrize("background", [0, -1, 254, 10**12, -(10**40)])
def test_values_beyond_32_bits_and_odd_backgrounds(dtype: type, background: int, tmp_path: Path) -> None:
    high = 1 if dtype is bool else np.iinfo(dtype).max
    np.save(tmp_path / "a.npy", np.array([[0, high, high], [0, 0, 1]], dtype))
    found = LabelFiles(tmp_path, background).labels(torch.zeros(2, 3, 3, dtype=torch.uint8), NAME)[0, 0]
    assert (found[0, 1] == found[0, 2]) and (found[0, 0] == -1) == (background == 0)
    assert (found[1, 2] == found[0, 1]) == (high == 1)


def entry(name: str, size: int, content: bytes | None = None) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(f"{name}.npy", npy(np.ones(size)) if content is None else content)
    return buffer.getvalue()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (entry("fox", 10**7), "vector of 'fox' takes 80,000,128 bytes, at most 1,048,576"),
        (entry("fox", 4, b"no array"), "vector of 'fox' is none: it does not begin as NPY files"),
        (entry("fox", 4, npy(np.ones(4))[:-3]), "vector of 'fox' is none: 4 float64 take 32 bytes, found 29"),
        (npz(fox=np.ones(4, np.longdouble)), "vector of 'fox' is none: it holds (float128|longdouble)"),
        (npz(fox=np.array("text")), "vector of 'fox' is none: it holds <U4"),
        (npz(fox=np.float64(3)), r"array of 'fox' is float64 \(\)"),
    ],
)
def test_entries_of_text_vectors_are_checked_before_they_are_read(content: bytes, message: str, tmp_path: Path) -> None:
    (tmp_path / "t.npz").write_bytes(content)
    started = time.process_time()
    with pytest.raises(InputError, match=rf"t\.npz.*({message})"):
        TextVectors(tmp_path / "t.npz").text(["fox"])
    assert time.process_time() - started < 1


def test_two_vectors_of_one_text_are_refused(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "t.npz", "w") as archive:
        archive.writestr("fox.npy", npy(np.ones(4)))
        with pytest.warns(UserWarning, match="Duplicate name"):
            archive.writestr("fox.npy", npy(np.arange(4.0)))
    with pytest.raises(InputError, match=r"t\.npz is damaged .*two vectors of 'fox'"):
        TextVectors(tmp_path / "t.npz").text(["fox"])


@pytest.mark.parametrize("length", [1e-320, 1e-40, 1e-13, 1e30, 1e300])
def test_vectors_of_any_length_become_unit_vectors(length: float, tmp_path: Path) -> None:
    np.savez(tmp_path / "t.npz", fox=np.array([0, 3 * length, 4 * length]))
    write_text_vectors(tmp_path / "w.npz", {"fox": torch.tensor([0, 3 * length, 4 * length], dtype=torch.float64)})
    for file in ("t.npz", "w.npz"):
        torch.testing.assert_close(TextVectors(tmp_path / file).text(["fox"]), torch.tensor([[0, 0.6, 0.8]]))


WRONG = {
    "regions": [
        torch.zeros(1, 1, 6, 9, dtype=torch.int16),
        torch.zeros(1, 6, 8, dtype=torch.int16),
        torch.zeros(0, 1, 6, 8, dtype=torch.int32),
        torch.full((1, 1, 6, 8), -2, dtype=torch.int16),
        torch.zeros(1, 1, 6, 8),
        torch.zeros(1, 1, 6, 8, dtype=torch.int64),
    ],
    "features": [
        torch.zeros(12, 3),
        torch.full((12, 3), torch.nan),
        torch.eye(3)[:2],
        torch.eye(3).expand(5, 3, 3).reshape(15, 3),
        torch.ones(12, dtype=torch.float32),
        torch.eye(12).half(),
        torch.zeros(12, 0),
    ],
}


@pytest.mark.parametrize("kind", WRONG)
def test_cache_entries_that_do_not_fit_are_made_again(kind: str, tmp_path: Path) -> None:
    """Whole, with a digest and the right key."""
    source = cached(RegionFeatures(Grid(12), ColourEncoder()), tmp_path)
    expected = source.view(IMAGE, NAME)
    (path,) = (tmp_path / kind).iterdir()
    name = {"regions": "labels", "features": "features"}[kind]
    for wrong in WRONG[kind]:
        save_tensors(path, {name: wrong}, key=path.stem, overwrite=True)
        view = source.view(IMAGE, NAME)
        assert torch.equal(view.labels, expected.labels) and torch.equal(view.features, expected.features)
        assert not torch.equal(load_tensors(path, key=path.stem).tensors[name].float(), wrong.float())
    path.unlink()
    for what in no_files(path):
        if what not in ("a folder", "a pipe"):
            assert torch.equal(source.view(IMAGE, NAME).features, expected.features), what


@pytest.mark.parametrize("examples", EXAMPLES)
@pytest.mark.parametrize("kind", WRONG)
def test_damaged_cache_entries_are_made_again(kind: str, examples: int, tmp_path: Path) -> None:
    source = cached(RegionFeatures(Grid(12), ColourEncoder()), tmp_path)
    expected = source.view(IMAGE, NAME)
    (path,) = (tmp_path / kind).iterdir()

    def load() -> None:
        view = source.view(IMAGE, NAME)
        assert torch.equal(view.labels, expected.labels) and torch.equal(view.features, expected.features)

    fuzz(examples, damaged(path.read_bytes()), path, load)
