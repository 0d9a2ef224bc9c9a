"""Files of splats, cameras and photographs that somebody has damaged or made up: only our own errors leave a loader."""

from __future__ import annotations

import json
import os
import pickle
import random
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from normlift_ns.errors import InputError
from normlift_ns.scenes.checkpoint import GAUSSIAN_PARAMETERS, Checkpoint, read_checkpoint
from normlift_ns.scenes.formats.gsplat_checkpoint import read_gsplat
from normlift_ns.scenes.formats.ply import read_ply
from normlift_ns.scenes.frames import Frame, Intrinsics, sized
from normlift_ns.scenes.photographs import PhotographViews
from normlift_ns.scenes.saved import checkpoint_of, open_saved_splat
from normlift_ns.scenes.similarity import read_dataparser_transforms, read_world_transform
from normlift_ns.scenes.transforms import read_transforms, write_transforms
from tests.scenes.made import ply_columns, random_splat, write_gsplat, write_ply

N = 20
CAMERA = Intrinsics(40.0, 40.0, 20.0, 15.0, 40, 30)


def state(**changes: Any) -> dict[Any, Any]:
    """`pipeline` of a checkpoint."""
    splat = random_splat(N).parameters
    return {f"_model.gauss_params.{name}": changes.get(name, splat[name]) for name in GAUSSIAN_PARAMETERS}


def saved(folder: Path, content: Any, name: str = "step-000000007.ckpt") -> Path:
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


@pytest.mark.parametrize("name", GAUSSIAN_PARAMETERS)
@pytest.mark.parametrize(
    "change",
    [
        lambda value: value[:-1],
        lambda value: value[:0],
        lambda value: value.reshape(-1),
        lambda value: value[..., None],
        lambda value: torch.cat([value, value], dim=-1),
        lambda value: value.long(),
        lambda value: value > 0,
        lambda value: value.to(torch.complex64),
        lambda value: value.to_sparse(),
        lambda value: value[:1].expand(10**6, *value.shape[1:]) if value.ndim > 1 else value,
        lambda value: torch.empty(value.shape, device="meta"),
        lambda value: torch.quantize_per_tensor(value, 0.1, 0, torch.qint8),
        lambda value: value.to(torch.float8_e4m3fn),
        lambda value: torch.zeros(()),
    ],
)
@pytest.mark.filterwarnings("ignore")
def test_parameters_of_other_shapes_and_kinds_are_named(tmp_path: Path, name: str, change: Callable) -> None:
    changed = change(random_splat(N).parameters[name])
    path = saved(tmp_path, {"step": 7, "pipeline": state(**{name: changed})})
    with pytest.raises(InputError) as caught:
        read_checkpoint(path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize("step", [None, "7", -1, 2.0, True, 10**12, 8, [7], torch.tensor(7)])
def test_steps_that_are_none_or_not_those_of_the_name_are_refused(tmp_path: Path, step: object) -> None:
    path = saved(tmp_path, {"step": step, "pipeline": state()})
    with pytest.raises(InputError, match=r"its step is|not the one in its name\. Rename it to step-000000008\.ckpt"):
        read_checkpoint(path)
    with (
        pytest.raises(InputError, match=r"its step is")
        if step != 8
        else pytest.raises(InputError, match="no checkpoint")
    ):
        read_gsplat(
            saved(tmp_path, {"step": step, "splats" if step != 8 else "x": gsplat_tensors()}, "ckpt_7_rank0.pt")
        )


def gsplat_tensors() -> dict[str, torch.Tensor]:
    splat = random_splat(N)
    rest = {"opacities": splat.opacities[:, 0], "sh0": splat.features_dc[:, None], "shN": splat.features_rest}
    return {"means": splat.means, "quats": splat.quats, "scales": splat.scales, **rest}


@pytest.mark.parametrize(
    ("pipeline", "message"),
    [
        ({0: torch.zeros(1), **state()}, r"has the key 0 \(int\)"),
        ({**state(), "module._model.gauss_params.means": torch.zeros(N, 3)}, "holds gauss_params.means twice"),
        ({**state(), "_model.camera_optimizer.x": torch.zeros(1).expand(10**12)}, "not stored number by number"),
        ({name: value[:0] for name, value in state().items()}, "holds no Gaussians at all"),
        (state(features_rest=torch.zeros(N, 7, 3)), r"have shape \(20, 7, 3\) .* K = 0, 3, 8, 15, 24 for degrees"),
        ([1], "expected `step` and `pipeline`"),
        ({}, "gauss_params.means, "),
    ],
)
def test_other_states_are_refused(tmp_path: Path, pipeline: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_checkpoint(saved(tmp_path, {"step": 7, "pipeline": pipeline}))


class _Encoded:
    """Bytes that every further round of hex doubles."""

    def __reduce__(self) -> Any:
        import codecs  # noqa: PLC0415

        return codecs.encode, ("x" * 100, "hex")


def test_archives_that_would_grow_are_refused(tmp_path: Path) -> None:
    whole = saved(tmp_path, {"step": 7, "pipeline": state()})
    with zipfile.ZipFile(whole) as old, zipfile.ZipFile(tmp_path / "packed.ckpt", "w", zipfile.ZIP_DEFLATED) as new:
        for item in old.infolist():
            new.writestr(item.filename, old.read(item))
        new.writestr("archive/data/99", bytes(10**7))
    with pytest.raises(InputError, match="holds compressed entries"):
        read_checkpoint(tmp_path / "packed.ckpt")
    with pytest.raises(InputError, match=r"damaged|Python objects"):
        read_checkpoint(saved(tmp_path, {"step": 7, "pipeline": state(), "x": _Encoded()}))
    for name, protocol in (("plain.ckpt", 2), ("old.ckpt", 0)):
        (tmp_path / name).write_bytes(pickle.dumps({"step": 7}, protocol))
        with pytest.raises(InputError, match="truncated or no checkpoint"):
            read_checkpoint(tmp_path / name)


def test_pipes_and_folders_are_no_files(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "folder").mkdir()
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    for name in ("pipe", "folder", "loop", "nothing"):
        for read in (read_checkpoint, read_gsplat, read_ply, read_world_transform, read_dataparser_transforms):
            with pytest.raises((FileNotFoundError, InputError), match=name):
                read(tmp_path / name)


@pytest.mark.parametrize(
    "header",
    [
        "element vertex 1000000000000\nproperty float x",
        "element vertex -5\nproperty float x",
        "element vertex 99999999999999999999999\nproperty float x",
        "element vertex ten\nproperty float x",
        "element vertex 1000000000000",
        "element face 1000000000000\nproperty list uchar int v\nelement vertex 1\nproperty float x",
    ],
)
@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian"])
def test_rows_that_a_small_file_cannot_hold_are_refused(tmp_path: Path, header: str, kind: str) -> None:
    path = tmp_path / "x.ply"
    path.write_text(f"ply\nformat {kind} 1.0\n{header}\nend_header\n0 0 0\n")
    with pytest.raises(InputError, match=r"x\.ply is truncated or damaged"):
        read_ply(path)


def test_headers_of_arrays_are_not_believed(tmp_path: Path) -> None:
    path = tmp_path / "world.npy"
    np.save(path, np.eye(4))
    head = b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000000, 4), }"
    path.write_bytes(b"\x93NUMPY\x01\x00" + struct.pack("<H", 118) + head.ljust(117) + b"\n" + bytes(128))
    with pytest.raises(InputError, match=r"world\.npy holds no transform"):
        read_world_transform(path)
    path.write_bytes(bytes(2**17))
    with pytest.raises(InputError, match="too many for 4 x 4 numbers"):
        read_world_transform(path)
    np.save(path, np.array([{}], dtype=object))
    with pytest.raises(InputError, match="holds no transform"):
        read_world_transform(path)
    np.save(path, np.eye(4) * 1e200)
    with pytest.raises(InputError, match="not finite"):
        read_world_transform(path)


def photograph(folder: Path, made: Image.Image, kind: str = "PNG", **rest: Any) -> Frame:
    made.save(folder / "a.png", kind, **rest)
    return Frame(folder / "a.png", "a.png", np.eye(4)[:3], CAMERA)


def test_photographs_of_splats_are_turned_into_what_people_see_or_refused(tmp_path: Path) -> None:
    red = Image.new("RGB", (40, 30), (250, 0, 0))
    for mode in ("P", "RGBA", "L", "LA", "1", "CMYK"):
        kind = "TIFF" if mode == "CMYK" else "PNG"
        view = PhotographViews([photograph(tmp_path, red.convert(mode), kind)], torch.zeros(3))[0]
        assert view.image.shape == (30, 40, 3)
        expected = red.convert(mode).convert("RGB").getpixel((0, 0))
        assert view.image[0, 0].tolist() == list(expected)
    for mode in ("I;16", "F"):
        kind = "TIFF" if mode == "F" else "PNG"
        made = Image.new("F", (40, 30)) if mode == "F" else Image.new("I;16", (40, 30))
        with pytest.raises(InputError, match=rf"a\.png cannot be read: its pixels are of mode {mode}, expected 8 bits"):
            PhotographViews([photograph(tmp_path, made, kind)], torch.zeros(3)).check_files()


def test_what_people_see_otherwise_is_said(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x0112] = 3
    plain, turned = Image.new("RGB", (40, 30)), {"exif": exif}
    for kind in ("JPEG", "PNG", "WEBP", "TIFF"):
        remarks = PhotographViews([photograph(tmp_path, plain, kind, **turned)], torch.zeros(3)).check_files()
        assert "1 of 1 photographs carry an EXIF rotation" in remarks[0]
        assert PhotographViews([photograph(tmp_path, plain, kind)], torch.zeros(3)).check_files() == ()
    two = {"save_all": True, "append_images": [Image.new("RGB", (40, 30), "red")]}
    for kind in ("GIF", "PNG", "WEBP", "TIFF"):
        remarks = PhotographViews([photograph(tmp_path, plain, kind, **two)], torch.zeros(3)).check_files()
        assert "hold several pictures" in remarks[0]


def test_wrong_cameras_and_masks_name_their_photograph(tmp_path: Path) -> None:
    frame = photograph(tmp_path, Image.new("RGB", (40, 30)))
    for camera in (CAMERA._replace(fx=1e39), CAMERA._replace(cx=1e39, k1=0.1)):
        with pytest.raises(InputError, match=r"camera of .*a\.png cannot be used"):
            _ = PhotographViews([Frame(frame.file, "a", frame.pose, camera)], torch.zeros(3)).cameras
    mask = tmp_path / "mask.png"
    for made in (Image.new("RGB", (40, 30)), Image.new("L", (40, 31)), Image.new("LA", (40, 30))):
        made.save(mask)
        with pytest.raises(InputError, match=r"mask\.png .*a\.png"):
            sized(Frame(frame.file, "a", frame.pose, CAMERA, mask), tmp_path)


def test_heads_that_promise_too_much_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    Image.new("RGB", (40, 30)).save(path)
    data = bytearray(path.read_bytes())
    data[16:24] = struct.pack(">II", 10**5, 10**5)
    import zlib  # noqa: PLC0415

    data[29:33] = struct.pack(">I", zlib.crc32(data[12:29]))
    path.write_bytes(data)
    with pytest.raises(InputError, match=r"a\.png cannot be read as an image"):
        sized(Frame(path, "a", np.eye(4)[:3], CAMERA), tmp_path)


def a_saved_splat(folder: Path) -> Path:
    """A run's splat.json, transforms.json and checkpoint."""
    from normlift_ns.scenes.opening import SplatScene  # noqa: PLC0415

    Image.new("RGB", (40, 30)).save(folder / "a.png")
    frames = [Frame(folder / "a.png", "a.png", np.eye(4)[:3], CAMERA)]
    views = PhotographViews(frames, torch.zeros(3))
    none = PhotographViews([], torch.zeros(3))
    scene = SplatScene(random_splat(N), views, none, "x", folder, 7, folder, folder, {}, "classic", "black")
    (folder / "nerfstudio_models").mkdir()
    saved(folder / "nerfstudio_models", checkpoint_of(scene))
    write_transforms(folder / "transforms.json", frames, [])
    content = {"name": "x", "rasterize_mode": "classic", "background": "black", "photographs": str(folder)}
    (folder / "splat.json").write_text(json.dumps({**content, "identity": {}}))
    return folder


def make(kind: str, folder: Path) -> tuple[Path, Callable[[], Any]]:  # noqa: PLR0911 (one kind after the other)
    """A whole file of that kind, and what reads it."""
    if kind == "checkpoint":
        path = saved(folder, {"step": 7, "pipeline": state()})
        return path, lambda: read_checkpoint(path)
    if kind == "gsplat":
        path = write_gsplat(folder / "ckpt_7_rank0.pt", random_splat(N), step=7)
        return path, lambda: read_gsplat(path)
    if kind.endswith("ply"):
        path = write_ply(folder / "x.ply", ply_columns(random_splat(N, 1)), text=kind == "text ply")
        return path, lambda: read_ply(path)
    if kind == "photograph":
        frame = photograph(
            folder, Image.effect_noise((40, 30), 50).convert("RGB"), random.choice(["PNG", "JPEG", "WEBP"])
        )
        return frame.file, lambda: (sized(frame, folder), PhotographViews([frame], torch.zeros(3))[0])
    if kind == "mask":
        photo = photograph(folder, Image.new("RGB", (40, 30)))
        mask = folder / "mask.png"
        Image.effect_noise((40, 30), 50).save(mask)
        framed = Frame(photo.file, "a", photo.pose, CAMERA, mask)
        return mask, lambda: (sized(framed, folder), PhotographViews([framed], torch.zeros(3))[0])
    if kind == "world":
        path = folder / "world.json"
        path.write_text(json.dumps(np.eye(4).tolist()))
        return path, lambda: read_world_transform(path)
    if kind == "parser":
        path = folder / "world.json"
        path.write_text(json.dumps({"transform": np.eye(4)[:3].tolist(), "scale": 0.5}))
        return path, lambda: (read_world_transform(path, np.eye(4)), read_dataparser_transforms(path))
    if kind == "transforms":
        a_saved_splat(folder)
        return folder / "transforms.json", lambda: read_transforms(folder / "transforms.json")
    a_saved_splat(folder)
    return folder / kind, lambda: open_saved_splat(folder)


VALUES = ("null", "true", "-1", "1e400", "NaN", "[]", "{}", '"x"', '"\\u0000"', "9" * 400, "[" * 2000, "1e38")
KINDS = ("checkpoint", "gsplat", "ply", "text ply", "photograph", "mask", "world", "parser", "transforms", "splat.json")


def damage(data: bytes, chance: random.Random, is_json: bool) -> bytes:
    """Bytes changed, left out, put in or cut off; in JSON also whole values."""
    if is_json and chance.random() < 0.7:
        text = data.decode()
        places = [i for i, letter in enumerate(text) if letter in ":[,"]
        at = chance.choice(places) + 1
        end = min((i for i in (text.find(c, at) for c in ",]}\n") if i >= 0), default=len(text))
        return f"{text[:at]}{chance.choice(VALUES)}{text[end:]}".encode()
    out = bytearray(data)
    for _ in range(chance.randint(1, 5)):
        at, kind = chance.randrange(len(out)), chance.randrange(4)
        head = chance.randrange(min(len(out), 400)) if chance.random() < 0.5 else at
        if kind == 0:
            out[head] = chance.randrange(256)
        elif kind == 1:
            out[head : head + chance.randint(1, 8)] = b""
        elif kind == 2:
            out[head:head] = chance.randbytes(chance.randint(1, 8))
        elif chance.random() < 0.3:
            del out[at:]
        if len(out) < 2:
            break
    return bytes(out)


def repacked(path: Path, chance: random.Random) -> None:
    """A checkpoint whose pickle is damaged under a checksum that fits."""
    with zipfile.ZipFile(path) as old:
        entries = {item.filename: old.read(item) for item in old.infolist()}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as new:
        for name, data in entries.items():
            new.writestr(name, damage(data, chance, False) if name.endswith("data.pkl") else data)


def no_other_error(folder: Path, kind: str, seed: int) -> None:
    chance = random.Random(seed)
    path, read = make(kind, folder)
    if kind in ("checkpoint", "gsplat") and chance.random() < 0.6:
        repacked(path, chance)
    else:
        is_json = kind in ("world", "parser", "transforms", "splat.json")
        path.write_bytes(damage(path.read_bytes(), chance, is_json))
    try:
        found = read()
    except (InputError, FileNotFoundError) as error:
        assert str(folder) in str(error)
    else:
        assert found is not None
        if isinstance(found, Checkpoint):
            assert {len(found.model[f"gauss_params.{name}"]) for name in GAUSSIAN_PARAMETERS} != {0}


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("kind", KINDS)
@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32))
def test_damage_is_a_message(tmp_path_factory: pytest.TempPathFactory, kind: str, seed: int) -> None:
    no_other_error(tmp_path_factory.mktemp("d"), kind, seed)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("kind", KINDS)
@settings(max_examples=200, deadline=None)
@given(seed=st.integers(0, 2**32))
def test_damage_is_always_a_message(tmp_path_factory: pytest.TempPathFactory, kind: str, seed: int) -> None:
    no_other_error(tmp_path_factory.mktemp("d"), kind, seed)
