"""The CLIP encoder on a small random model, loaded from disk by the real code."""

import json
import os
import pickle
import sys
import urllib.error
import urllib.request
from dataclasses import replace

import cv2
import huggingface_hub
import numpy as np
import pytest
import timm
import torch
from safetensors.torch import save_file

from normlift_ns.encoders import SourceOptions, make_encoder
from normlift_ns.encoders.clip.crops import masked_crops, region_boxes
from normlift_ns.encoders.clip.encoder import OpenClipEncoder
from normlift_ns.encoders.clip.weights import import_open_clip
from normlift_ns.encoders.texts.kept import text_identity
from tests.encoders.tiny import CLIP as NAME
from tests.encoders.tiny import DEVICES, needs_cuda, open_clip, write_clip

IMAGE = torch.randint(0, 256, (48, 64, 3), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)
LABELS = torch.full((48, 64), -1, dtype=torch.int32)
LABELS[3:20, 5:50] = 0  # wide
LABELS[10:47, 30:41] = 1  # tall, cuts into the first
LABELS[47, 63] = 2  # a pixel in the corner
MAPS = LABELS[None]


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    """A folder with tiny.pt and tiny.safetensors of the same random weights."""
    folder = tmp_path_factory.mktemp("weights")
    write_clip(folder)
    return folder


@pytest.fixture(scope="module")
def encoder(weights):
    return OpenClipEncoder(NAME, str(weights / "tiny.pt"))


@pytest.fixture
def offline(monkeypatch, tmp_path):
    """No server, and an empty cache of the hub in the folder that is returned."""

    def refuse(*args, **kwargs):
        raise urllib.error.URLError("Name or service not known")

    monkeypatch.setattr(urllib.request, "urlopen", refuse)
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_CACHE", str(tmp_path / "hub"))
    return tmp_path / "hub"


def publish(monkeypatch, hub, weights, **settings) -> str:
    """Makes the weights those of a tag of the model, downloaded earlier; returns the tag."""
    monkeypatch.setitem(open_clip.pretrained._PRETRAINED, NAME, {"tag": {"hf_hub": "someone/tiny/", **settings}})
    repository = hub / "models--someone--tiny"
    (repository / "snapshots" / "abc").mkdir(parents=True)
    (repository / "refs").mkdir()
    (repository / "refs" / "main").write_text("abc")
    content = (weights / "tiny.safetensors").read_bytes()
    (repository / "snapshots" / "abc" / "open_clip_model.safetensors").write_bytes(content)
    return "tag"


def square_by_hand(region: int, fill: int) -> np.ndarray:
    """The crop of LangSplat's preprocessing in numpy, with inclusive boxes."""
    rows, columns = np.nonzero(LABELS.numpy() == region)
    box = slice(rows.min(), rows.max() + 1), slice(columns.min(), columns.max() + 1)
    crop = np.where(LABELS.numpy()[box][:, :, None] == region, IMAGE.numpy()[box], np.uint8(fill))
    height, width = crop.shape[:2]
    side = max(height, width)
    square = np.zeros((side, side, 3), np.uint8)
    top, left = (side - height) // 2, (side - width) // 2
    square[top : top + height, left : left + width] = crop
    return square


@pytest.mark.parametrize(("fill", "value"), [("black", 0), ("white", 255)])
@pytest.mark.parametrize(("region", "box"), [(0, [5, 3, 49, 19]), (1, [30, 10, 40, 46]), (2, [63, 47, 63, 47])])
def test_crops_are_those_of_the_protocol(region, box, fill, value):
    boxes = region_boxes(MAPS)
    assert boxes[region].tolist() == box
    chosen = torch.tensor([region])
    square = square_by_hand(region, value)
    side = len(square)
    (exact,) = masked_crops(IMAGE, MAPS, chosen, boxes[chosen], (side, side), fill)
    pixels = torch.from_numpy(square).permute(2, 0, 1).float()
    assert torch.equal(exact, pixels)
    for size in ((32, 32), (60, 45)):
        (resized,) = masked_crops(IMAGE, MAPS, chosen, boxes[chosen], size, fill)
        expected = torch.nn.functional.interpolate(pixels[None], size, mode="bilinear", align_corners=False)[0]
        torch.testing.assert_close(resized, expected, rtol=0, atol=1e-3)
        assert np.abs(resized.permute(1, 2, 0).numpy() - cv2.resize(square, size[::-1])).max() <= 1  # cv2 rounds


def test_timm_is_imported_without_wandb(monkeypatch):
    monkeypatch.delitem(sys.modules, "wandb", raising=False)
    found = []
    monkeypatch.setattr("importlib.import_module", lambda name: found.append((name, sys.modules["wandb"])))
    import_open_clip()
    assert found == [("open_clip", None)]
    assert "wandb" not in sys.modules


def test_a_crop_shows_all_of_a_region_whatever_lies_on_it():
    beneath = torch.full((48, 64), -1, dtype=torch.int32)
    beneath[10:20, 30:41] = 0  # what the second took from the first
    whole = LABELS.where(beneath == -1, 0)
    maps = torch.stack([LABELS, beneath])
    boxes, alone = region_boxes(maps), torch.stack([LABELS[None], whole[None]])
    assert torch.equal(boxes[1:], region_boxes(MAPS)[1:])
    crops = masked_crops(IMAGE, maps, torch.arange(3), boxes, (40, 40), "black")
    assert torch.equal(crops[0], masked_crops(IMAGE, alone[1], torch.tensor([0]), boxes[:1], (40, 40), "black")[0])
    assert torch.equal(crops[1], masked_crops(IMAGE, alone[0], torch.tensor([1]), boxes[1:2], (40, 40), "black")[0])


def test_features_are_those_of_the_model(encoder, weights):
    model = open_clip.create_model(NAME, pretrained=str(weights / "tiny.pt")).eval()
    mean, std = (np.array(value, np.float32) for value in (model.visual.image_mean, model.visual.image_std))
    crops = [(cv2.resize(square_by_hand(region, 0), (32, 32)) / 255 - mean) / std for region in range(3)]
    with torch.no_grad():
        expected = model.encode_image(torch.from_numpy(np.stack(crops)).permute(0, 3, 1, 2).float(), normalize=True)
    features = encoder.encode(IMAGE, MAPS)
    assert features.dtype == torch.float32 and features.shape == (3, 24)
    assert torch.linalg.vector_norm(features, dim=1).tolist() == pytest.approx([1, 1, 1], abs=1e-6)
    assert (features * expected).sum(dim=1).min() > 0.999  # but for the rounding of cv2
    assert (features @ features.T).fill_diagonal_(0).max() < 0.999  # the crops do differ


def test_texts_are_those_of_the_model(encoder, weights):
    model = open_clip.create_model(NAME, pretrained=str(weights / "tiny.pt")).eval()
    prompts = ["a red mug", "a wine bottle"]
    with torch.no_grad():
        expected = model.encode_text(open_clip.get_tokenizer(NAME)(prompts), normalize=True)
    torch.testing.assert_close(encoder.text(prompts), expected, rtol=0, atol=1e-6)


def test_templates_and_their_ensemble(encoder):
    photo = replace(encoder, template="a photo of a {}, {}")
    assert torch.equal(photo.text(["mug"]), encoder.text(["a photo of a mug, mug"]))
    prompts = ["red mug", "table"]
    for prompt, row in zip(prompts, replace(encoder, template="ensemble").text(prompts), strict=True):
        every = [template(prompt) for template in open_clip.SIMPLE_IMAGENET_TEMPLATES]
        assert len(every) == 7
        expected = torch.nn.functional.normalize(encoder.text(every).double().mean(dim=0), dim=0)
        torch.testing.assert_close(row.double(), expected, rtol=0, atol=1e-6)
    assert photo.identity == encoder.identity  # features of images stay what they are
    ours, others = (text_identity(x.model, x.pretrained, x.template) for x in (encoder, photo))
    assert ours != others


def test_batches_change_nothing(encoder):
    count = 70  # more than a batch
    labels = (torch.arange(48 * 64).reshape(1, 48, 64) * count // (48 * 64)).int()
    features = encoder.encode(IMAGE, labels)
    for region in (0, 63, 64, 69):
        single = torch.where(labels == region, 0, -1).int()
        torch.testing.assert_close(encoder.encode(IMAGE, single)[0], features[region], rtol=0, atol=1e-5)
    prompts = [f"thing {i}" for i in range(70)]
    torch.testing.assert_close(encoder.text(prompts)[64:65], encoder.text(prompts[64:65]), rtol=0, atol=1e-5)


def test_crops_of_several_views_fill_batches(encoder, monkeypatch):
    """Seven views of 0, 1, 3, 3, 0, 70 and 1 regions: 78 crops in ten batches, of which the last is filled up."""
    many = (torch.arange(48 * 64).reshape(1, 48, 64) * 70 // (48 * 64)).int()
    none, one = torch.full_like(many, -1), torch.where(MAPS == 1, 0, -1).int()
    views = [(IMAGE + 10 * i, labels) for i, labels in enumerate((none, one, MAPS, MAPS, none, many, one))]
    expected = [encoder.encode(*view) for view in views]
    sizes, rows = [], OpenClipEncoder._image_rows
    monkeypatch.setattr(
        OpenClipEncoder, "_image_rows", lambda self, crops: (sizes.append(len(crops)), rows(self, crops))[1]
    )
    found = list(encoder.encode_each(iter(views)))
    assert sizes == [8] * 10
    assert [features.shape for features in found] == [features.shape for features in expected]
    for features, alone in zip(found, expected):
        torch.testing.assert_close(features, alone, rtol=0, atol=1e-5)
    assert not torch.allclose(found[2], found[3], atol=1e-3)


def test_no_region_needs_no_weights(weights):
    encoder = OpenClipEncoder(NAME, str(weights / "tiny.pt"))
    assert encoder.encode(IMAGE, torch.full((1, 48, 64), -1, dtype=torch.int32)).shape == (0, 24)
    assert "network" not in vars(encoder)


def test_safetensors_and_pickle_agree(encoder, weights):
    other = replace(encoder, pretrained=str(weights / "tiny.safetensors"))
    assert torch.equal(other.encode(IMAGE, MAPS), encoder.encode(IMAGE, MAPS))


def test_fill_changes_features_and_identity(encoder):
    white = replace(encoder, fill="white")
    assert not torch.allclose(white.encode(IMAGE, MAPS), encoder.encode(IMAGE, MAPS), atol=1e-3)
    assert white.identity != encoder.identity


def test_a_weight_file_counts_by_its_content(encoder, weights, tmp_path):
    copy = tmp_path / "copy.pt"
    copy.write_bytes((weights / "tiny.pt").read_bytes())
    assert replace(encoder, pretrained=str(copy)).identity == encoder.identity
    assert json.loads(json.dumps(encoder.identity)) == encoder.identity
    content = bytearray(copy.read_bytes())
    content[-1] ^= 1
    copy.write_bytes(content)
    assert replace(encoder, pretrained=str(copy)).identity != encoder.identity


@needs_cuda
@pytest.mark.parametrize("fill", ["black", "white"])
def test_crops_on_a_gpu_are_those_on_the_cpu(fill):
    for size in ((32, 32), (60, 45)):
        boxes, regions = region_boxes(MAPS), torch.arange(3)
        crops = masked_crops(IMAGE, MAPS, regions, boxes, size, fill)
        there = [x.cuda() for x in (IMAGE, MAPS, regions, boxes)]
        assert torch.equal(region_boxes(there[1]).cpu(), boxes)
        torch.testing.assert_close(masked_crops(*there, size, fill).cpu(), crops, rtol=0, atol=1e-3)


@needs_cuda
def test_half_precision_costs_little(encoder):
    """On a GPU the network runs in half precision."""
    gpu = replace(encoder, device="cuda")
    assert gpu.network.model.visual.conv1.weight.dtype == torch.float16
    assert gpu.network.normalized(torch.zeros(1, 3, 32, 32, device="cuda")).dtype == torch.float16
    for on_gpu, on_cpu in (
        (gpu.encode(IMAGE, MAPS), encoder.encode(IMAGE, MAPS)),
        (gpu.text(["red"]), encoder.text(["red"])),
    ):
        assert on_gpu.dtype == torch.float32 and on_gpu.device.type == "cpu"
        assert (on_gpu * on_cpu).sum(dim=1).min() > 0.999
        assert torch.linalg.vector_norm(on_gpu, dim=1).tolist() == pytest.approx([1] * len(on_gpu), abs=1e-6)


@pytest.mark.parametrize("device", DEVICES)
def test_batches_of_several_views_shrink_until_they_fit(encoder, monkeypatch, device):
    there, rows, sizes = replace(encoder, device=device), OpenClipEncoder._image_rows, []
    expected = encoder.encode(IMAGE, MAPS)

    def narrow(self, crops):
        sizes.append(len(crops))
        if len(crops) > 4:
            raise torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 2 GiB.")
        return rows(self, crops)

    monkeypatch.setattr(OpenClipEncoder, "_image_rows", narrow)
    found = list(there.encode_each((IMAGE, MAPS) for _ in range(4)))
    if device == "cpu":
        assert sizes == [8, 4, 4, 4]
    else:  # filled up, and halved until parts fit
        assert sizes[0] == 128 and sizes.count(4) == 32 and min(sizes) == 4
    for features in found:
        assert (features * expected).sum(dim=1).min() > 0.999


class Bomb:
    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.mkdir, (self.path,)


def test_pickles_run_no_code(tmp_path, weights):
    torch.save({"state_dict": Bomb(str(tmp_path / "ran"))}, tmp_path / "bad.pt")
    with pytest.raises(ValueError, match=r"bad\.pt is damaged or not of OpenCLIP model"):
        OpenClipEncoder(NAME, str(tmp_path / "bad.pt")).text(["red"])
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize("damage", ["truncate", "empty", "pickle", "architecture"])
@pytest.mark.parametrize("file", ["tiny.pt", "tiny.safetensors"])
def test_bad_weight_files_are_named_with_a_remedy(weights, tmp_path, file, damage):
    path = tmp_path / file
    whole = (weights / file).read_bytes()
    if damage == "architecture":
        state = {"visual.conv1.weight": torch.zeros(3, 3)}
        save_file(state, path) if file.endswith("safetensors") else torch.save(state, path)
    else:
        path.write_bytes({"truncate": whole[: len(whole) // 2], "empty": b"", "pickle": pickle.dumps([1, 2])}[damage])
    with pytest.raises(ValueError, match=f"{file} is damaged or not of OpenCLIP model {NAME}.*--encoder-model") as info:
        OpenClipEncoder(NAME, str(path)).text(["red"])
    assert info.value.__suppress_context__ and "--encoder colour" in str(info.value)
    assert "\n" not in str(info.value)


def test_absent_weights_give_one_message(offline):
    encoder = make_encoder(SourceOptions())
    assert encoder.identity["pretrained"] == "laion2b_s34b_b88k"
    with pytest.raises(FileNotFoundError) as info:
        encoder.text(["red"])
    message = str(info.value)
    for part in (
        "'laion2b_s34b_b88k' of OpenCLIP model ViT-B-16",
        "laion/CLIP-ViT-B-16-laion2B-s34B-b88K",
        "Name or service not known",
        "--encoder-pretrained FILE",
        "--encoder colour",
    ):
        assert part in message
    assert info.value.__suppress_context__ and "\n" not in message


def test_cached_downloads_need_no_network(offline, weights, monkeypatch):
    tag = publish(monkeypatch, offline, weights, mean=(0.5, 0.5, 0.5), std=(0.25, 0.25, 0.25))
    encoder = OpenClipEncoder(NAME, tag)
    local = OpenClipEncoder(NAME, str(weights / "tiny.pt"))
    assert torch.equal(encoder.text(["red"]), local.text(["red"]))
    # Both take the published mean and standard deviation, not those of OpenAI.
    for network in (encoder.network, local.network):
        assert network.mean.flatten().tolist() == [0.5] * 3 and network.std.flatten().tolist() == [0.25] * 3
    assert torch.equal(encoder.encode(IMAGE, MAPS), local.encode(IMAGE, MAPS))


def test_downloads_use_the_activation_they_were_trained_with(offline, weights, monkeypatch):
    tag = publish(monkeypatch, offline, weights, quick_gelu=True)
    model = open_clip.create_model(NAME, pretrained=str(weights / "tiny.pt"), force_quick_gelu=True).eval()
    with torch.no_grad():
        expected = model.encode_text(open_clip.get_tokenizer(NAME)(["red"]), normalize=True)
    torch.testing.assert_close(OpenClipEncoder(NAME, tag).text(["red"]), expected, rtol=0, atol=1e-6)
    local = OpenClipEncoder(NAME, str(weights / "tiny.pt"))
    assert not torch.allclose(local.text(["red"]), expected, atol=1e-5)


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"encoder_model": "ViT-B/16"}, ValueError, "unknown OpenCLIP model 'ViT-B/16'.*near names: ViT-B-16"),
        ({"encoder_pretrained": "laion2b"}, ValueError, "unknown weights 'laion2b'.*laion2b_s34b_b88k"),
        ({"encoder_pretrained": "my/clip"}, FileNotFoundError, "weight file my/clip does not exist"),
        ({"encoder_pretrained": "clip.safetensors"}, FileNotFoundError, r"clip\.safetensors does not exist.*colour"),
        ({"text_template": "a photo"}, ValueError, "template 'a photo' has no {} where the text belongs"),
        (
            {"encoder": "colour", "text_template": "a {}"},
            ValueError,
            "--text-template 'a {}' is for --encoder open_clip",
        ),
        ({"crop_fill": "grey"}, ValueError, "crop_fill must be one of black, white; got 'grey'"),
    ],
)
def test_unknown_names_are_refused_before_loading(options, error, message):
    with pytest.raises(error, match=message):
        make_encoder(SourceOptions(**options))


def test_models_that_the_installed_timm_does_not_have_are_refused(monkeypatch):
    """As nerfstudio's timm 0.6.7 does not have SigLIP's."""
    if timm.__version__ != "0.6.7":
        monkeypatch.setattr(timm, "is_model", lambda name: name != "vit_base_patch16_siglip_224")
    message = (
        r"OpenCLIP model ViT-B-16-SigLIP \(--encoder-model\) needs vit_base_patch16_siglip_224 of timm, which the "
        rf"installed timm {timm.__version__} does not have .*such as ViT-B-16 or ViT-L-14"
    )
    with pytest.raises(ValueError, match=message):
        make_encoder(SourceOptions(encoder_model="ViT-B-16-SigLIP"))


@pytest.mark.parametrize("prompts", [[], [" "], "red"])
def test_prompts_are_checked(encoder, prompts):
    with pytest.raises(ValueError):
        encoder.text(prompts)
