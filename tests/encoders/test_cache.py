"""The cache of 2D features: what finds an entry again, and what does not."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
import torch

from normlift_ns.encoders import CachedFeatures, RegionFeatures, SourceOptions, ViewFeatures, make_source
from normlift_ns.encoders.colour import ColourEncoder
from normlift_ns.encoders.regions import Grid, LabelFiles

IMAGE = torch.randint(0, 256, (20, 30, 3), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)


@dataclass(frozen=True)
class Counted:
    """A source that notes which views it was asked for."""

    source: RegionFeatures
    asked: list[str] = field(default_factory=list)

    @property
    def identity(self):
        return self.source.identity

    def files(self, name):
        return self.source.files(name)

    def view(self, image, name):
        self.asked.append(name)
        return self.source.view(image, name)

    def text(self, prompts):
        return self.source.text(prompts)


@pytest.fixture
def counted() -> Counted:
    return Counted(make_source(SourceOptions(encoder="colour", regions="grid", region_count=12)))


def assert_same(a: ViewFeatures, b: ViewFeatures) -> None:
    assert torch.equal(a.labels, b.labels) and torch.equal(a.features, b.features)


def test_a_second_run_computes_nothing(counted, tmp_path):
    expected = counted.source.view(IMAGE, "a.jpg")
    for _ in range(2):  # as two runs would: nothing is held in memory
        assert_same(CachedFeatures(counted, tmp_path / "new" / "folder").view(IMAGE, "a.jpg"), expected)
    assert counted.asked == ["a.jpg"]
    files = list((tmp_path / "new" / "folder").iterdir())
    assert [file.suffix for file in files] == [".safetensors"]


def test_an_interrupted_run_resumes(counted, tmp_path):
    images = [IMAGE, 255 - IMAGE, IMAGE // 2]
    cached = CachedFeatures(counted, tmp_path)
    for i in range(2):
        cached.view(images[i], f"{i}.jpg")
    for i in range(3):
        assert_same(cached.view(images[i], f"{i}.jpg"), counted.source.view(images[i], f"{i}.jpg"))
    assert counted.asked == ["0.jpg", "1.jpg", "2.jpg"]


def test_everything_that_matters_is_in_the_key(tmp_path):
    def key(image=IMAGE, name="a.jpg", count=12):
        return CachedFeatures(RegionFeatures(Grid(count), ColourEncoder()), tmp_path).path(image, name)

    changed = IMAGE.clone()
    changed[3, 4, 2] ^= 1
    keys = [key(), key(changed), key(name="b.jpg"), key(count=13), key(IMAGE.reshape(30, 20, 3))]
    assert len(set(keys)) == len(keys)
    assert key(IMAGE.clone()) == key()


def test_another_label_file_is_another_entry(tmp_path):
    labels = tmp_path / "labels"
    labels.mkdir()
    cached = CachedFeatures(RegionFeatures(LabelFiles(labels), ColourEncoder()), tmp_path / "cache")
    for value, regions in ((0, 0), (3, 1)):
        np.save(labels / "a.npy", np.full((20, 30), value))
        assert len(cached.view(IMAGE, "a.jpg").features) == regions
    (labels / "a.npy").unlink()
    with pytest.raises(FileNotFoundError, match=r"a\.jpg has no label map"):
        cached.view(IMAGE, "a.jpg")


@pytest.mark.parametrize("damage", ["truncate", "empty", "flip", "other"])
def test_a_damaged_entry_is_computed_again(counted, tmp_path, damage):
    cached = CachedFeatures(counted, tmp_path)
    expected = cached.view(IMAGE, "a.jpg")
    path = cached.path(IMAGE, "a.jpg")
    whole = path.read_bytes()
    header = 8 + int.from_bytes(whole[:8], "little")
    path.write_bytes(
        {
            "truncate": whole[: len(whole) // 2],
            "empty": b"",
            "flip": whole[:header] + bytes(byte ^ 0x55 for byte in whole[header:]),
            "other": whole.replace(b'"features"', b'"nonsense"'),
        }[damage]
    )
    assert_same(cached.view(IMAGE, "a.jpg"), expected)
    assert counted.asked == ["a.jpg"] * 2
    assert path.read_bytes() == whole


def test_many_regions_survive(tmp_path):
    """Beyond 16-bit labels."""

    class Many(Counted):
        def view(self, image, name):
            count = 2**15 + 10
            labels = torch.arange(-1, count - 1, dtype=torch.int32).reshape(-1, 2)
            return ViewFeatures(labels, torch.ones(count, 1))

    cached = CachedFeatures(Many(RegionFeatures(Grid(1), ColourEncoder())), tmp_path)
    assert_same(cached.view(IMAGE, "a.jpg"), cached.view(IMAGE, "a.jpg"))


def test_a_full_disk_leaves_nothing_and_says_so(counted, tmp_path, monkeypatch):
    def full(self, content):
        with self.open("wb") as file:
            file.write(content[:10])
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OSError, match=r"cannot keep 2D features in .*No space left on device.*free disk space"):
        CachedFeatures(counted, tmp_path).view(IMAGE, "a.jpg")
    assert list(tmp_path.iterdir()) == []


def test_identity_and_texts_are_those_of_the_source(counted, tmp_path):
    cached = CachedFeatures(counted, tmp_path)
    assert cached.identity == {"regions": {"kind": "grid", "count": 12}, "encoder": {"kind": "colour", "sigma": 30.0}}
    assert torch.equal(cached.text(["red"]), counted.text(["red"]))
