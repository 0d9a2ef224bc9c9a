"""Inputs of the benchmark of the front ends: networks with random weights, and masks that no network predicts."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import open_clip
import torch
import transformers
from torch import Tensor

from normlift_ns.encoders.huggingface import MODEL_FAMILIES
from normlift_ns.encoders.huggingface_network import HuggingFaceEncoder
from normlift_ns.encoders.open_clip_network import OpenClipEncoder
from normlift_ns.options import SamPrecision
from normlift_ns.segmentation.sam import MaskRules, SamMasks, SamNetwork


@dataclass(frozen=True)
class Size:
    """Sizes of images, masks and networks."""

    height: int = 731
    width: int = 988
    masks: tuple[int, ...] = (100, 300, 1000)
    points: int = 32
    patches: int = 1024
    clip: str = "ViT-B-16"
    vision: tuple[int, int, int, int] = (1280, 32, 16, 1024)
    """Width, layers, heads and input side of SAM's image encoder."""
    cold: int = 50
    """Number of images of the process that starts without compiled kernels."""
    siglip: tuple[int, int, int, int] = (768, 12, 12, 256_000)
    """Width, layers and heads of both towers of SigLIP 2, and size of its vocabulary (default: those of the base
    model)."""


SMALL = Size(96, 128, (5, 10), 3, 30, "normlift-benchmark", (64, 2, 2, 128), 2, (32, 2, 2, 300))
SMALL_CLIP = {
    "embed_dim": 24,
    "vision_cfg": {"image_size": 32, "layers": 2, "width": 64, "head_width": 32, "patch_size": 8},
    "text_cfg": {"context_length": 77, "vocab_size": 49408, "width": 32, "heads": 2, "layers": 2},
}


def random_sam(size: Size, device: str) -> Any:
    width, layers, heads, side = size.vision
    vision = transformers.SamVisionConfig(
        hidden_size=width,
        num_hidden_layers=layers,
        num_attention_heads=heads,
        image_size=side,
        mlp_dim=4 * width,
        global_attn_indexes=[(i + 1) * layers // 4 - 1 for i in range(4)] if layers > 4 else [layers - 1],
        window_size=min(14, side // 32),
        initializer_range=0.02,
    )
    prompt = transformers.SamPromptEncoderConfig(image_size=side)
    with torch.device(device):
        return transformers.SamModel(transformers.SamConfig(vision_config=vision, prompt_encoder_config=prompt)).eval()


def random_clip(size: Size, folder: Path, device: str) -> OpenClipEncoder:
    if size.clip == SMALL.clip:
        (folder / f"{size.clip}.json").write_text(json.dumps(SMALL_CLIP))
        open_clip.add_model_config(folder / f"{size.clip}.json")
    torch.save(open_clip.create_model(size.clip).state_dict(), folder / "clip.pt")
    return OpenClipEncoder(size.clip, str(folder / "clip.pt"), device=device)


def random_siglip2(size: Size, folder: Path, device: str) -> HuggingFaceEncoder:
    """Write SigLIP 2 at 224 pixels with patches of 16 as transformers does, with a tokenizer of two tokens, and load
    it."""
    width, layers, heads, vocabulary = size.siglip
    tower = {
        "hidden_size": width,
        "intermediate_size": 4 * width,
        "num_hidden_layers": layers,
        "num_attention_heads": heads,
    }
    config = transformers.SiglipConfig(text_config={**tower, "vocab_size": vocabulary}, vision_config=tower)
    model = transformers.SiglipModel(config)
    with torch.no_grad():  # transformers leaves both at 0, which says nothing
        model.logit_scale.fill_(4.7)
        model.logit_bias.fill_(-16.0)
    tokenizer = transformers.Siglip2Tokenizer(model_input_names=["input_ids"], padding_side="right")
    model.save_pretrained(folder)
    transformers.SiglipProcessor(transformers.SiglipImageProcessor(), tokenizer).save_pretrained(folder)
    return HuggingFaceEncoder(MODEL_FAMILIES["siglip2"], str(folder), device=device)


def injected_masks(count: int, size: Size, g: torch.Generator, device: str) -> Tensor:
    """Return [count, H, W] masks that cover the image. With ten or more, half of the pixels lie in two or more of
    them."""
    area = torch.exp(1.5 * torch.randn(count, generator=g))
    radius = (area / area.sum() * size.height * size.width / torch.pi).sqrt().to(device)
    centre = (torch.rand(count, 2, generator=g) * torch.tensor([size.height, size.width])).to(device)
    x = torch.arange(size.width, device=device)
    rows = []
    for y in torch.arange(size.height, device=device):
        power = (y - centre[:, :1]) ** 2 + (x - centre[:, 1:]) ** 2 - radius[:, None] ** 2
        rows.append(power - power.amin(dim=0) < (0.6 * radius[:, None]) ** 2)
    masks = torch.stack(rows, dim=1)
    for i, (row, column) in enumerate(centre.long().tolist()):
        masks[i, row, column] = True
    return masks


def with_copies(masks: Tensor, g: torch.Generator) -> Tensor:
    """Return the masks with three in ten of them replaced by others, moved by up to two pixels."""
    masks = masks.clone()
    for i in torch.randperm(len(masks), generator=g)[: len(masks) * 3 // 10].tolist():
        other, dy, dx = torch.randint(0, len(masks), (3,), generator=g).tolist()
        masks[i] = masks[other].roll((dy % 3, dx % 3), (0, 1))
    return masks


class Injected(SamNetwork):
    """A network whose answers are replaced by blobs of three sizes around the points.

    The blobs are made once, so that making them takes no time in later calls.
    """

    side = 1024
    kept: dict[tuple[float, ...], tuple[Tensor, Tensor]]

    def decode(self, embedding: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
        logits, _ = super().decode(embedding, points)
        self.kept = getattr(self, "kept", {})
        key = (len(points), *points[:1].flatten().tolist(), *points[-1:].flatten().tolist())
        if key not in self.kept:
            blobs, ious = self.blobs(points.to(logits.device), logits.shape[-1])
            self.kept[key] = blobs.to(logits.dtype), ious
        return self.kept[key]

    def blobs(self, points: Tensor, count: int) -> tuple[Tensor, Tensor]:
        p = points[:, None, None, None, :] / self.side
        line = (torch.arange(count, device=points.device) + 0.5) / count
        y, x = torch.meshgrid(line, line, indexing="ij")
        radius = torch.tensor([0.04, 0.08, 0.16], device=points.device)[:, None, None]
        radius = radius * (1 + 0.5 * torch.sin(9 * p[..., 0] + 5 * p[..., 1]))
        waves = torch.sin(90 * x + 17 * p[..., 0]) * torch.sin(70 * y + 23 * p[..., 1])
        away = ((x - p[..., 0]) ** 2 + (y - p[..., 1]) ** 2).sqrt()
        phase = 130 * p[:, 0, 0, :, 0] + 290 * p[:, 0, 0, :, 1] + torch.arange(3, device=p.device)
        return 600 * (radius - away) + 12 * waves, 0.8 + 0.2 * torch.sin(phase)


def injected_sam(size: Size, model: Any, device: str, precision: SamPrecision = "auto") -> SamMasks:
    Injected.side = size.vision[3]
    sam = SamMasks("nobody/nothing", rules=MaskRules(points_per_side=size.points), device=device, precision=precision)
    vars(sam)["network"] = Injected(model, device, precision)
    return sam
