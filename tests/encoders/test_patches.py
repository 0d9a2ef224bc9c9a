"""Dense CLIP features of a small random model, loaded from disk by the real code."""

from dataclasses import replace

import pytest
import torch

from normlift_ns.encoders.base import PatchFeatures, patch_grid
from normlift_ns.encoders.open_clip_network import patch_embeddings
from normlift_ns.options import SourceOptions
from tests.encoders.tiny import CLIP, noise, refused

IMAGE = noise(48, 80)


def value_path(model, pixels: torch.Tensor) -> torch.Tensor:
    """The last layer with an attention that looks nowhere else, without its residual and its MLP."""
    last, before = model.visual.transformer.resblocks[-1], []
    hook = last.register_forward_pre_hook(lambda module, inputs: before.append(inputs[0]))
    model.encode_image(pixels)
    hook.remove()
    tokens = last.ln_1(before[0])
    nowhere_else = torch.full((tokens.shape[1],) * 2, -torch.inf).fill_diagonal_(0)
    mixed = last.attn(tokens, tokens, tokens, need_weights=False, attn_mask=nowhere_else)[0]
    return (model.visual.ln_post(mixed) @ model.visual.proj)[:, 1:]


@torch.no_grad()
def test_tokens_are_those_of_the_value_path(clip, open_clip):
    """At the size of training, and at others against a model that open_clip makes for that size."""
    for size in ((32, 32), (48, 80), (24, 16)):
        model = open_clip.create_model(CLIP, force_image_size=size)
        open_clip.load_checkpoint(model, clip.pretrained)
        pixels = torch.randn(2, 3, *size, generator=torch.Generator().manual_seed(1))
        expected = value_path(model.eval(), pixels)
        torch.testing.assert_close(patch_embeddings(clip.network.model.visual, pixels), expected, rtol=0, atol=1e-5)


def test_features_are_the_tokens_of_the_scaled_image(clip):
    view = PatchFeatures(clip, 15).view(IMAGE, "a.jpg")
    assert patch_grid(48, 80, 15) == (3, 5)
    network = clip.network
    pixels = torch.nn.functional.interpolate(
        IMAGE.permute(2, 0, 1)[None].float(), (24, 40), mode="bicubic", antialias=True
    ).clamp(0, 255)
    tokens = patch_embeddings(network.model.visual, (pixels / 255 - network.mean) / network.std)[0]
    torch.testing.assert_close(view.features, torch.nn.functional.normalize(tokens, dim=1), rtol=0, atol=1e-5)
    y, x = torch.meshgrid(torch.arange(48) // 16, torch.arange(80) // 16, indexing="ij")
    assert torch.equal(view.labels, (5 * y + x).int())
    assert PatchFeatures(clip, 16).identity != PatchFeatures(clip, 15).identity
    refused(lambda: PatchFeatures(clip, 16).view(IMAGE.float(), "a.jpg"), "a.jpg", "uint8")


def test_patches_keep_the_shape_of_the_image_or_are_refused(clip):
    for height, width, count in ((960, 540, 1024), (31, 77, 50), (5, 9, 1024), (30, 90, 7), (9, 9, 1)):
        rows, columns = patch_grid(height, width, count)
        assert rows <= height and columns <= width
        assert rows * columns <= 1.3 * count + 1
        if min(rows, columns) > 3:
            assert rows / columns == pytest.approx(height / width, rel=0.15)
        labels = PatchFeatures(clip, count).labels(torch.zeros(height, width, 3, dtype=torch.uint8))
        assert labels.shape == (height, width)
        sizes = torch.bincount(labels.flatten())
        assert len(sizes) == rows * columns
        assert int(sizes.min()) >= (height // rows) * (width // columns)
    for model, reason in {"RN50": "convolutional", "convnext_base": "timm", "coca_ViT-B-32": "attention"}.items():
        refused(lambda model=model: PatchFeatures(replace(clip, model=model)), model, reason)
    refused(lambda: SourceOptions(region_count=0), "1", "0")
