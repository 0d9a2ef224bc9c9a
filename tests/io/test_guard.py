"""What may be read, and which files no output may replace."""

import io
import os
import re
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

import normlift_ns
from normlift_ns.cli.query import read_vocabulary
from normlift_ns.data.checkpoint import load_torch_archive
from normlift_ns.data.colmap import read_colmap_model
from normlift_ns.data.nerfstudio.config import compose_config
from normlift_ns.data.splat import read_ply
from normlift_ns.data.transforms import read_json_file
from normlift_ns.encoders.text_files import TextEmbeddingFile
from normlift_ns.errors import InputError
from normlift_ns.exports import read_cloud
from normlift_ns.io import guard
from normlift_ns.io.arrays import read_metadata, read_npy
from normlift_ns.io.atomic import atomic_file, atomic_files, refuse_existing, write_text_file
from normlift_ns.io.field import read_evidence
from normlift_ns.io.file_lock import read_jsonl
from normlift_ns.io.run_dir import read_manifest
from normlift_ns.segmentation.regions import read_image
from tests.hostile import no_files


def numbers(save: Callable[..., Any], *values: Any) -> bytes:
    stream = io.BytesIO()
    save(stream, *values)
    return stream.getvalue()


PLY = b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n0\n"
CONTENT = {
    "a.ply": PLY, "a.json": b'{"mine": 1}', "a.npy": numbers(np.save, np.zeros(2)),
    "a.png": numbers(lambda stream: Image.new("L", (2, 2)).save(stream, "PNG")),
    "a.npz": numbers(np.savez, np.zeros(2)), "a.csv": b"id,text\n1,fox\n", "a.txt": b"a diary\n",
    "a.ckpt": numbers(lambda stream: torch.save({"a": torch.zeros(2)}, stream)), "a.bin": bytes(range(99)),
    "a.safetensors": (8).to_bytes(8, "little") + b'{"a":{} ', "a.svg": b'<?xml version="1.0"?>\n<svg>',
    "a.py": b"import a, b\n", "a.ini": b"[a]\nb = 1\n", "a.pdf": b"%PDF-1.4\n",
}  # fmt: skip
"""A file of each kind; its name does not count, its content does."""


@pytest.mark.parametrize("kind", CONTENT)
def test_only_a_file_of_the_same_kind_is_replaced(kind: str, tmp_path: Path) -> None:
    for name, old in CONTENT.items():
        path = tmp_path / name
        path.write_bytes(old)
        with pytest.raises(FileExistsError), atomic_file(path) as draft:
            draft.write_bytes(CONTENT[kind])
        if name == kind:
            with atomic_file(path, overwrite=True) as draft:
                draft.write_bytes(CONTENT[kind])
        else:
            wrong = pytest.raises(InputError, match=rf"content of .*{name} is .*same kind")
            with wrong, atomic_file(path, overwrite=True) as draft:
                draft.write_bytes(CONTENT[kind])
        assert path.read_bytes() == old and os.listdir(tmp_path) == [name], (kind, name)
        path.write_bytes(b"")
        with atomic_file(path, overwrite=True) as draft:
            draft.write_bytes(CONTENT[kind])
        path.unlink()


def test_what_is_no_file_is_not_replaced_and_exports_change_together(tmp_path: Path) -> None:
    path, outside = tmp_path / "a.json", tmp_path / "outside.json"
    for kind in no_files(path):
        if kind in ("nothing", "an empty file"):
            continue
        for write in (
            lambda: refuse_existing(path, overwrite=True, flags="--output-json"),
            lambda: write_text_file(path, "{}", overwrite=True),
        ):
            with pytest.raises(InputError, match=r"a\.json"):
                write()
    path.write_text("a diary")
    outside.write_text("{}")
    for files, gone in (((outside, path), []), ((outside,), [path])):
        with pytest.raises(InputError, match="is text,"), atomic_files(*files, overwrite=True, delete=gone) as drafts:
            for draft in drafts:
                draft.write_text('{"new": 1}')
        assert (outside.read_text(), path.read_text()) == ("{}", "a diary")


OWNED = {
    ("config.yml", "nerfstudio_models/a.ckpt"): (
        "config.yml", "splat.json", "nerfstudio_models/a.json", "normlift/a.ply", "dataparser_transforms.json",
        "transforms.json", "normlift/field.safetensors", "normlift/sub/a.png",
    ),
    ("cfg_args",): ("cameras.json", "input.ply", "point_cloud/iteration_7/point_cloud.ply"),
    ("cfg.yml", "ckpts/a.pt"): ("ckpts/a.json", "ply/a.ply", "stats/a.json"),
    ("transforms.json",): ("transforms.json", "images/a.png", "images_4/a.png", "masks/b/a.png", "sparse_pc.ply"),
    ("transforms_train.json",): ("transforms_test.json", "train/a.png", "test/a.png"),
    ("sparse/0/cameras.bin",): ("images/a.png", "depths/a.png", "sparse/0/points3D.ply"),
    ("colmap/sparse/0/cameras.bin",): ("colmap/a.json", "semantics/a.png"),
    (".cache/masks/a.png",): (".cache/masks/b.png",),
}  # fmt: skip
"""Files by which a run, a data set or a cache is known, and what belongs to it."""


@pytest.mark.parametrize("markers", OWNED)
def test_no_output_replaces_a_part_of_a_run_a_data_set_or_a_cache(markers: tuple[str, ...], tmp_path: Path) -> None:
    home, link = tmp_path / "home", tmp_path / "link"
    for name in (*markers, *OWNED[markers], "answers.json", "exports/a.ply"):
        (home / name).parent.mkdir(parents=True, exist_ok=True)
        (home / name).write_bytes(CONTENT.get(f"a{Path(name).suffix}", b""))
    link.symlink_to(home)
    for name in OWNED[markers]:
        (direct := tmp_path / f"direct{Path(name).suffix}").symlink_to(home / name)
        for path in (home / name, link / name, home / "exports" / ".." / name, direct):
            for overwrite in (True, False):
                with pytest.raises(InputError, match=r"part of the (run|data set|cache) .*another --flag"):
                    refuse_existing(path, overwrite=overwrite, flags="--flag")
                with pytest.raises(InputError, match="part of the"), atomic_file(path, overwrite=overwrite):
                    pytest.fail("nothing is computed")
        direct.unlink()
        assert (home / name).read_bytes() == CONTENT.get(f"a{Path(name).suffix}", b"")
    for name in set(OWNED[markers]) - {*markers} if markers[0].startswith(("config", "cfg")) else ():
        (home / name).unlink()  # nor does an output become a part of a run
        with pytest.raises(InputError, match="part of the run"):
            refuse_existing(home / name, overwrite=True, flags="--flag")
    for name in ("answers.json", "exports/a.ply", ".cache/new.json"):
        refuse_existing(home / name, overwrite=True, flags="--flag")
    with pytest.raises(InputError, match="part of the"):
        guard.refuse_inputs([tmp_path / "normlift" / ".cache" / "new.json"])


def test_no_output_replaces_an_input_by_whatever_name(tmp_path: Path) -> None:
    cloud, folder, other = tmp_path / "cloud.ply", tmp_path / "maps", tmp_path / "other.ply"
    folder.mkdir()
    for path in (cloud, folder / "a.ply", other):
        path.write_bytes(PLY)
    os.link(cloud, tmp_path / "hard.ply")
    (tmp_path / "soft.ply").symlink_to(cloud)
    guard.protect_inputs(cloud, folder, None, tmp_path / "missing")
    for path in (cloud, folder / "a.ply", tmp_path / "hard.ply", tmp_path / "soft.ply"):
        with pytest.raises(InputError, match=r"the input (file|folder) "), atomic_file(path, overwrite=True):
            pytest.fail("nothing is computed")
    refuse_existing(other, folder / "new.ply", overwrite=True, flags="--flag")
    guard.forget_inputs()
    refuse_existing(cloud, overwrite=True, flags="--flag")


READERS: dict[str, Callable[[Path], object]] = {
    "manifest.json": lambda path: read_manifest(path.parent), "evidence": lambda path: read_evidence(path, key="a"),
    "header of evidence": read_metadata, "NPY": lambda path: read_npy(path, "map"), "splat": read_ply,
    "cloud": read_cloud, "image": read_image, "texts": lambda path: TextEmbeddingFile(path).texts,
    "cameras.bin": lambda path: read_colmap_model(path.parent), "config": compose_config, "words": read_vocabulary,
    "checkpoint": lambda path: load_torch_archive(path, "", "train again"),
    "JSON": lambda path: read_json_file(path, ""), "a.jsonl": lambda path: read_jsonl(path.parent, dict),
}  # fmt: skip


@pytest.mark.parametrize("reader", READERS)
def test_no_reader_waits_or_reads_without_end(reader: str, tmp_path: Path) -> None:
    path = tmp_path / reader
    for kind in no_files(path):
        if kind in ("a folder", "a link to itself", "a pipe", "a device"):
            with pytest.raises((InputError, OSError)):
                READERS[reader](path)
    path.unlink()
    with path.open("wb") as file:
        file.truncate(2**36)  # 64 GB, which take no space
    with pytest.raises((InputError, OSError)):
        READERS[reader](path)


def test_all_readers_use_the_one_opener() -> None:
    """Other modules read only files of this package, of the system, of this process or in memory."""
    root = Path(normlift_ns.__file__).parent
    around = re.compile(r'^(?!.*>>>).*(\.read_(bytes|text)\(|open\("r|Image\.open\((?!stream|file,))', re.MULTILINE)
    found = {x.relative_to(root).as_posix() for x in root.rglob("*.py") if around.search(x.read_text("utf8"))}
    assert found == {
        "encoders/open_clip.py", "encoders/build.py", "encoders/color.py", "encoders/imagenet.py", "registry.py",
        "encoders/package_index.py", "progress.py", "server/client.py", "session/outputs.py", "io/arrays.py",
        "io/memory.py", "io/file_lock.py", "cli/demo.py", "cli/common.py",
    }  # fmt: skip


def test_the_header_of_a_ply_file_is_bounded(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    for start in (b"ply", b"ply\n", b"ply\nformat ascii 1.0\ncomment "):
        path.write_bytes(start + b"x" * 2**24)
        begin = time.process_time()
        for read in (read_ply, read_cloud):
            with pytest.raises(InputError, match="header"):
                read(path)
        assert time.process_time() - begin < 0.5  # 0.4 s per MB without the bound
