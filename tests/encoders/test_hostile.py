"""Files that are damaged, absurd or no files: only our own errors leave the loaders."""

import io
import itertools
import json
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import strategies as st
from PIL import Image

from normlift_ns.encoders.base import RegionFeatures
from normlift_ns.encoders.cache import cached
from normlift_ns.encoders.color import ColorEncoder
from normlift_ns.encoders.langsplat import LangSplat
from normlift_ns.encoders.open_clip_network import load_open_clip
from normlift_ns.encoders.text_files import TextEmbeddingFile, write_text_embeddings
from normlift_ns.io.arrays import load_arrays, read_npy, save_arrays
from normlift_ns.segmentation.checkpoint import load_sam_checkpoint
from normlift_ns.segmentation.regions import Grid, LabelFiles, read_image
from tests.encoders.tiny import CLIP, copied, noise, refused
from tests.hostile import damaged, fuzz, hostile_json, no_files, survives
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


def png(array: np.ndarray) -> bytes:
    return stored(lambda file: Image.fromarray(array).save(file, "png"))


def npz(**arrays: np.ndarray) -> bytes:
    return stored(np.savez_compressed, **arrays)


def map_loader(folder: Path) -> Callable[[], object]:
    def load() -> None:
        LabelFiles(folder).labels(IMAGE, NAME)
        LabelFiles(folder, resample=True).labels(IMAGE, NAME)
        LabelFiles(folder).size(NAME)

    return load


def langsplat_loader(folder: Path) -> Callable[[], object]:
    def load() -> None:
        source = LangSplat(folder, ColorEncoder(), "l", resample=True)
        source.available([NAME])
        source.size(NAME)
        source.view(IMAGE, NAME)

    return load


def table() -> np.ndarray:
    return torch.nn.functional.normalize(torch.arange(7.0 * 20).reshape(7, 20) + 1, dim=1).numpy()


def loaders() -> dict[str, tuple[str, bytes, Callable[[Path], Callable[[], object]], dict[str, bytes]]]:
    """A file's name and content, what loads it from its folder, and the files beside it."""
    texts = npz(fox=np.arange(4.0), mug=np.ones(4))
    return {
        "label map, NPY": ("a.npy", npy(MAP), map_loader, {}),
        "label map, 8 bits": ("a.png", png(MAP.astype(np.uint8)), map_loader, {}),
        "label map, 16 bits": ("a.png", png((300 * MAP).astype(np.uint16)), map_loader, {}),
        "segment map": ("a_s.npy", npy(np.stack([MAP] * 4).astype("f4")), langsplat_loader, {"a_f.npy": npy(table())}),
        "feature table": ("a_f.npy", npy(table()), langsplat_loader, {"a_s.npy": npy(np.stack([MAP] * 4))}),
        "text vectors": ("t.npz", texts, lambda folder: lambda: TextEmbeddingFile(folder / "t.npz").text(["fox"]), {}),
        "picture": ("p.jpg", png(IMAGE.numpy()), lambda folder: lambda: read_image(folder / "p.jpg"), {}),
    }


def test_damaged_files_and_what_is_none_raise_our_errors_only(tmp_path: Path) -> None:
    for kind, (name, whole, loader, others) in loaders().items():
        folder = tmp_path / kind
        folder.mkdir()
        for other, content in {**others, name: whole}.items():
            (folder / other).write_bytes(content)
        loader(folder)()
        fuzz(15, damaged(whole), folder / name, loader(folder))
        (folder / name).unlink()
        for _ in no_files(folder / name):
            refused(loader(folder), str(folder), error=Exception)
            survives(loader(folder))


def test_any_header_of_an_array_raises_our_errors_only(tmp_path: Path) -> None:
    """Headers are Python literals: any literal in place of one."""
    described = st.sampled_from(["<f4", "|O", "<i8", "f4,i4", "<U9999999", "V8", "[('a','<f4')]", "(2,)f4", "<f3", "é"])
    lengths = st.integers(-2, 10**15) | st.booleans() | st.floats() | st.just(10**400)
    fields = st.fixed_dictionaries(
        {"descr": described | st.lists(described) | st.none(), "fortran_order": st.booleans() | st.integers()},
        optional={"shape": st.lists(lengths, max_size=40).map(tuple) | st.lists(lengths) | st.integers(), "x": lengths},
    )
    text = fields.map(repr) | st.sampled_from(["(" * 3000, "{" * 90, "'" * 99, "-" * 4000 + "1", "\\N{x}", "a" * 70000])
    header = text.map(lambda t: b"\x93NUMPY\x02\x00" + struct.pack("<I", len(t.encode())) + t.encode() + bytes(64))
    fuzz(25, header, tmp_path / "a.npy", lambda: read_npy(tmp_path / "a.npy", "map"))


def test_bombs_programs_and_lossy_pictures_are_refused_by_name(tmp_path: Path) -> None:
    """Pictures of few bytes have any size; and Pillow gives PostScript to Ghostscript, whatever the file is called."""
    path = tmp_path / "a.png"
    for side in (12_000, 20_000, 2**31 - 1):
        path.write_bytes(grey_png(side, side, 8, bytes(2**20)))
        refused(lambda: LabelFiles(tmp_path, resample=True).labels(IMAGE, NAME), str(path), "too large")
    path.write_bytes(b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 8 6\n%%EndComments\nshowpage\n")
    refused(lambda: read_image(path), str(path), "damaged or not an image")
    refused(lambda: LabelFiles(tmp_path).labels(IMAGE, NAME), "label map", str(path), "damaged or not an image")
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
        (entry("fox", ones[:-3]), ["'fox'", "float64 need 32 bytes", "29"]),
        (entry("fox", ones, npy(np.arange(4.0))), ["two vectors for 'fox'"]),
        (npz(fox=np.ones(4, np.longdouble)), ["'fox'", np.dtype(np.longdouble).name]),
        (npz(fox=np.array("text")), ["'fox'", "<U4"]),
        (npz(fox=np.ones((2, 4))), ["'fox'", "float64 (2, 4)"]),
        (npz(fox=np.float64(3)), ["'fox'", "float64 ()"]),
        (npz(fox=np.ones(4, int)), ["'fox'", "int64 (4,)"]),
        (npz(fox=np.zeros(4)), ["'fox'", "zero or not finite"]),
        (npz(fox=np.array([1, np.nan])), ["'fox'", "zero or not finite"]),
        (npz(fox=np.array([{}], dtype=object)), ["'fox'", "objects"]),
        (npz(fox=np.ones(4), mug=np.ones(5)), ["same D"]),
        (b"PK no archive", ["NPZ"]),
    ):
        (tmp_path / "t.npz").write_bytes(content)
        refused(lambda: TextEmbeddingFile(tmp_path / "t.npz").text(["fox"]), "t.npz", *parts)
    refused(lambda: TextEmbeddingFile(Path("nowhere.npz")), "nowhere.npz", "--text-embeddings", error=FileNotFoundError)


def test_vectors_of_any_length_become_unit_vectors(tmp_path: Path) -> None:
    for length in (1e-320, 1e-40, 1e300):
        np.savez(tmp_path / "t.npz", fox=np.array([0, 3 * length, 4 * length]))
        vector = torch.tensor([0, 3 * length, 4 * length], dtype=torch.float64)
        (tmp_path / "w.npz").unlink(missing_ok=True)
        write_text_embeddings(tmp_path / "w.npz", {"fox": vector})
        for file in ("t.npz", "w.npz"):
            torch.testing.assert_close(TextEmbeddingFile(tmp_path / file).text(["fox"]), torch.tensor([[0, 0.6, 0.8]]))


def test_cache_entries_that_do_not_fit_are_made_again(tmp_path: Path) -> None:
    """Whole, with a digest and the right key."""
    source = cached(RegionFeatures(Grid(12), ColorEncoder()), tmp_path)
    expected = source.view(IMAGE, NAME)
    short = torch.zeros(1, 1, 6, 8, dtype=torch.int16)
    labels = [short[..., :7], short[0], short[:0].int(), short - 2, short.float(), short.long()]
    features = [torch.full((12, 3), 0.1), torch.full((12, 3), torch.nan), torch.eye(3)[:2], torch.ones(12)]
    features += [torch.zeros(12, 0), torch.eye(3).expand(5, 3, 3).reshape(15, 3), torch.eye(12).half()]
    for kind, name, tensors in (("regions", "labels", labels), ("features", "features", features)):
        (path,) = (tmp_path / kind).iterdir()
        for wrong in tensors:
            save_arrays(path, {name: wrong.contiguous()}, key=path.stem, overwrite=True)
            view = source.view(IMAGE, NAME)
            assert torch.equal(view.labels, expected.labels) and torch.equal(view.features, expected.features)
            assert not torch.equal(load_arrays(path, key=path.stem, framework="pt").arrays[name].float(), wrong.float())
        path.unlink()
        for what in no_files(path):
            if what not in ("a folder", "a pipe"):
                assert torch.equal(source.view(IMAGE, NAME).features, expected.features), what


def test_damaged_weights(clip_weights: Path, sam_weights: Path, tmp_path: Path) -> None:
    folder = copied(sam_weights / "tiny", tmp_path)
    for source in (*clip_weights.glob("tiny.*"), sam_weights / "sam_tiny.pth", *folder.iterdir()):
        whole, path = source.read_bytes(), folder / source.name
        given = folder if source.parent == folder else path

        def load(given: Path = given, clip: bool = source.parent == clip_weights) -> object:
            return load_open_clip(CLIP, str(given), "cpu") if clip else load_sam_checkpoint(str(given))[1]

        fuzz(4, damaged(whole), path, load)
        if source.suffix == ".json":
            fuzz(4, hostile_json(json.loads(whole)), path, load)
        path.write_bytes(whole)
