"""The cache of regions and features: what finds an entry again, and what does not."""

import random
import weakref
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch

from normlift_ns.core.device import AdaptiveBatches
from normlift_ns.encoders.base import PatchFeatures, RegionFeatures, ViewFeatures, iterate_view_features
from normlift_ns.encoders.cache import CachedEncoder, CachedRegions, cached
from normlift_ns.encoders.color import ColorEncoder
from normlift_ns.encoders.open_clip_network import OpenClipEncoder
from normlift_ns.encoders.text_files import CachedTextEncoder, open_clip_text_identity
from normlift_ns.io.arrays import save_arrays
from normlift_ns.segmentation.regions import Grid, LabelFiles
from tests.encoders.tiny import noise
from tests.io.test_digests import flipped

IMAGE = noise(20, 30)


@dataclass
class Counted:
    """Regions or an encoder that counts how often it is asked."""

    inner: object
    asked: list[str] = field(default_factory=list)

    def __getattr__(self, name):
        return getattr(self.inner, name)

    def labels(self, image, name):
        self.asked.append(name)
        return self.inner.labels(image, name)

    def encode(self, image, labels):
        self.asked.append("")
        return self.inner.encode(image, labels)

    def encode_each(self, views):
        return (self.encode(image, labels) for image, labels in views)


@pytest.fixture
def counted() -> RegionFeatures:
    return RegionFeatures(Counted(Grid(12)), Counted(ColorEncoder()))


def asked(source: RegionFeatures) -> tuple[int, int]:
    return len(source.regions.asked), len(source.encoder.asked)


def assert_same(a: ViewFeatures, b: ViewFeatures) -> None:
    assert all(torch.equal(getattr(a, name), getattr(b, name)) for name in ("labels", "features", "regions"))


def test_a_second_run_computes_nothing(counted, tmp_path):
    source = RegionFeatures(Grid(12), ColorEncoder())
    kept, expected = cached(source, tmp_path), source.view(IMAGE, "a.jpg")
    identity = {"regions": {"kind": "grid", "count": 12}, "levels": [], "encoder": {"kind": "colour", "sigma": 30.0}}
    assert kept.identity == source.identity == identity
    assert torch.equal(kept.text(["red"]), source.text(["red"]))
    for _ in range(2):  # as two runs would: nothing is held in memory
        assert_same(cached(counted, tmp_path / "new" / "folder").view(IMAGE, "a.jpg"), expected)
    assert asked(counted) == (1, 1)
    for kind in ("regions", "features"):
        assert [file.suffix for file in (tmp_path / "new" / "folder" / kind).iterdir()] == [".safetensors"]


def test_everything_that_matters_is_in_the_key(tmp_path):
    def regions(image=IMAGE, name="a.jpg", count=12):
        return CachedRegions(Grid(count), tmp_path).path(image, name)

    changed, turned = IMAGE.clone(), IMAGE.reshape(30, 20, 3)
    changed[3, 4, 2] ^= 1
    labels, other = (Grid(count).labels(IMAGE, "")[0] for count in (12, 40))

    def features(image=IMAGE, labels=labels):
        return CachedEncoder(ColorEncoder(), tmp_path).path(image, labels)

    keys = [regions(), regions(changed), regions(name="b.jpg"), regions(count=13), regions(turned)]
    keys += [features(), features(changed), features(labels=other), features(turned)]
    assert len(set(keys)) == len(keys)
    assert regions(IMAGE.clone()) == regions()
    assert features(IMAGE.clone()) == features()


def test_another_level_has_the_same_label_maps(tmp_path):
    np.save(tmp_path / "a.npy", np.stack([np.ones((20, 30), int), np.arange(600).reshape(20, 30)]))
    source = [RegionFeatures(Counted(LabelFiles(tmp_path, level=i)), Counted(ColorEncoder())) for i in range(2)]
    first, second, again = (cached(s, tmp_path / "cache").view(IMAGE, "a.jpg") for s in (*source, source[0]))
    assert [asked(s) for s in source] == [(1, 1), (0, 1)]
    assert torch.equal(first.labels, second.labels)
    assert (len(first.features), len(second.features)) == (1, 599)
    assert_same(first, again)
    for value, regions in ((0, 0), (3, 1)):  # another file is another entry
        np.save(tmp_path / "a.npy", np.full((1, 20, 30), value))
        assert len(cached(source[0], tmp_path / "cache").view(IMAGE, "a.jpg").features) == regions
    (tmp_path / "a.npy").unlink()
    with pytest.raises(FileNotFoundError, match=r"a\.jpg"):
        cached(source[0], tmp_path / "cache").view(IMAGE, "a.jpg")


def test_a_damaged_entry_is_computed_again(counted, tmp_path):
    """Cut off, empty, with other names inside, with any bit flipped; or whole, but with arrays that do not fit."""
    source, short = cached(counted, tmp_path), torch.zeros(1, 1, 20, 30, dtype=torch.int16)
    expected, asked_before = source.view(IMAGE, "a.jpg"), 1
    features = [torch.full((15, 3), 0.1), torch.full((15, 3), torch.nan), torch.eye(3)[:2], torch.ones(15)]
    features += [torch.zeros(15, 0), torch.eye(3).repeat(4, 1), torch.eye(15).half()]
    for kind, name, unfit in (
        ("regions", "labels", [short[..., :7], short[0], short[:0].int(), short - 2, short.float(), short.long()]),
        ("features", "features", features),
    ):
        (path,) = (tmp_path / kind).iterdir()
        whole = path.read_bytes()
        header = 8 + int.from_bytes(whole[:8], "little")
        wrong = [whole[: len(whole) // 2], b"", whole[:header].replace(name.encode(), b"nonsense"[: len(name)])]
        wrong[-1] += whole[header:]
        wrong += [flipped(whole, bit) for bit in random.Random(0).sample(range(8 * len(whole)), 12)]
        for array in unfit:
            save_arrays(path, {name: array.contiguous()}, key=path.stem, overwrite=True)
            wrong.append(path.read_bytes())
        for content in wrong:
            path.write_bytes(content)
            assert_same(source.view(IMAGE, "a.jpg"), expected)
            assert path.read_bytes() == whole
        assert len(getattr(counted, "regions" if kind == "regions" else "encoder").asked) == asked_before + len(wrong)


def test_many_regions_survive(tmp_path):
    labels = torch.arange(-1, 2**15 + 9, dtype=torch.int32).reshape(1, -1, 2)  # beyond 16 bits
    many = type("Many", (Grid,), {"labels": lambda *_: labels})
    for _ in range(2):
        assert torch.equal(CachedRegions(many(1), tmp_path).labels(IMAGE, "a.jpg"), labels)


def test_views_whose_features_are_kept_stand_between_others(clip, tmp_path):
    """Six regions in each of seven views, two of which are known; batches of eight crops."""
    images = [(IMAGE + 30 * i, f"{i}.jpg") for i in range(7)]
    expected = [RegionFeatures(Grid(6), clip).view(*image) for image in images]
    source, sizes = in_eights(clip, tmp_path)
    for i in (0, 3):
        source.view(*images[i])
    del sizes[:]
    for view, one in zip(iterate_view_features(source, iter(images)), expected, strict=True):
        assert torch.equal(view.labels, one.labels) and torch.equal(view.regions, one.regions)
        torch.testing.assert_close(view.features, one.features, rtol=0, atol=1e-5)
    assert sizes == [8, 8, 8, 8]
    again = iterate_view_features(cached(RegionFeatures(Grid(6), unusable(clip)), tmp_path), images)
    assert all(torch.equal(view.labels, one.labels) for view, one in zip(again, expected, strict=True))


def test_an_interruption_costs_the_views_of_one_batch(clip, tmp_path):
    source, sizes = in_eights(clip, tmp_path)
    images = [(IMAGE + 30 * i, f"{i}.jpg") for i in range(6)]

    def interrupted():
        yield from images[:5]
        raise KeyboardInterrupt

    seen = []
    with pytest.raises(KeyboardInterrupt):
        seen.extend(len(view.features) for view in iterate_view_features(source, interrupted()))
    assert sizes == [8, 8, 8]  # 24 of 30 crops: four views
    assert len(list((tmp_path / "features").iterdir())) == 4 and len(list((tmp_path / "regions").iterdir())) == 5
    del sizes[:]
    assert len(list(iterate_view_features(source, images))) == 6
    assert sizes == [8, 8]


def in_eights(encoder: OpenClipEncoder, folder: Path) -> tuple[RegionFeatures, list[int]]:
    copy, sizes = replace(encoder), []

    def counted(crops):
        sizes.append(len(crops))
        return OpenClipEncoder._image_rows(copy, crops)

    vars(copy).update(network=encoder.network, _crops=AdaptiveBatches(8), _image_rows=counted)
    return cached(RegionFeatures(Grid(6), copy), folder), sizes


def unusable(encoder: OpenClipEncoder) -> OpenClipEncoder:
    """The same settings, without a network."""
    copy = replace(encoder)
    vars(copy)["network"] = None
    return copy


def kept_texts(encoder: OpenClipEncoder, folder: Path | None) -> CachedTextEncoder:
    settings = partial(open_clip_text_identity, encoder.model, encoder.pretrained, encoder.template)
    return CachedTextEncoder(settings, lambda: encoder, folder)


def test_texts_asked_again_need_no_network(clip, tmp_path):
    prompts = ["a red mug", "table", "a red mug"]
    expected = kept_texts(clip, tmp_path / "texts").text(prompts)
    torch.testing.assert_close(expected, clip.text(prompts), rtol=0, atol=1e-6)
    again = kept_texts(unusable(clip), tmp_path / "texts")
    assert torch.equal(again.text(prompts), expected)
    assert (again.rows(prompts) == expected.numpy()).all()
    assert torch.equal(kept_texts(clip, None).text(prompts), clip.text(prompts))
    with pytest.raises(AttributeError):
        again.text(["chair"])
    for change in ({"template": "a {}"}, {"pretrained": clip.pretrained.replace(".pt", ".safetensors")}):
        with pytest.raises(AttributeError):
            kept_texts(unusable(replace(clip, **change)), tmp_path / "texts").text(["table"])
    (tmp_path / "file").write_text("")  # a folder that cannot be written to
    rows = kept_texts(clip, tmp_path / "file" / "texts").text(["table"])
    assert torch.equal(rows, clip.text(["table"]))
    with pytest.raises(ValueError, match="1 of 1"):
        kept_texts(clip, tmp_path).text([" "])


def test_patches_seen_before_need_no_network(clip, tmp_path):
    source = PatchFeatures(clip, 20)
    expected = source.view(IMAGE, "a.jpg")
    for encoder in (clip, unusable(clip)):
        kept = cached(PatchFeatures(encoder, 20), tmp_path)
        view = kept.view(IMAGE, "a.jpg")
        assert torch.equal(view.labels, expected.labels) and torch.equal(view.features, expected.features)
        assert kept.identity == source.identity and kept.available(["a.jpg"]) == ["a.jpg"]
    assert torch.equal(cached(source, tmp_path).text(["red"]), clip.text(["red"]))
    kept = cached(source, tmp_path)
    views = [weakref.ref(kept.view(IMAGE + i, "a.jpg").features) for i in (0, 1)]
    assert [view() for view in views] == [None, None]  # none is held
    with pytest.raises(AttributeError):
        cached(PatchFeatures(unusable(clip), 30), tmp_path).view(IMAGE, "a.jpg")


def test_swapped_entries_are_computed_again(counted, clip, tmp_path):
    """Content that is whole, under the name of another image."""
    source, images = cached(counted, tmp_path), ((IMAGE, "a.jpg"), (255 - IMAGE, "b.jpg"))
    expected = [source.view(*image) for image in images]
    for kind in ("regions", "features"):
        swap(tmp_path / kind)
    assert asked(counted) == (2, 2)
    for _ in range(2):
        for image, view in zip(images, expected, strict=True):
            assert_same(source.view(*image), view)
        assert asked(counted) == (4, 4)
    texts = kept_texts(clip, tmp_path / "texts")
    before = [texts.text([name]) for name in ("mug", "table")]
    swap(tmp_path / "texts")
    for name, row in zip(("mug", "table"), before, strict=True):
        torch.testing.assert_close(texts.text([name]), row, rtol=0, atol=1e-6)
    assert not torch.allclose(*before)


def swap(folder: Path) -> None:
    first, second = folder.iterdir()
    content = first.read_bytes()
    first.write_bytes(second.read_bytes())
    second.write_bytes(content)
