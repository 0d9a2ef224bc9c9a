"""Times of the front ends: SAM's network, the rules on its masks, CLIP and SigLIP 2 on their crops and in patches, SAM
2.

All networks have random weights. Masks are injected: cells of a power diagram, whose areas vary like those of objects,
each enlarged over its neighbors. For the suppression, three in ten are replaced by near copies of others. Each time is
measured after a warm-up run, except `cold_50_s`: 50 images in a separate process with empty caches of compiled kernels.

    python -m research.front_ends               SAM ViT-H and CLIP ViT-B-16, images of 988 x 731
    python -m research.front_ends --quick       small networks and images, for any machine
    python -m research.front_ends --variants    also other precisions, compiled encoders, and a profile of kernels
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import wraps
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import normalize

from normlift_ns.encoders import base as source_module
from normlift_ns.encoders.base import PatchFeatures, RegionFeatures
from normlift_ns.encoders.open_clip_network import OpenClipEncoder
from normlift_ns.segmentation import mask_filtering
from normlift_ns.segmentation import sam as network_module
from normlift_ns.segmentation import sam as sam_module
from normlift_ns.segmentation.mask_filtering import Suppression, mask_nms, remove_small_regions
from normlift_ns.segmentation.regions import stack_masks
from normlift_ns.segmentation.sam import SAM_LEVELS, MaskRules, SamMasks, SamNetwork, crop_boxes, point_grid
from research.front_end_inputs import (
    SMALL,
    Size,
    injected_masks,
    injected_sam,
    random_clip,
    random_sam,
    random_siglip2,
    with_copies,
)
from research.front_end_networks import Exact, add_networks, decode_all, seconds
from research.front_end_sam2 import add_sam2
from research.report import RESULTS, Report


@contextmanager
def stopwatch(owner: Any, name: str, device: str) -> Iterator[list[float]]:
    """Collect the seconds of every call of a function inside the context."""
    function, times = getattr(owner, name), []

    @wraps(function)
    def measured(*args: Any, **kwargs: Any) -> Any:
        start = time.perf_counter()
        result = function(*args, **kwargs)
        if device.startswith("cuda"):
            torch.cuda.synchronize()
        times.append(time.perf_counter() - start)
        return result

    setattr(owner, name, measured)
    try:
        yield times
    finally:
        setattr(owner, name, function)


def disagreements(masks: Tensor, scores: Tensor) -> float:
    """Return the share of masks on which `mask_nms` and the same rules, pair by pair in float64, disagree."""
    flat = masks.flatten(1).double()
    both, area = (flat @ flat.T).tolist(), flat.sum(dim=1).tolist()
    rules, values = Suppression(), scores.tolist()
    order = sorted(range(len(values)), key=lambda i: -values[i])
    keep = [value > rules.score for value in values]
    for a, i in enumerate(order):
        for j in order[a + 1 :]:
            inter = both[i][j]
            share_i, share_j = inter / area[i], inter / area[j]
            keep[j] &= inter / (area[i] + area[j] - inter) <= rules.iou
            keep[j] &= not (share_i < rules.outer and share_j >= rules.inner)
            keep[i] &= not (share_j < rules.outer and share_i >= rules.inner)
    return float((mask_nms(masks, scores).cpu() != torch.tensor(keep)).float().mean())


def changed_pixels(found: Tensor, exact: Tensor) -> float:
    """Return the share of pixels outside the region of an exact label map that overlaps most with their region."""
    pairs = torch.stack([found.flatten(), exact.flatten()]).long().cpu() + 1
    shared = torch.zeros(*(int(line.max()) + 1 for line in pairs))
    shared.index_put_(tuple(pairs), torch.ones(pairs.shape[1]), accumulate=True)
    return 1 - float(shared.amax(dim=1).sum()) / pairs.shape[1]


@contextmanager
def plain() -> Iterator[None]:
    """Context in which masks are enlarged in memory before they are measured."""
    kernels_apply = network_module.can_use_triton
    network_module.can_use_triton = lambda tensor: False
    try:
        yield
    finally:
        network_module.can_use_triton = kernels_apply


def cold(size: Size, device: str) -> None:
    """Print the seconds of the first images of this process, with loaded networks."""
    g = torch.Generator().manual_seed(0)
    model = random_sam(size, device)
    with tempfile.TemporaryDirectory() as folder:
        encoder = random_clip(size, Path(folder), device)
        _ = encoder.network
    source = RegionFeatures(injected_sam(size, model, device), encoder)
    shape = (size.cold, size.height, size.width, 3)
    images = torch.randint(0, 256, shape, generator=g, dtype=torch.uint8)
    start, first = time.perf_counter(), 0.0
    for i, _ in enumerate(source.views((image, f"{i}") for i, image in enumerate(images))):
        first = time.perf_counter() - start if i == 0 else first
    print(json.dumps([time.perf_counter() - start, first]))


def cold_seconds(quick: bool, device: str) -> tuple[float, float]:
    """Return the seconds of a new process without compiled kernels: for all images, and for the first."""
    with tempfile.TemporaryDirectory() as folder:
        caches = {name: f"{folder}/{name}" for name in ("TRITON_CACHE_DIR", "TORCHINDUCTOR_CACHE_DIR")}
        command = [sys.executable, "-m", "research.front_ends", "--cold", "--device", device]
        command += ["--quick"] * quick
        done = subprocess.run(command, env={**os.environ, **caches}, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise RuntimeError(done.stderr)
    every, first = json.loads(done.stdout.splitlines()[-1])
    return every, first


def print_profile(function: Callable[[], object], device: str) -> None:
    """Print the time of each kernel in one call."""
    kinds = [torch.profiler.ProfilerActivity.CPU]
    kinds += [torch.profiler.ProfilerActivity.CUDA] * device.startswith("cuda")
    with torch.profiler.profile(activities=kinds) as profile:
        function()
    by = "self_device_time_total" if device.startswith("cuda") else "self_cpu_time_total"
    print(profile.key_averages().table(sort_by=by, row_limit=30, max_name_column_width=70))


STEPS = {
    "pixels": (SamNetwork, "pixels"),
    "embed": (SamNetwork, "embed"),
    "candidates": (SamMasks, "_candidates"),  # the mask decoder and measuring included
    "decode": (SamNetwork, "decode"),
    "measure": (SamNetwork, "measure"),
    "distinct": (sam_module, "_distinct"),
    "whole": (SamMasks, "_image_masks"),
    "clean": (mask_filtering, "remove_small_regions"),
    "nms": (mask_filtering, "mask_nms"),
    "stack": (sam_module, "stack_masks"),
}


def add_siglip2(report: Report, size: Size, image: Tensor, g: torch.Generator, device: str) -> None:
    """Add SigLIP 2 base on crops of masks and in patches; errors are relative to float32 on the CPU."""
    with tempfile.TemporaryDirectory() as folder:
        encoder = random_siglip2(size, Path(folder), device)
        exact = replace(encoder, device="cpu")
        _ = encoder.network, exact.network
    for count in size.masks[:2]:
        labels = stack_masks(injected_masks(count, size, g, device))
        encode_s = seconds(lambda labels=labels: encoder.encode(image, labels), device)
        few = labels.where(labels < 8, -1)
        off = (1 - (encoder.encode(image, few) * exact.encode(image, few.cpu())).sum(dim=1)).abs().max()
        report.add(f"siglip2_encode_{count}_s", encode_s, f"s/image, SigLIP 2 base on {count} masks", off)
    patches, near = PatchFeatures(encoder, size.patches), PatchFeatures(exact, size.patches)
    off = (1 - (patches.features(image, "") * near.features(image, "")).sum(dim=1)).abs().max()
    time_s = seconds(lambda: patches.features(image, ""), device)
    report.add("siglip2_patches_s", time_s, f"s/image, SigLIP 2 base in {size.patches} patches", off)


def main(quick: bool, output: Path, device: str, variants: bool) -> None:
    size = SMALL if quick else Size()
    report, g = Report("front_ends"), torch.Generator().manual_seed(0)
    image = torch.randint(0, 256, (size.height, size.width, 3), generator=g, dtype=torch.uint8)
    model = random_sam(size, device).requires_grad_(False)
    sam = injected_sam(size, model, device)
    network: Any = sam.network

    crops = crop_boxes(size.height, size.width, MaskRules().crop_overlap)
    pixels = network.pixels([image[y0:y1, x0:x1] for x0, y0, x1, y1 in crops])
    embeddings, points = network.embed(pixels), point_grid(size.points).float() * size.vision[3]
    exact_answers = Exact.of(model, pixels, points[:: max(1, len(points) // 8)])

    encoder_s = seconds(lambda: network.embed(pixels), device)
    decoder_s = seconds(lambda: decode_all(network, embeddings, points), device)
    sam_s = encoder_s + decoder_s
    report.add("sam_encoder_s", encoder_s, f"s/image, {len(crops)} crops", exact_answers.encoder_error(network, pixels))
    unit = f"s/image, {len(crops) * len(points)} prompts"
    report.add("sam_decoder_s", decoder_s, unit, exact_answers.decoder_error(network))
    report.add("sam_network_rate", 1 / sam_s, "images/s, network alone")
    add_networks(report, model, pixels, points, device, exact_answers, variants)
    found = sam.masks(image)
    labels_s = seconds(lambda: sam.labels(image, ""), device)
    report.add("sam_labels_s", labels_s, "s/image, four levels of injected masks, rules included")
    for level in SAM_LEVELS:
        report.add(f"sam_masks_{level}", len(found[level]), "masks")
    report.add("sam_rules_share", (labels_s - sam_s) / sam_s, "of the network's time")
    for step, (owner, name) in STEPS.items():
        with stopwatch(owner, name, device) as times:
            sam.labels(image, "")
        report.add(f"sam_labels_{step}_s", sum(times), f"of these, calls of {name}")

    with tempfile.TemporaryDirectory() as folder:
        encoder = random_clip(size, Path(folder), device)
        exact = replace(encoder, device="cpu")
        _ = encoder.network, exact.network
    for count in size.masks:
        masks = injected_masks(count, size, g, device)
        copies, scores = with_copies(masks, g), (0.6 + 0.4 * torch.rand(count, generator=g)).to(device)
        nms_s = seconds(lambda copies=copies, scores=scores: mask_nms(copies, scores), device)
        clean_s = seconds(lambda copies=copies: remove_small_regions(copies, MaskRules().region_area), device)
        labels = stack_masks(masks)
        encode_s = seconds(lambda labels=labels: encoder.encode(image, labels), device)
        few = labels.where(labels < 8, -1)
        off = (1 - (encoder.encode(image, few) * exact.encode(image, few.cpu())).sum(dim=1)).abs().max()
        report.add(f"nms_{count}_s", nms_s, "s/level", disagreements(copies, scores))
        report.add(f"clean_{count}_s", clean_s, "s/level")
        report.add(f"encode_{count}_s", encode_s, f"s/level, {len(labels)} deep", off)
        share = (nms_s + encode_s) / sam_s
        report.add(f"share_{count}", share, "NMS + encoding over SAM's network, one level")
        report.add(f"share_clean_{count}", share + clean_s / sam_s, "the same with repair of small regions")
    source = RegionFeatures(sam, encoder)
    with plain():
        whole = injected_sam(size, model, device, "float32").labels(image, "")
    off = changed_pixels(sam.labels(image, "")[-1, 0], whole[-1, 0])
    what = f"network, rules, CLIP on {len(found['l'])} masks of level l"
    view_s = seconds(lambda: source.view(image, ""), device)
    report.add("view_s", view_s, f"s/image, all of it: {what}", off)
    for step, (owner, name) in {
        "labels": (SamMasks, "labels"),
        "partition": (source_module, "joint_partition"),
        "clip": (OpenClipEncoder, "_image_rows"),
    }.items():
        with stopwatch(owner, name, device) as times:
            source.view(image, "")
        report.add(f"view_{step}_s", sum(times), f"of these, calls of {name}")
    cold_s, first_s = cold_seconds(quick, device)
    report.add(
        f"cold_{size.cold}_s", cold_s, f"s for {size.cold} images, without compiled kernels, of a new process", off
    )
    report.add("cold_first_s", first_s, "s of these for the first")
    if variants:
        print_profile(lambda: source.view(image, ""), device)
    patches = PatchFeatures(encoder, size.patches)
    near = PatchFeatures(exact, size.patches).features(image, "")
    off = (1 - (normalize(patches.features(image, ""), dim=1) * near).sum(dim=1)).abs().max()
    report.add("patches_s", seconds(lambda: patches.features(image, ""), device), "s/image", off)
    add_siglip2(report, size, image, g, device)
    add_sam2(report, size, image, device)
    if device == "cuda":
        report.add("gpu_peak_gib", torch.cuda.max_memory_allocated() / 2**30, "GiB")
    report.write(output)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="small networks and images")
    parser.add_argument("--variants", action="store_true", help="other precisions, compiled encoders, a profile")
    parser.add_argument("--cold", action="store_true", help="only time some images in this process")
    parser.add_argument("--output", type=Path, default=RESULTS, help="folder of the JSON file")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    arguments = parser.parse_args()
    if arguments.cold:
        cold(SMALL if arguments.quick else Size(), arguments.device)
    else:
        main(arguments.quick, arguments.output, arguments.device, arguments.variants)
