"""The commands on LangSplat's files, with real vectors of CLIP."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from PIL import Image
from scipy import ndimage
from skimage import measure

from normlift_ns import open_run
from normlift_ns.cli import lift
from normlift_ns.core.metrics import class_scores, confusion
from normlift_ns.encoders.text_files import TextEmbeddingFile
from tests.captures import SHARED, clip_vectors, needs_shared
from tests.cli.conftest import run_entry

pytestmark = needs_shared

COLOURS = "cream,light brown,teal,chocolate brown,sky blue,dark green,bright blue,pink,orange,red,yellow,green,purple"
WORDS = "curtain,mattress,doormat,table,sofa,flowerpot,crate,stool,cone,ball,doughnut,box,vase"
THINGS = dict(zip(COLOURS.split(","), WORDS.split(",")))
"""What the classes of the room are called here, by their colours."""
NOISE, UNLABELLED, SMALLEST = 1.0, 0.2, 20
"""Length of the noise on the unit vector of every mask; share of pixels without any; pixels of the smallest mask."""


def damaged(truth: NDArray, cell: int | None, vectors: NDArray, rng: np.random.Generator) -> tuple[NDArray, NDArray]:
    """One level of one image, cut by a grid of `cell` pixels: ids of masks without gaps, -1 for none; their vectors."""
    y, x = np.indices(truth.shape)
    cells = 0 if cell is None else 100 * (1 + y // cell * 1000 + x // cell)
    ids = measure.label(np.where(truth > 0, truth + cells, 0), connectivity=2)
    smooth = ndimage.gaussian_filter(rng.normal(size=ids.shape), 8)
    masked = (ids > 0) & (smooth >= np.quantile(smooth, UNLABELLED)) & (np.bincount(ids.ravel())[ids] >= SMALLEST)
    used, first = np.unique(ids[masked], return_index=True)
    noise = NOISE * unit(rng.normal(size=(len(used), vectors.shape[1])))
    return np.where(masked, np.searchsorted(used, ids), -1), unit(vectors[truth[masked][first] - 1] + noise)


def unit(rows: NDArray) -> NDArray:
    return rows / np.linalg.norm(rows, axis=-1, keepdims=True)


def write_features(capture: Path, folder: Path, vectors: NDArray, views: int) -> None:
    """What LangSplat's preprocessing would leave of the training images."""
    rng = np.random.default_rng(0)
    folder.mkdir()
    for path in sorted((capture / "instance").iterdir())[:views]:
        truth = np.asarray(Image.open(path)).astype(np.int64)
        levels = [damaged(truth, cell, vectors, rng) for cell in (None, 24, 48, None)]  # default, s, m, l
        start = np.cumsum([0, *(len(rows) for _, rows in levels)])
        segments = np.stack([np.where(ids >= 0, ids + first, -1) for (ids, _), first in zip(levels, start)])
        assert segments.max() + 1 == start[-1]
        np.save(folder / f"{path.stem}_s.npy", segments.astype(np.float32))
        table = np.concatenate([rows for _, rows in levels])
        np.save(folder / f"{path.stem}_f.npy", table.astype(np.float16).astype(np.float32))


@pytest.mark.extra
def test_damaged_masks_lift_to_the_right_things(nerfstudio, tmp_path, monkeypatch):
    """mIoU over the Gaussians of 13 classes."""
    from normlift_ns.demo.capture import write_capture, write_splatfacto_run  # noqa: PLC0415
    from tests.plain_room import plain_room  # noqa: PLC0415

    room = plain_room()
    names = json.loads((SHARED / "clip_vectors" / "lvis_v1_names.json").read_text())
    vectors = clip_vectors()[[names.index(THINGS[name]) for name in room.names]].numpy()
    write_capture(room, tmp_path / "room", held_out=1, width=320, height=240)
    trained = write_splatfacto_run(room, tmp_path / "room", tmp_path / "outputs")
    np.savez(tmp_path / "texts.npz", **dict(zip(THINGS.values(), vectors)))
    texts = TextEmbeddingFile(tmp_path / "texts.npz").text([THINGS[name] for name in room.names])

    features = tmp_path / "features"
    write_features(tmp_path / "room", features, vectors, views=24)

    def lifted(level: str) -> list[float]:
        """mIoU before and after refinement."""
        importing = ("--features", "langsplat", "--features-dir", features, "--text-embeddings", tmp_path / "texts.npz")
        flags = ("--load-config", trained, *importing, "--level", level, "--timestamp", level)
        assert run_entry(monkeypatch, lift.entrypoint, *flags) == 0
        field = open_run(trained.parents[2] / "normlift" / level / "config.yml").field
        scores = []
        for refined in (False, True):
            found = torch.where(field.valid(refined=refined), field.query(texts, refined=refined).argmax(1), -1)
            scores.append(class_scores(confusion(room.labels, found, len(room.names))).miou)
        return scores

    before, after = lifted("l")
    monkeypatch.setattr("normlift_ns.evidence_collection.rasterize_evidence", None)  # another level has its evidence
    assert after >= 0.9 and after > before + 0.02 and lifted("sum")[1] >= 0.9
