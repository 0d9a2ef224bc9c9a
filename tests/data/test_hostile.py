"""Files of splats, cameras and images that somebody has damaged or made up: only our own errors leave a loader."""

import codecs
import gzip
import io
import json
import pickle
import re
import struct
import zipfile
import zlib
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import strategies as st
from PIL import Image

from normlift_ns.data.checkpoint import (
    GAUSSIAN_PARAMETERS,
    Checkpoint,
    allow_numpy_scalars,
    read_checkpoint,
    read_gsplat_checkpoint,
)
from normlift_ns.data.frames import Frame, Intrinsics, check_frames, rescale_intrinsics
from normlift_ns.data.images import ImageViews
from normlift_ns.data.open_scene import SplatScene, open_saved_splat
from normlift_ns.data.open_splat import _read
from normlift_ns.data.splat import read_ply
from normlift_ns.data.transforms import read_dataparser_transforms, read_transforms, read_world_transform
from normlift_ns.errors import InputError
from tests.data.scene_files import ply_columns, random_splat, saved_run, write_gsplat, write_ply
from tests.data.test_compressed_formats import write_any
from tests.hostile import damaged, fuzz, hostile_json, no_files

N = 20
CAMERA = Intrinsics(40.0, 40.0, 20.0, 15.0, 40, 30)
BLACK = torch.zeros(3)
PLAIN, NOISE = Image.new("RGB", (40, 30)), Image.effect_noise((40, 30), 50)
CHECKPOINT = "step-000000007.ckpt"


def state(**changes: Any) -> dict[Any, Any]:
    splat = random_splat(N).parameters
    return {f"_model.gauss_params.{name}": changes.get(name, splat[name]) for name in GAUSSIAN_PARAMETERS}


def saved(folder: Path, content: Any, name: str = CHECKPOINT) -> Path:
    torch.save(content, folder / name)
    return folder / name


def test_half_precision_and_float64_become_float32(tmp_path: Path) -> None:
    whole = read_checkpoint(saved(tmp_path, {"step": 7, "pipeline": state()}))
    for dtype in (torch.float16, torch.bfloat16, torch.float64):
        pipeline = {name: value.to(dtype) for name, value in state().items()}
        found = read_checkpoint(saved(tmp_path, {"step": 7, "pipeline": pipeline}))
        for name in GAUSSIAN_PARAMETERS:
            value = found.model[f"gauss_params.{name}"]
            assert value.dtype == torch.float32
            torch.testing.assert_close(value, whole.model[f"gauss_params.{name}"], rtol=1e-2, atol=1e-2)


OTHER: dict[str, Callable[[torch.Tensor], torch.Tensor]] = {
    "shorter": lambda value: value[:-1],
    "flat": lambda value: value.reshape(-1),
    "wider": lambda value: torch.cat([value, value], dim=-1),
    "int64": lambda value: value.long(),
    "sparse": lambda value: value.to_sparse(),
    "expanded": lambda value: value[:1].expand(10**6, *value.shape[1:]),
    "meta": lambda value: torch.empty(value.shape, device="meta"),
    "quantized": lambda value: torch.quantize_per_tensor(value, 0.1, 0, torch.qint8),
    "float8": lambda value: value.to(torch.float8_e4m3fn),
    "a number": lambda value: torch.zeros(()),
}


@pytest.mark.filterwarnings("ignore")
def test_parameters_of_other_shapes_and_kinds_are_refused(tmp_path: Path) -> None:
    for name in GAUSSIAN_PARAMETERS:
        for what, change in OTHER.items():
            pipeline = state(**{name: change(random_splat(N).parameters[name])})
            path = saved(tmp_path, {"step": 7, "pipeline": pipeline})
            try:
                read_checkpoint(path)
            except InputError as error:
                assert str(path) in str(error), (name, what)
            else:
                pytest.fail(f"{name}, {what} is read")


def test_other_steps_and_states_are_refused(tmp_path: Path) -> None:
    for step in (None, "7", -1, 2.0, True, 10**12, [7], torch.tensor(7)):
        with pytest.raises(InputError, match="its step is"):
            read_checkpoint(saved(tmp_path, {"step": step, "pipeline": state()}))
        with pytest.raises(InputError, match="its step is"):
            read_gsplat_checkpoint(write_gsplat(tmp_path / "ckpt_7_rank0.pt", random_splat(N), step=step))
    with pytest.raises(InputError, match=r"step-000000008\.ckpt"):
        read_checkpoint(saved(tmp_path, {"step": 8, "pipeline": state()}))
    for pipeline, message in (
        ({0: torch.zeros(1), **state()}, r"key 0 \(int\)"),
        ({**state(), "module._model.gauss_params.means": torch.zeros(N, 3)}, "gauss_params.means twice"),
        ({**state(), "_model.camera_optimizer.x": torch.zeros(1).expand(10**12)}, "expected a dense array"),
        ({name: value[:0] for name, value in state().items()}, "no Gaussians"),
        (state(features_rest=torch.zeros(N, 7, 3)), r"\(20, 7, 3\) .* 0, 3, 8, 15, 24"),
        ([1], "`step` and `pipeline`"),
        ({}, "gauss_params.means, "),
    ):
        with pytest.raises(InputError, match=message):
            read_checkpoint(saved(tmp_path, {"step": 7, "pipeline": pipeline}))


class _Encoded:
    """Bytes that every further round of hex doubles."""

    def __reduce__(self) -> Any:
        return codecs.encode, ("x" * 100, "hex")


def test_archives_that_would_grow_are_refused(tmp_path: Path) -> None:
    whole = saved(tmp_path, {"step": 7, "pipeline": state()})
    with zipfile.ZipFile(whole) as old, zipfile.ZipFile(tmp_path / "packed.ckpt", "w", zipfile.ZIP_DEFLATED) as new:
        for item in old.infolist():
            new.writestr(item.filename, old.read(item))
        new.writestr("archive/data/99", bytes(10**7))
    with pytest.raises(InputError, match="compressed"):
        read_checkpoint(tmp_path / "packed.ckpt")
    with pytest.raises(InputError, match=r"damaged|Python objects"):
        read_checkpoint(saved(tmp_path, {"step": 7, "pipeline": state(), "x": _Encoded()}))
    with pytest.raises(InputError, match="Python objects"):
        read_checkpoint(saved(tmp_path, {"step": 7, "pipeline": state(), "x": Stranger()}))
    for name, protocol in (("plain.ckpt", 2), ("old.ckpt", 0)):
        (tmp_path / name).write_bytes(pickle.dumps({"step": 7}, protocol))
        with pytest.raises(InputError, match="truncated"):
            read_checkpoint(tmp_path / name)


def test_ply_rows_that_a_small_file_cannot_hold_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "x.ply"
    for header in (
        *(f"element vertex {count}\nproperty float x" for count in (10**12, -5, 10**23, "ten")),
        "element vertex 1000000000000",
        "element face 1000000000000\nproperty list uchar int v\nelement vertex 1\nproperty float x",
    ):
        for kind in ("ascii", "binary_little_endian"):
            path.write_text(f"ply\nformat {kind} 1.0\n{header}\nend_header\n0 0 0\n")
            with pytest.raises(InputError, match=r"x\.ply is truncated or damaged"):
                read_ply(path)


def test_headers_of_arrays_are_not_believed(tmp_path: Path) -> None:
    path = tmp_path / "world.npy"
    head = b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000000, 4), }"
    path.write_bytes(b"\x93NUMPY\x01\x00" + struct.pack("<H", 118) + head.ljust(117) + b"\n" + bytes(128))
    with pytest.raises(InputError, match=r"world\.npy does not contain a transform"):
        read_world_transform(path)
    path.write_bytes(bytes(2**17))
    with pytest.raises(InputError, match="4 x 4"):
        read_world_transform(path)
    for array, message in (
        (np.array([{}], dtype=object), "does not contain a transform"),
        (np.eye(4) * 1e200, "not finite"),
    ):
        np.save(path, array)
        with pytest.raises(InputError, match=message):
            read_world_transform(path)


def image_frame(folder: Path, made: Image.Image, kind: str = "PNG", **rest: Any) -> Frame:
    made.save(folder / "a.png", kind, **rest)
    return Frame(folder / "a.png", "a.png", np.eye(4)[:3], CAMERA)


def test_images_of_all_modes_become_rgb_or_are_refused(tmp_path: Path) -> None:
    red = Image.new("RGB", (40, 30), (250, 0, 0))
    for mode in ("P", "RGBA", "L", "LA", "1", "CMYK"):
        kind = "TIFF" if mode == "CMYK" else "PNG"
        view = ImageViews([image_frame(tmp_path, red.convert(mode), kind)], BLACK)[0]
        assert view.image.shape == (30, 40, 3)
        assert view.image[0, 0].tolist() == list(red.convert(mode).convert("RGB").getpixel((0, 0))), mode
    for mode, kind in (("I;16", "PNG"), ("F", "TIFF")):
        views = ImageViews([image_frame(tmp_path, Image.new(mode, (40, 30)), kind)], BLACK)
        for read in (views.check_files, lambda views=views: views[0]):
            with pytest.raises(InputError, match=rf"a\.png cannot be read: .* {mode}, expected 8 bits"):
                read()


def test_too_little_memory_is_not_a_damaged_image(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    views = ImageViews([image_frame(tmp_path, PLAIN)], BLACK)
    monkeypatch.setattr(ImageViews, "_pixels", lambda *_: bytearray(2**62))
    with pytest.raises(MemoryError):
        _ = views[0]


def test_transparent_pixels_show_the_background(tmp_path: Path) -> None:
    half = Image.new("RGBA", (40, 30), (255, 0, 255, 0))
    half.paste((10, 20, 30, 255), (0, 0, 20, 30))
    palette = Image.fromarray((np.arange(40) >= 20).astype(np.uint8)[None].repeat(30, 0), "P")
    palette.putpalette([10, 20, 30, 255, 0, 255])
    for image, more in ((half, {}), (half.convert("LA"), {}), (palette, {"transparency": 1})):
        pixels = ImageViews([image_frame(tmp_path, image, **more)], torch.ones(3))[0].image
        assert (pixels[:, 20:] == 255).all(), image.mode
        assert (pixels[:, :20] < 40).all(), image.mode


def test_rotations_and_animations_are_remarked(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x0112] = 3
    two = {"save_all": True, "append_images": [Image.new("RGB", (40, 30), "red")]}
    for kind, more, expected in (
        *((kind, {"exif": exif}, "EXIF .*1 of 1,") for kind in ("JPEG", "PNG", "WEBP", "TIFF")),
        *((kind, two, "several") for kind in ("GIF", "PNG", "WEBP", "TIFF")),
        *((kind, {}, None) for kind in ("JPEG", "PNG", "WEBP", "TIFF")),
    ):
        frame = image_frame(tmp_path, PLAIN, kind, **more)
        remarks = ImageViews([frame], BLACK).check_files()
        assert len(remarks) == (expected is not None), (kind, remarks)
        assert expected is None or re.search(expected, remarks[0]), (kind, remarks)


def test_wrong_cameras_masks_and_heads_name_their_image(tmp_path: Path) -> None:
    frame = image_frame(tmp_path, PLAIN)
    for camera in (CAMERA._replace(fx=1e39), CAMERA._replace(cx=1e39, k1=0.1)):
        with pytest.raises(InputError, match=r"camera of .*a\.png cannot be used"):
            _ = ImageViews([replace(frame, intrinsics=camera)], BLACK).cameras
    mask = tmp_path / "mask.png"
    for made in (PLAIN, Image.new("L", (40, 31)), Image.new("LA", (40, 30))):
        made.save(mask)
        with pytest.raises(InputError, match=r"mask\.png .*a\.png"):
            rescale_intrinsics(Frame(frame.file, "a", frame.pose, CAMERA, mask), tmp_path)
    data = bytearray(frame.file.read_bytes())
    data[16:24] = struct.pack(">II", 10**5, 10**5)
    data[29:33] = struct.pack(">I", zlib.crc32(data[12:29]))
    frame.file.write_bytes(data)
    with pytest.raises(InputError, match=r"a\.png cannot be read as an image"):
        rescale_intrinsics(frame, tmp_path)


def looked_at(path: Path) -> None:
    frame = Frame(path.with_name("a.png"), "a.png", np.eye(4)[:3], CAMERA, path if path.stem == "mask" else None)
    rescale_intrinsics(frame, path.parent)
    _ = ImageViews([frame], BLACK)[0]


def saved_splat(path: Path) -> None:
    views, none = ImageViews([image_frame(path.parent, PLAIN)], BLACK), ImageViews([], BLACK)
    there = path.parent
    saved_run(there, SplatScene(random_splat(N), views, none, "x", there, 7, there, there, {}, "classic", "black"))


def write_compressed(kind: str, path: Path) -> None:
    write_any(path.parent, random_splat(N, 1), kind)


LOADERS: dict[str, tuple[str, Callable[[Path], object], Callable[[Path], Any]]] = {
    "checkpoint": (CHECKPOINT, lambda path: saved(path.parent, {"step": 7, "pipeline": state()}), read_checkpoint),
    "gsplat": ("ckpt_7_rank0.pt", lambda path: write_gsplat(path, random_splat(N), step=7), read_gsplat_checkpoint),
    "ply": ("x.ply", lambda path: write_ply(path, ply_columns(random_splat(N, 1))), read_ply),
    "text ply": ("x.ply", lambda path: write_ply(path, ply_columns(random_splat(N, 1)), text=True), read_ply),
    "JPEG": ("a.png", lambda path: NOISE.convert("RGB").save(path, "JPEG"), looked_at),
    "mask": ("mask.png", lambda path: (image_frame(path.parent, PLAIN), NOISE.save(path)), looked_at),
    "world": ("world.json", lambda path: path.write_text(json.dumps(np.eye(4).tolist())), read_world_transform),
    "world.npy": ("world.npy", lambda path: np.save(path, np.eye(4)), read_world_transform),
    "world.txt": ("world.txt", lambda path: np.savetxt(path, np.eye(4)), read_world_transform),
    "parser": (
        "world.json",
        lambda path: path.write_text(json.dumps({"transform": np.eye(4)[:3].tolist(), "scale": 0.5})),
        lambda path: (read_world_transform(path, np.eye(4)), read_dataparser_transforms(path)),
    ),
    "cameras": ("transforms.json", saved_splat, lambda path: check_frames(read_transforms(path).frames, path)),
    "splat": ("splat.json", saved_splat, lambda path: open_saved_splat(path.parent)),
}
for kind in ("spz", "spz4", "splat", "glb", "ply"):  # compressed
    LOADERS[f"scene.{kind}"] = (f"scene.{kind}", partial(write_compressed, kind), _read)
"""Names of files, what writes whole ones, and what reads them."""


def damage(path: Path) -> st.SearchStrategy[bytes]:
    """Contents instead of those of a file: also other values in JSON, and pickles damaged under a valid checksum."""
    whole = path.read_bytes()
    if path.suffix == ".json":
        return damaged(whole) | hostile_json(json.loads(whole))
    if path.suffix == ".spz":  # damage under a valid checksum
        return damaged(whole) | damaged(gzip.decompress(whole)).map(gzip.compress)
    if path.suffix not in (".ckpt", ".pt"):
        return damaged(whole)
    with zipfile.ZipFile(path) as old:
        entries = {item.filename: old.read(item) for item in old.infolist()}
    (pickled,) = (name for name in entries if name.endswith("data.pkl"))

    def repacked(data: bytes) -> bytes:
        buffer = io.BytesIO()
        with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as new:
            for name, content in {**entries, pickled: data}.items():
                new.writestr(name, content)
        return buffer.getvalue()

    return damaged(whole) | damaged(entries[pickled]).map(repacked)


@pytest.mark.filterwarnings("ignore")
def test_damage_is_a_message(tmp_path: Path) -> None:
    for kind, (name, write, read) in LOADERS.items():
        path = tmp_path / kind / name
        path.parent.mkdir()
        write(path)
        path.rename(tmp_path / "whole")
        for what in no_files(path):
            with pytest.raises((FileNotFoundError, InputError)) as caught:
                read(path)
            assert path.stem in str(caught.value), (kind, what)
        (tmp_path / "whole").replace(path)

        def load(read: Callable[[Path], Any] = read, path: Path = path) -> None:
            try:
                found = read(path)
            except (InputError, FileNotFoundError) as error:
                assert str(path.parent) in str(error)
                raise
            if isinstance(found, Checkpoint):
                assert {len(found.model[f"gauss_params.{name}"]) for name in GAUSSIAN_PARAMETERS} != {0}

        load()
        fuzz(20 if kind == "cameras" else 10, damage(path), path, load)


class Stranger:
    """Of a kind that checkpoints do not hold."""


def test_numbers_of_numpy_are_read_and_objects_are_not(tmp_path: Path) -> None:
    state = {"step": 7, "lr": np.float64(0.1), "many": [np.float32(1), np.int64(3)], "w": torch.arange(3.0)}
    plain = saved(tmp_path, {**state, "more": OrderedDict(a=1)}, "plain.pt")
    with allow_numpy_scalars():
        found = torch.load(plain, weights_only=True)
        with pytest.raises(pickle.UnpicklingError, match="Stranger"):
            torch.load(saved(tmp_path, {**state, "stranger": Stranger()}, "stranger.pt"), weights_only=True)
    assert found["step"] == 7
    assert torch.equal(found["w"], state["w"])
    adds = hasattr(torch.serialization, "add_safe_globals")
    assert (found["lr"], found["many"]) == ((0.1, [1, 3]) if adds else (None, [None, None]))
    if hasattr(torch.serialization, "safe_globals") or not adds:  # torch 2.4 keeps what was once allowed
        with pytest.raises(pickle.UnpicklingError, match="numpy"):
            torch.load(plain, weights_only=True)
