"""SAM's network in other precisions, compiled and not, against transformers' own code in float64."""

import pytest
import torch

from normlift_ns.encoders.open_clip_network import OpenClipEncoder
from normlift_ns.segmentation.checkpoint import load_sam_checkpoint, resolve_precision
from normlift_ns.segmentation.sam import MaskRules, SamMasks, SamNetwork, load_sam_network
from tests.encoders.tiny import SIDE, needs_cuda, noise

POINTS = torch.rand(21, 2, generator=torch.Generator().manual_seed(3)) * SIDE
BOUNDS = {"float32": 2e-6, "float16": 8e-3, "bfloat16": 4e-2}


@pytest.fixture(scope="module")
def checkpoint(sam_weights):
    return sam_weights / "sam_tiny.pth"


@pytest.fixture(scope="module")
def embedding(checkpoint):
    network = load_sam_network(str(checkpoint), "cpu")
    return network.embed(network.pixels([noise(96, 128)]))[0]


@pytest.fixture(scope="module")
def expected(checkpoint, embedding):
    return by_transformers(str(checkpoint), embedding, torch.float64)


def by_transformers(path: str, embedding: torch.Tensor, dtype: torch.dtype) -> tuple[torch.Tensor, torch.Tensor]:
    with torch.no_grad():
        found = load_sam_checkpoint(path)[1].to(dtype)(
            image_embeddings=embedding.to(dtype), input_points=POINTS[None, :, None]
        )
    return found.pred_masks[0], found.iou_scores[0]


def close(found, expected, bound: float) -> None:
    for ours, exact, scale in zip(found, expected, (float(expected[0].abs().max()), 1.0)):
        assert float((ours.cpu().double() - exact).abs().max()) < bound * scale


def test_answers_in_each_precision(checkpoint, embedding, expected):
    assert float(expected[0].std(dim=0).mean()) > 0.01 * float(expected[0].abs().max())  # masks depend on their point
    for precision, bound in BOUNDS.items():
        found = load_sam_network(str(checkpoint), "cpu", precision).decode(embedding, POINTS)
        close(found, expected, bound)
        assert found[0].dtype == getattr(torch, precision) and found[1].dtype == torch.float32
    # Overflow in float16 is answered in float32
    network = load_sam_network(str(checkpoint), "cpu", "float16")
    huge = 1e6 * embedding  # beyond float16
    masks, ious = network.decode(huge, POINTS)
    assert masks.dtype == torch.float32
    close((masks, ious), by_transformers(str(checkpoint), huge, torch.float64), 1e-4)


def test_precision_is_that_of_the_device_and_rules_find_masks(checkpoint):
    for device, auto in (("cpu", "float32"), ("cuda", "float16"), ("mps", "float32")):
        assert resolve_precision("auto", device) == auto and resolve_precision("float16", device) == "float16"
    assert SamMasks(str(checkpoint)).identity == SamMasks(str(checkpoint), precision="float32").identity
    sizes = [OpenClipEncoder(device=device)._crops.batch_size for device in ("mps", "cpu", "cuda")]
    assert sizes == [8, 8, 128]
    rules = MaskRules(points_per_side=3, predicted_iou=-9.0, stability=0.01)
    labels = SamMasks(str(checkpoint), precision="bfloat16", rules=rules).labels(noise(60, 80), "")
    assert labels.shape[0] == 4 and int(labels.max()) >= 0


@needs_cuda
def test_a_gpu_gives_the_same_answers(checkpoint, embedding, expected):
    for precision, bound in {**BOUNDS, "float32": 1e-4}.items():
        network = SamNetwork(load_sam_checkpoint(str(checkpoint))[1], "cuda", precision)
        close(network.decode(embedding.cuda(), POINTS), expected, bound)
