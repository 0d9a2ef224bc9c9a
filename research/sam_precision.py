"""Effect of the precision of SAM's network on masks of objects.

A small SAM (with a mask decoder of full width) is trained for some minutes to find the objects, parts and subparts of
synthetic images with known masks. New images are then segmented in each precision. The results are compared with
float32. For scale, float32 is also compared with itself on the same images with other pixel noise.

    python -m research.sam_precision              two minutes of training on a GPU
    python -m research.sam_precision --quick      a few steps of a smaller network on any machine, without meaning
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import torch
import transformers
from torch import Tensor
from torch.nn import Conv2d, ConvTranspose2d, Embedding, Linear
from torch.nn.functional import avg_pool2d, binary_cross_entropy_with_logits

from normlift_ns.options import SamPrecision
from normlift_ns.segmentation.mask_filtering import Suppression
from normlift_ns.segmentation.regions import stack_masks
from normlift_ns.segmentation.sam import SAM_LEVELS, MaskRules, SamLevel, SamMasks, SamNetwork, crop_boxes, point_grid
from research.report import RESULTS, Report

PRECISIONS: tuple[SamPrecision, ...] = ("float16", "bfloat16")
NOISE = 6.0
"""Standard deviation of the pixel noise, on a scale of 255."""
CLASSES = 6


@dataclass(frozen=True)
class Size:
    """Sizes of networks, images and training."""

    side: int = 128
    width: int = 192
    layers: int = 4
    batch: int = 16
    prompts: int = 16
    rate: float = 4e-4
    seconds: float = 120.0
    """Duration of the training."""
    steps: int | None = None
    """Number of training steps in place of `seconds`, which gives the same network on every machine."""
    pictures: int = 12
    height: int = 96
    """Height of the images to segment; their width is `side`."""
    points: int = 16
    seeds: int = 4
    """Number of seeds of noise."""


SMALL = Size(side=64, width=32, layers=2, batch=2, prompts=4, steps=5, pictures=2, height=48, points=5, seeds=2)


class Pictures(NamedTuple):
    """Synthetic images without noise, with their ground truth."""

    colours: Tensor
    """[B, H, W, 3] colors, in 0..255."""
    objects: Tensor
    """[B, H, W] object, or 0 for the background."""
    depth: Tensor
    """[B, H, W]: 1 in a part, 2 in a subpart, 0 elsewhere."""
    classes: Tensor
    """[B, H, W] class, in 1..CLASSES, or 0 for the background."""

    def truth(self, which: int, y: Tensor, x: Tensor) -> Tensor:
        """Return [P, 3, H, W] masks of the subpart, part and whole at points of an image.

        At a point outside of parts, the mask of the part is that of the whole, and likewise for subparts.
        """
        objects, depth = self.objects[which], self.depth[which]
        mine, deep = objects[y, x][:, None, None], depth[y, x][:, None, None]
        whole = objects == mine
        part = whole & ((depth >= 1) | (deep < 1))
        return torch.stack([part & ((depth >= 2) | (deep < 2)), part, whole], dim=1)


def make_pictures(count: int, height: int, width: int, g: torch.Generator, objects: int = 6) -> Pictures:
    """Return images of ellipses and boxes with a part and a subpart each; later ones cover earlier ones."""
    device = g.device
    y, x = torch.meshgrid(torch.arange(height, device=device), torch.arange(width, device=device), indexing="ij")

    def drawn(*shape: int) -> Tensor:
        return torch.rand(count, *shape, generator=g, device=device)[..., None, None]

    palette = 60 + 180 * torch.rand(CLASSES + 1, 3, generator=torch.Generator().manual_seed(7)).to(device)
    ground = palette[0] + 30 * (drawn(1) - 0.5 + (x / width - 0.5)[None, None])[:, 0, :, :, None]
    colours, found = ground, torch.zeros(count, height, width, dtype=torch.int64, device=device)
    depth, classes = torch.zeros_like(found), torch.zeros_like(found)
    for number in range(1, objects + 1):
        cy, cx, r, stretch, turn, kind, shade = drawn(7).unbind(dim=1)
        which = torch.randint(1, CLASSES + 1, (count, 1, 1), generator=g, device=device)
        r = (0.12 + 0.16 * r) * min(height, width)
        cosine, sine, stretch = torch.cos(math.pi * turn), torch.sin(math.pi * turn), 0.6 + 0.8 * stretch
        power = torch.where(kind < 0.5, 2.0, 8.0)
        for level, (size, shift, light) in enumerate(((1.0, 0.0, 0.0), (0.6, 0.2, 45.0), (0.3, 0.3, -45.0))):
            dy, dx = y - cy * height - shift * r * sine, x - cx * width - shift * r * cosine
            u, v = (dx * cosine + dy * sine) / (r * stretch * size), (dy * cosine - dx * sine) / (r / stretch * size)
            inside = u.abs() ** power + v.abs() ** power < 1
            if level > 0:
                inside &= (found == number) & (depth >= level - 1)
            stripes = 12 * torch.sin((6 + 8 * shade) * (u + level * v))
            colour = palette[which[:, 0, 0]][:, None, None] + 40 * (shade[..., None] - 0.5) + light + stripes[..., None]
            colours = torch.where(inside[..., None], colour, colours)
            found, depth = torch.where(inside, number, found), torch.where(inside, level, depth)
            classes = torch.where(inside, which, classes)
    return Pictures(colours, found, depth, classes)


def photographed(colours: Tensor, g: torch.Generator) -> Tensor:
    """Return colors with noise in 8 bits."""
    noise = torch.randn(colours.shape, generator=g, device=colours.device)
    return (colours + NOISE * noise).round().clamp(0, 255).to(torch.uint8)


def some_points(made: Pictures, count: int, g: torch.Generator) -> Tensor:
    """Return [2, B, P], rows and columns of points. All but an eighth are on objects if a few draws find enough."""
    pictures, height, width = made.objects.shape
    drawn = [torch.randint(0, most, (pictures, 4 * count), generator=g, device=g.device) for most in (height, width)]
    where = torch.stack(drawn)
    there = made.objects[torch.arange(pictures, device=g.device)[:, None], where[0], where[1]] > 0
    there[:, : count // 8] = True
    order = there.int().argsort(dim=1, descending=True, stable=True)[:, :count]
    return where.gather(2, order.expand(2, -1, -1))


def small_sam(size: Size) -> Any:
    """Return an untrained SAM whose mask decoder is that of the large networks."""
    vision = transformers.SamVisionConfig(
        hidden_size=size.width,
        num_hidden_layers=size.layers,
        num_attention_heads=size.width // 32,
        image_size=size.side,
        patch_size=8,
        mlp_dim=4 * size.width,
        global_attn_indexes=list(range(1, size.layers, 2)),
        window_size=8,
    )
    prompt = transformers.SamPromptEncoderConfig(image_size=size.side, patch_size=8)
    model = transformers.SamModel(transformers.SamConfig(vision_config=vision, prompt_encoder_config=prompt))
    for module in model.modules():  # as Meta begins; transformers' own beginnings are nearly 0
        if isinstance(module, Linear | Conv2d | ConvTranspose2d | Embedding):
            module.reset_parameters()
    with torch.no_grad():
        model.shared_image_embedding.positional_embedding.normal_()
        model.prompt_encoder.shared_embedding.positional_embedding = model.shared_image_embedding.positional_embedding
    return model


def losses(logits: Tensor, ious: Tensor, truth: Tensor) -> Tensor:
    """Return the loss of masks [B, P, 3, y, x] against the shares of pixels below each logit."""
    bce = binary_cross_entropy_with_logits(logits, truth)
    shown = logits.sigmoid()
    both = (shown * truth).sum(dim=(-2, -1))
    dice = 1 - (2 * both + 1) / ((shown + truth).sum(dim=(-2, -1)) + 1)
    mask, true = logits > 0, truth > 0.5
    iou = (mask & true).sum(dim=(-2, -1)) / (mask | true).sum(dim=(-2, -1)).clamp(min=1)
    return 3 * bce + 3 * dice.mean() + (ious - iou).square().mean()


def train(model: Any, size: Size, device: str) -> list[float]:
    """Train for the time or the steps of the size, and return the losses."""
    g = torch.Generator(device).manual_seed(0)
    network = SamNetwork(model, device, "float32")
    model.train()
    optimizer = torch.optim.AdamW(model.parameters(), lr=1e-3, weight_decay=0.01)
    values, start, share = [], time.perf_counter(), 0.0
    while share < 1:
        rate = size.rate * min(1.0, (len(values) + 1) / 100) * (0.5 + 0.5 * math.cos(math.pi * share))
        for group in optimizer.param_groups:
            group["lr"] = rate
        made = make_pictures(size.batch, size.side, size.side, g)
        where = some_points(made, size.prompts, g)
        truth = torch.stack([made.truth(i, where[0, i], where[1, i]) for i in range(size.batch)]).float()
        pixels = network.pixels(list(photographed(made.colours, g)))
        with torch.autocast(torch.device(device).type, torch.bfloat16, enabled=device != "cpu"):
            found = model(pixel_values=pixels, input_points=where.flip(0).permute(1, 2, 0)[:, :, None].float())
        low = avg_pool2d(truth.flatten(0, 1), size.side // found.pred_masks.shape[-1]).unflatten(0, truth.shape[:2])
        loss = losses(found.pred_masks.float(), found.iou_scores.float(), low)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimizer.step()
        values.append(float(loss.detach()))
        share = (time.perf_counter() - start) / size.seconds if size.steps is None else len(values) / size.steps
    model.eval().requires_grad_(False)
    return values


class Cut(NamedTuple):
    """Segmentation of one image by a network."""

    raw: Tensor
    """[K, y, x], masks of all prompts on the whole image."""
    levels: dict[SamLevel, Tensor]
    """Masks that pass the rules, by level."""


def cut(model: Any, image: Tensor, precision: SamPrecision, size: Size, device: str) -> Cut:
    suppression = Suppression(score=0.4)
    rules = MaskRules(size.points, predicted_iou=0.6, stability=0.8, region_area=20, edge=6, suppression=suppression)
    if size == SMALL:  # whose masks are poor
        loose = Suppression(score=-1.0)
        rules = MaskRules(size.points, predicted_iou=-9.0, stability=0.01, region_area=2, edge=1, suppression=loose)
    sam = SamMasks("nobody/nothing", device=device, precision=precision, rules=rules)
    vars(sam)["network"] = network = SamNetwork(model, device, precision)
    shape = image.shape[0], image.shape[1]
    ((x0, y0, x1, y1), *_) = crop_boxes(*shape, rules.crop_overlap)
    (embedding,) = network.embed(network.pixels([image[y0:y1, x0:x1]]))
    points = point_grid(size.points) * torch.tensor([shape[1], shape[0]])
    raw = torch.cat([logits.flatten(0, 1) > 0 for logits, _ in network.prompt(embedding, points, shape)])
    return Cut(raw, sam.masks(image))


def ious(some: Tensor, others: Tensor) -> Tensor:
    """Return [M, N], the IoU of each pair of masks."""
    a, b = some.flatten(1).double(), others.flatten(1).double()
    both = a @ b.T
    return both / (a.sum(dim=1)[:, None] + b.sum(dim=1) - both).clamp(min=1)


def compare(found: Cut, exact: Cut, made: Pictures, which: int) -> dict[str, float]:
    """Return figures of the differences between two segmentations of one image."""
    both, either = (op(found.raw, exact.raw).flatten(1).sum(dim=1) for op in (torch.logical_and, torch.logical_or))
    changed, every = 0, 0
    for level in SAM_LEVELS:
        here, there = found.levels[level], exact.levels[level]
        every += len(here) + len(there)
        if len(here) == 0 or len(there) == 0:
            changed += len(here) + len(there)
            continue
        near = ious(here, there) > 0.9
        changed += int((~near.any(dim=0)).sum() + (~near.any(dim=1)).sum())
    objects, classes = made.objects[which], made.classes[which]
    wholes = torch.stack([objects == i for i in objects.unique() if i > 0 and (objects == i).sum() > 50])
    last = found.levels["l"]
    truth = float(ious(wholes, last).amax(dim=1).mean()) if len(last) > 0 else 0.0
    return {
        "mask_iou": float((both / either.clamp(min=1))[either > 0].mean()),
        "changed_survivors": changed / max(1, every),
        "truth_iou": truth,
        "miou": label_miou(last, classes),
    }


def label_miou(masks: Tensor, classes: Tensor) -> float:
    """Return the mIoU of a label map. Each region gets the class of most of its pixels, and unlabeled pixels are
    background."""
    labels = stack_masks(masks)[0]
    shown = torch.zeros_like(classes)
    for i in labels.unique().tolist():
        if i >= 0:
            shown[labels == i] = classes[labels == i].mode().values
    of_class = [((shown == c) & (classes == c)).sum() / ((shown == c) | (classes == c)).sum() for c in classes.unique()]
    return float(torch.stack(of_class).mean())


def mean(rows: Sequence[dict[str, float]]) -> dict[str, float]:
    return {key: sum(row[key] for row in rows) / len(rows) for key in rows[0]}


def main(quick: bool, output: Path, device: str, seconds: float | None) -> None:
    size = SMALL if quick else Size()
    report = Report("sam_precision")
    torch.manual_seed(0)
    model = small_sam(size).to(device)
    values = train(model, size if seconds is None else replace(size, seconds=seconds), device)
    tail = values[-max(1, len(values) // 20) :]
    report.add("steps", len(values), "of training")
    report.add("loss", sum(tail) / len(tail), "at its end")
    made = make_pictures(size.pictures, size.height, size.side, torch.Generator(device).manual_seed(99))
    seen = photographed(made.colours, torch.Generator(device).manual_seed(1))
    exact = [cut(model, image, "float32", size, device) for image in seen]
    units = {
        "mask_iou": "of masks of prompts with those of float32",
        "changed_survivors": "share of masks after the rules without a counterpart of IoU 0.9 in float32, and back",
        "truth_iou": "of objects with the best mask of level l",
        "miou": "of label maps of level l, each region of the class that most of it has",
    }

    def compared(images: Tensor, precision: SamPrecision) -> dict[str, float]:
        cuts = [cut(model, image, precision, size, device) for image in images]
        return mean([compare(*pair, made, i) for i, pair in enumerate(zip(cuts, exact))])

    reference = compared(seen, "float32")
    report.add("masks", sum(len(each.levels["l"]) for each in exact) / len(exact), "of level l per picture")
    for key in ("truth_iou", "miou"):
        report.add(f"float32_{key}", reference[key], units[key])
    for precision in PRECISIONS:
        for key, value in compared(seen, precision).items():
            report.add(f"{precision}_{key}", value, units[key])
    seeds = [torch.Generator(device).manual_seed(2 + i) for i in range(size.seeds)]
    others = [compared(photographed(made.colours, seed), "float32") for seed in seeds]
    for key, value in mean(others).items():
        spread = torch.tensor([row[key] for row in [*others, reference][: None if key in reference else -1]]).std()
        report.add(f"noise_{key}", value, f"float32, {size.seeds} other seeds of noise: {units[key]}")
        if key in ("truth_iou", "miou"):
            report.add(f"noise_{key}_spread", spread, "standard deviation over seeds of noise")
    report.write(output)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a smaller network, a few steps")
    parser.add_argument("--seconds", type=float, help="seconds of training; 120 by default")
    parser.add_argument("--output", type=Path, default=RESULTS, help="folder of the JSON file")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    arguments = parser.parse_args()
    main(arguments.quick, arguments.output, arguments.device, arguments.seconds)
