"""SAM 3: ours against a call through transformers' own processor and model, in float64."""

import json
from pathlib import Path

import pytest
import torch
import transformers
from PIL import Image
from safetensors.torch import save_file

from normlift_ns.encoders.sam import text_masks
from normlift_ns.encoders.sam.text_masks import Sam3Masks, Sam3Network, TextMasks
from tests.encoders.test_library import photograph
from tests.encoders.tiny_library import SAM3_SIDE, write_tiny


@pytest.fixture(scope="module")
def written(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("sam3")
    write_tiny(folder, "sam3", seed=2)
    return folder


@pytest.fixture
def eager(monkeypatch) -> None:
    """Random weights are never sure."""
    monkeypatch.setattr(text_masks, "SCORE", 0.2)


@pytest.mark.parametrize("size", [(60, 90), (56, 56)])
def test_masks_are_those_of_transformers(written, eager, size):
    image, texts = photograph(*size), ["mug", "red mug"]
    found = Sam3Network.load(str(written), "cpu").find(image, texts)
    side = {"height": SAM3_SIDE, "width": SAM3_SIDE}
    processor = transformers.Sam3Processor(
        transformers.Sam3ImageProcessor(size=side), transformers.CLIPTokenizer.from_pretrained(written)
    )
    model = transformers.Sam3Model.from_pretrained(written).double().eval()
    for text, ours in zip(texts, found):
        inputs = processor(images=Image.fromarray(image.numpy()), text=text, return_tensors="pt")
        exact = {name: x.double() if x.is_floating_point() else x for name, x in inputs.items()}
        exact.pop("original_sizes")
        with torch.no_grad():
            out = model(**exact)
        (expected,) = processor.post_process_instance_segmentation(
            out, threshold=text_masks.SCORE, mask_threshold=0.5, target_sizes=[size]
        )
        assert len(ours.scores) > 0
        torch.testing.assert_close(ours.scores.double(), expected["scores"], rtol=0, atol=2e-5)
        differ = (ours.masks != expected["masks"].bool()).float().mean()
        assert ours.masks.shape == expected["masks"].shape and float(differ) < 1e-3
        assert 0.02 < float(ours.masks.float().mean()) < 0.98
    assert len(found[0].scores) < 12 and len(found[0].scores) != len(found[1].scores)


def test_checkpoints_that_are_published_hold_a_tracker_too(written, tmp_path):
    """facebook/sam3 says sam3_video; the model for images is its detector."""
    write_tiny(tmp_path, "sam3")
    config = json.loads((tmp_path / "config.json").read_text())
    (tmp_path / "config.json").write_text(json.dumps({"model_type": "sam3_video", "detector_config": config}))
    model = transformers.Sam3Model.from_pretrained(written)
    state = {f"detector_model.{name}": value for name, value in model.state_dict().items()}
    save_file({**state, "tracker_model.memory": torch.zeros(3)}, tmp_path / "model.safetensors")
    network = Sam3Network.load(str(tmp_path), "cpu")
    for name, value in network._model.state_dict().items():
        assert torch.equal(value, model.state_dict()[name])


def test_where_masks_overlap_the_higher_score_counts(written, monkeypatch):
    left, right = torch.zeros(2, 10, 20, dtype=torch.bool)
    left[:, :12], right[2:, 8:] = True, True
    empty = torch.zeros(10, 20, dtype=torch.bool)
    answers = {
        "mug": TextMasks(torch.stack([left, empty]), torch.tensor([0.6, 0.9])),
        "plate": TextMasks(right[None], torch.tensor([0.8])),
    }
    monkeypatch.setattr(Sam3Network, "find", lambda self, image, texts: [answers[text] for text in texts])
    regions = Sam3Masks(("mug", "plate"), str(written))
    labels = regions.labels(photograph(10, 20), "a.jpg")
    assert labels.shape == (1, 2, 10, 20) and int(labels.max()) == 1
    top = labels[0, 0]
    mug, plate = int(top[0, 0]), int(top[9, 19])
    assert torch.equal(top == plate, right) and torch.equal(top == mug, left & ~right)
    assert torch.equal(top == -1, ~left & ~right)
    assert torch.equal((labels[0] == mug).any(dim=0), left)  # what the encoder sees


def test_identity_holds_texts_weights_and_words(written, tmp_path):
    mine = Sam3Masks(("mug", "plate"), str(written)).identity
    assert json.loads(json.dumps(mine)) == mine
    for file in written.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    assert Sam3Masks(("mug", "plate"), str(tmp_path)).identity == mine
    assert Sam3Masks(("mug",), str(tmp_path)).identity != mine
    words = tmp_path / "tokenizer.json"
    words.write_text(words.read_text() + " ")
    assert Sam3Masks(("mug", "plate"), str(tmp_path)).identity != mine


def test_what_is_refused(written, tmp_path, monkeypatch):
    with pytest.raises(ValueError, match="name them with --queries"):
        Sam3Masks((), str(written))
    with pytest.raises(ValueError, match=r"SAM 3 reads 32 tokens of a text at most, .* has \d+"):
        Sam3Network.load(str(written), "cpu").find(photograph(20, 20), ["bowl " * 40])
    for file in written.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    (tmp_path / "tokenizer.json").unlink()
    (tmp_path / "vocab.json").unlink(missing_ok=True)
    with pytest.raises(ValueError, match=r"the folder has no tokenizer\.json"):
        Sam3Network.load(str(tmp_path), "cpu")
    (tmp_path / "config.json").write_text(json.dumps({"model_type": "sam2"}))
    with pytest.raises(ValueError, match=r"'sam2' \(SAM 2 answers points: --regions sam\), expected one of 'sam3'"):
        Sam3Masks(("mug",), str(tmp_path))
    monkeypatch.setattr(torch, "__version__", "2.5.0")
    with pytest.raises(ValueError, match=r"SAM 3 needs torch 2\.6 or newer, this is 2\.5\.0; the first SAM works"):
        Sam3Masks(("mug",), str(written))
