"""SAM 3: ours against a call through transformers' own processor and model, in float64."""

import json

import torch
from PIL import Image
from safetensors.torch import load_file, save_file

from normlift_ns.encoders.build import make_source
from normlift_ns.options import SourceOptions
from normlift_ns.segmentation import sam3
from normlift_ns.segmentation.sam3 import Sam3Masks, Sam3Network, TextMasks
from tests.encoders.tiny import copied, refused
from tests.segmentation.test_sam2 import photograph
from tests.segmentation.tiny_sam import SAM3_SIDE


def test_masks_are_those_of_transformers(library_weights, unsure, transformers):
    texts, side = ["mug", "red mug"], {"height": SAM3_SIDE, "width": SAM3_SIDE}
    processor = transformers.Sam3Processor(
        transformers.Sam3ImageProcessor(size=side), transformers.CLIPTokenizer.from_pretrained(library_weights / "sam3")
    )
    model = transformers.Sam3Model.from_pretrained(library_weights / "sam3").double().eval()
    network = Sam3Network.load(str(library_weights / "sam3"), "cpu")
    for size in ((60, 90), (56, 56)):
        image = photograph(*size)
        found = network.segment(image, texts)
        for text, ours in zip(texts, found):
            inputs = processor(images=Image.fromarray(image.numpy()), text=text, return_tensors="pt")
            exact = {name: x.double() if x.is_floating_point() else x for name, x in inputs.items()}
            exact.pop("original_sizes")
            with torch.no_grad():
                out = model(**exact)
            (expected,) = processor.post_process_instance_segmentation(
                out, threshold=sam3.SCORE_THRESHOLD, mask_threshold=0.5, target_sizes=[size]
            )
            assert len(ours.scores) > 0
            torch.testing.assert_close(ours.scores.double(), expected["scores"], rtol=0, atol=2e-5)
            differ = (ours.masks != expected["masks"].bool()).float().mean()
            assert ours.masks.shape == expected["masks"].shape and float(differ) < 1e-3
            assert 0.02 < float(ours.masks.float().mean()) < 0.98
        assert len(found[0].scores) < 12 and len(found[0].scores) != len(found[1].scores)


def test_checkpoints_that_are_published_hold_a_tracker_too(library_weights, tmp_path):
    """facebook/sam3 says sam3_video; the model for images is its detector."""
    config = json.loads((copied(library_weights / "sam3", tmp_path) / "config.json").read_text())
    (tmp_path / "config.json").write_text(json.dumps({"model_type": "sam3_video", "detector_config": config}))
    state = load_file(library_weights / "sam3" / "model.safetensors")
    tracker = {"tracker_model.memory": torch.zeros(3)}
    save_file({**{f"detector_model.{name}": x for name, x in state.items()}, **tracker}, tmp_path / "model.safetensors")
    found = Sam3Network.load(str(tmp_path), "cpu")._model.state_dict()
    assert all(torch.equal(found[name], value) for name, value in state.items())


def test_where_masks_overlap_the_higher_score_counts(library_weights, monkeypatch, tmp_path):
    left, right = torch.zeros(2, 10, 20, dtype=torch.bool)
    left[:, :12], right[2:, 8:] = True, True
    empty = torch.zeros(10, 20, dtype=torch.bool)
    answers = {
        "mug": TextMasks(torch.stack([left, empty]), torch.tensor([0.6, 0.9])),
        "plate": TextMasks(right[None], torch.tensor([0.8])),
    }
    monkeypatch.setattr(Sam3Network, "segment", lambda self, image, texts: [answers[text] for text in texts])
    regions = Sam3Masks(("mug", "plate"), str(library_weights / "sam3"))
    labels = regions.labels(photograph(10, 20), "a.jpg")
    assert labels.shape == (1, 2, 10, 20) and int(labels.max()) == 1
    top = labels[0, 0]
    mug, plate = int(top[0, 0]), int(top[9, 19])
    assert torch.equal(top == plate, right) and torch.equal(top == mug, left & ~right)
    assert torch.equal(top == -1, ~left & ~right)
    assert torch.equal((labels[0] == mug).any(dim=0), left)  # what the encoder sees
    # Identity holds texts and words
    mine = regions.identity
    assert Sam3Masks(("mug",), str(copied(library_weights / "sam3", tmp_path))).identity != mine
    words = tmp_path / "tokenizer.json"
    words.write_text(words.read_text() + " ")
    assert Sam3Masks(("mug", "plate"), str(tmp_path)).identity != mine


def test_what_is_refused(library_weights, tmp_path):
    refused(lambda: make_source(SourceOptions(regions="sam3", sam_model=str(library_weights / "sam3"))), "--queries")
    network = Sam3Network.load(str(library_weights / "sam3"), "cpu")
    refused(lambda: network.segment(photograph(20, 20), ["bowl " * 40]), "32 tokens", "has ")
    copied(library_weights / "sam3", tmp_path)
    for name in ("tokenizer.json", "vocab.json"):
        (tmp_path / name).unlink(missing_ok=True)
    refused(lambda: Sam3Network.load(str(tmp_path), "cpu"), str(tmp_path), "neither tokenizer.json")
    (tmp_path / "config.json").write_text(json.dumps({"model_type": "sam2"}))
    refused(lambda: Sam3Masks(("mug",), str(tmp_path)), "'sam2'", "--regions sam)", "'sam3'")
