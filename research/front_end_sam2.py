"""Times of SAM 2's network and of the rules on its masks, for the table of `research.front_ends`.

The network is SAM 2.1 large at its real size with random weights. As for SAM, its answers are replaced by blobs, so
that the rules have masks to process.
"""

from __future__ import annotations

from typing import Any

import torch
import transformers
from torch import Tensor

from normlift_ns.segmentation.sam import MaskRules, Sam2Network, SamMasks, crop_boxes, point_grid
from research.front_end_inputs import SMALL, Injected, Size
from research.front_end_networks import seconds
from research.report import Report

LARGE: dict[str, Any] = {
    "hidden_size": 144,
    "num_attention_heads": 2,
    "blocks_per_stage": [2, 6, 36, 4],
    "embed_dim_per_stage": [144, 288, 576, 1152],
    "num_attention_heads_per_stage": [2, 4, 8, 16],
    "window_size_per_stage": [8, 4, 16, 8],
    "global_attention_blocks": [23, 33, 43],
    "window_positional_embedding_background_size": [7, 7],
}
"""Configuration of the image encoder of facebook/sam2.1-hiera-large."""
LITTLE: dict[str, Any] = {
    "hidden_size": 8,
    "blocks_per_stage": [1, 1, 2, 1],
    "embed_dim_per_stage": [8, 16, 32, 64],
    "num_attention_heads_per_stage": [1, 1, 2, 2],
    "window_size_per_stage": [4, 4, 4, 4],
    "global_attention_blocks": [3],
    "window_positional_embedding_background_size": [2, 2],
}


class InjectedSam2(Sam2Network):
    """A network whose answers are replaced by those of `Injected`, which are made once."""

    def __init__(self, model: Any, device: str, precision: Any) -> None:
        super().__init__(model, device, precision)
        self.kept: dict[tuple[float, ...], tuple[Tensor, Tensor]] = {}

    def decode(self, embedding: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
        logits, _ = super().decode(embedding, points)
        key = (len(points), *points[:1].flatten().tolist(), *points[-1:].flatten().tolist())
        if key not in self.kept:
            blobs, ious = Injected.blobs(self, points.to(logits.device), logits.shape[-1])  # type: ignore[arg-type]
            self.kept[key] = blobs.to(logits.dtype), ious
        return self.kept[key]

    @property
    def side(self) -> int:
        return self._side


def random_sam2(size: Size, device: str) -> Any:
    """Return SAM 2.1 large with random weights, or a small network for `SMALL`."""
    side, backbone = size.vision[3], LITTLE if size == SMALL else LARGE
    vision = {
        "backbone_config": {"model_type": "sam2_hiera_det_model", "image_size": [side, side], **backbone},
        "backbone_channel_list": backbone["embed_dim_per_stage"][::-1],
        "backbone_feature_sizes": [[side // step, side // step] for step in (4, 8, 16)],
    }
    config = transformers.Sam2Config(
        vision_config=vision, prompt_encoder_config={"image_size": side}, mask_decoder_config={}
    )
    with torch.device(device):
        return transformers.Sam2Model(config).eval().requires_grad_(False)


@torch.no_grad()
def add_sam2(report: Report, size: Size, image: Tensor, device: str) -> None:
    """Add the seconds per image of the network and of the whole segmentation, each with its error against float64."""
    model = random_sam2(size, device)
    network = InjectedSam2(model, device, "auto")
    crops = crop_boxes(size.height, size.width, MaskRules().crop_overlap)
    cuts = [image[y0:y1, x0:x1] for x0, y0, x1, y1 in crops]
    pixels, points = network.pixels(cuts), point_grid(size.points)
    embeddings, shape = network.embed(pixels), (size.height, size.width)

    def decode() -> None:
        for embedding in embeddings:
            for _ in network.prompt(embedding, points * torch.tensor([size.width, size.height]), shape):
                pass

    encoder_s, decoder_s = seconds(lambda: network.embed(pixels), device), seconds(decode, device)
    few = (points[:: max(1, len(points) // 8)] * network.side).float().to(device)
    half = Sam2Network.decode(network, embeddings[0], few)[0]
    last = embeddings[0][-1]
    exact = model.double()
    levels = exact.get_image_embeddings(pixels[:1].double())
    asked = {
        "input_points": few[None, :, None].double(),
        "input_labels": torch.ones(1, len(few), 1, device=device).int(),
    }
    masks = exact(image_embeddings=[x.double() for x in embeddings[0]], **asked, multimask_output=True).pred_masks[0]
    encoder_error = float((last - levels[-1]).norm() / levels[-1].norm())
    decoder_error = float((half - masks).norm() / masks.norm())
    model.float()
    report.add("sam2_encoder_s", encoder_s, f"s/image, {len(crops)} crops", encoder_error)
    report.add("sam2_decoder_s", decoder_s, f"s/image, {len(crops) * len(points)} prompts", decoder_error)
    sam = SamMasks("nobody/nothing", rules=MaskRules(points_per_side=size.points), device=device)
    vars(sam)["network"] = network
    sam.labels(image, "")
    labels_s = seconds(lambda: sam.labels(image, ""), device)
    report.add("sam2_labels_s", labels_s, "s/image, SAM 2 large, four levels of injected masks, rules included")
