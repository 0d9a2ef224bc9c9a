"""The encoder of ImageNet's classes: its words, its network, and the pooling of features inside regions."""

import hashlib
import io
import json
import re
from dataclasses import replace
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.nn.functional import interpolate, normalize

from normlift_ns.encoders import imagenet_network
from normlift_ns.encoders import registry as encoders
from normlift_ns.encoders.base import PatchFeatures
from normlift_ns.encoders.imagenet import find_classes
from normlift_ns.encoders.imagenet_network import EfficientNetLite2, ImageNetEncoder, load_network, pool_regions
from normlift_ns.encoders.registry import make_encoder
from normlift_ns.encoders.weights import IMAGENET
from normlift_ns.options import SourceOptions
from tests.captures import SHARED, capture, needs_shared
from tests.encoders.tiny import needs_cuda, noise, refused

IMAGE = noise(96, 80)
LABELS = (torch.arange(96 * 80).reshape(1, 96, 80) * 12 // (96 * 80)).int()
FOXES = [277, 278, 279, 280]


def test_words_name_classes() -> None:
    table = json.loads(files("normlift_ns.encoders").joinpath("imagenet_words.json").read_text("utf8"))
    ids = list(table["classes"])
    assert len(ids) == 1000 and ids == sorted(ids)
    for number, names in enumerate(table["classes"].values()):
        assert all(number in find_classes(name) for name in names.split(", "))
    for prompt, expected in (
        ("red fox", [277]), ("A Red Fox!", [277]), ("foxes", FOXES), ("the small grey-brown fox", FOXES),
        ("fox in the snow", FOXES), ("hot dog", [934]), ("dogs on a chair", list(range(151, 269))),
        ("crane", [134, 517]), ("panda", [387, 388]), ("table", [526, 532, 736]), ("cup of tea", [968]),
        ("mice", [673]), ("geese", [99]), ("churches", [497]), ("T-shirt", [610]), ("jack-o'-lantern", [607]),
    ):  # fmt: skip
        assert find_classes(prompt) == expected, prompt
    assert {423, 532, 831} <= set(find_classes("furniture")) and 281 not in find_classes("furniture")
    assert 291 not in find_classes("cat")  # a lion
    assert {407, 817, 472} <= set(find_classes("vehicles"))
    for prompt, near in (("red foxx", "red fox"), ("furnitur", "furniture"), ("artifact", "--encoder"), ("!?", "dog")):
        refused(lambda prompt=prompt: find_classes(prompt), repr(prompt), near)


@pytest.fixture(scope="module")
def state() -> dict[str, torch.Tensor]:
    """Random weights by the names in the published file."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        network = EfficientNetLite2()
    return {
        re.sub(r"(^|\.)(?=[a-z_0-9]+\.)(?!\d)", r"\1_", name): value for name, value in network.state_dict().items()
    }


def saved(state: dict[str, torch.Tensor]) -> bytes:
    file = io.BytesIO()
    torch.save(state, file)
    return file.getvalue()


@pytest.fixture
def encoder(state: dict, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ImageNetEncoder:
    content = saved(state)
    described = replace(IMAGENET, size=len(content), sha256=hashlib.sha256(content).hexdigest())
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(imagenet_network, "IMAGENET", described)
    monkeypatch.setattr(encoders, "IMAGENET", described)
    described.path.parent.mkdir(parents=True)
    described.path.write_bytes(content)
    return ImageNetEncoder()


@pytest.mark.slow
def test_the_network_is_that_of_the_published_file(state: dict) -> None:
    assert len(state) == 386 and sum(value.numel() for value in state.values()) == 6_150_232
    names = list(state)
    assert (names[0], names[-1]) == ("_conv_stem.weight", "_fc.bias") and "_blocks.20._bn2.weight" in names
    network = EfficientNetLite2().eval()
    network.load_state_dict({name.replace("._", ".").removeprefix("_"): value for name, value in state.items()})
    pixels = IMAGE.permute(2, 0, 1)[None].float()
    torch.testing.assert_close(load_network(saved(state), "cpu")(pixels), network(pixels), atol=1e-4, rtol=0)
    damaged = {**state, "_fc.weight": state["_fc.weight"][:, :-1]}
    with pytest.raises(RuntimeError):
        load_network(saved(damaged), "cpu")


def test_the_mean_of_interpolated_features_and_zeros_without_any() -> None:
    generator = torch.Generator().manual_seed(1)
    maps = torch.rand(6, 4, 3, generator=generator)
    maps[:, 3] = 0
    labels = torch.full((2, 97, 65), -1, dtype=torch.int32)  # 32 m + 1: the corners of both grids coincide
    labels[0, :50], labels[0, 50:60, 3:40], labels[0, -1:] = 0, 1, 3
    labels[1, 10:70, 30:60], labels[1, 40:80, 0] = 1, 2
    dense = interpolate(maps[None].double(), (97, 65), mode="bilinear", align_corners=True)[0]
    rows = pool_regions(maps, labels)
    for region in (0, 1, 2):
        _, y, x = (labels == region).nonzero(as_tuple=True)
        expected = normalize(dense[:, y, x].mean(1), dim=0)
        torch.testing.assert_close(rows[region].double(), expected, atol=1e-6, rtol=0)
    assert rows.shape == (4, 6) and not rows[3].any()  # the last row, whose features are zero
    assert pool_regions(maps, torch.full_like(labels, -1)).shape == (0, 6)


def test_regions_patches_and_texts_lie_in_one_space(encoder: ImageNetEncoder) -> None:
    assert json.loads(json.dumps(encoder.identity)) == encoder.identity and "network" not in vars(encoder)
    rows = encoder.encode(IMAGE, LABELS)
    assert rows.shape == (12, 1280) and ((rows.norm(dim=1) - 1).abs() < 1e-5).all()
    assert torch.equal(rows, ImageNetEncoder().encode(IMAGE, LABELS))  # bit for bit
    none = torch.full_like(LABELS, -1)
    views = [(IMAGE, LABELS), (IMAGE, none), (255 - IMAGE, LABELS)]
    shapes = [found.shape for found in encoder.encode_each(iter(views))]
    assert shapes == [(12, 1280), (0, 1280), (12, 1280)]
    view = PatchFeatures(encoder, 20).view(IMAGE, "a.png")
    assert torch.equal(view.features, encoder.encode(IMAGE, view.labels[None])) and len(view.features) == 20
    vectors = normalize(encoder.network.fc.weight.double(), dim=1)
    texts = encoder.text(["fox", "red fox"])
    torch.testing.assert_close(texts[0].double(), normalize(vectors[FOXES].sum(0), dim=0), atol=1e-6, rtol=0)
    torch.testing.assert_close(texts[1].double(), vectors[277], atol=1e-6, rtol=0)
    refused(lambda: encoder.text(["fox", "foxx"]), "'foxx'")


@needs_cuda
def test_a_gpu_sees_what_the_cpu_sees(encoder: ImageNetEncoder) -> None:
    there = ImageNetEncoder("cuda")
    assert (there.encode(IMAGE, LABELS) * encoder.encode(IMAGE, LABELS)).sum(1).min() > 0.999
    assert torch.equal(there.encode(IMAGE, LABELS), there.encode(IMAGE, LABELS))


def test_options_without_effect_and_missing_weights_are_refused(encoder: ImageNetEncoder) -> None:
    kind, options = encoders.encoder_kind("imagenet"), SourceOptions(encoder="imagenet")
    kind.check(options)
    assert isinstance(make_encoder(options), ImageNetEncoder)
    refused(lambda: make_encoder(replace(options, encoder_model="ViT-L-14")), "--encoder-model", "ViT-L-14")
    path = imagenet_network.IMAGENET.path
    path.write_bytes(bytes(len(path.read_bytes())))
    refused(lambda: encoder.text(["fox"]), str(path), "ns-normlift-weights --get imagenet")
    path.unlink()
    for call in (lambda: kind.check(options), lambda: ImageNetEncoder().encode(IMAGE, LABELS)):
        refused(call, str(path), "ns-normlift-weights --get imagenet", error=FileNotFoundError)


@pytest.mark.slow
@needs_shared
@pytest.mark.usefixtures("trained_weights")
def test_trained_weights_find_the_fox() -> None:
    """Cells of an image with hand-drawn labels, ordered by their cosine with "fox"."""
    scene = capture("fox")
    found = json.loads((SHARED / "captures" / "fox_labels.json").read_text())["labels"]
    polygon = next(np.array(x["polygon"]) for x in found if (x["image"], x["name"]) == ("0004", "fox"))
    image = scene.train[next(i for i, name in enumerate(scene.train.names) if "0004" in name)][1]
    encoder = ImageNetEncoder()
    view = PatchFeatures(encoder).view(image, "0004")
    texts = encoder.text(["fox", "red fox", "castle"])
    cosines = (view.features @ texts.T)[view.labels.long()]
    x0, y0, x1, y1 = *polygon.min(0).astype(int), *polygon.max(0).astype(int)
    box = torch.zeros(image.shape[:2], dtype=torch.bool)
    box[y0:y1, x0:x1] = True
    best = cosines[..., 0] >= cosines[..., 0].flatten().quantile(0.95)
    assert box[best].float().mean() > 0.9 and box.float().mean() < 0.6
    assert cosines[..., 0][box].mean() > cosines[..., 2][box].mean() + 0.05
