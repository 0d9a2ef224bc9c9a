"""Automatic masks of SAM, in the four lists of LangSplat's preprocessing.

The image and four crops of it are each prompted with a grid of points. The crops form a 2 x 2 grid that overlaps by
512/1500 of the shorter side. Every point gives three masks: a subpart, a part and the whole of the object at the point.
Level "s" holds the first of them, "m" the second, "l" the third, and "default" all three. Each level is filtered on its
own:

1. Predicted IoU and stability must be high enough. Stability is the IoU of the mask at two thresholds of the logits.
2. No side of the box may lie at the border of a crop, unless it is also the border of the image.
3. Non-maximum suppression compares boxes within each crop (higher predicted IoU first), then across crops (smaller
   crops first).
4. Small holes are filled and small pieces dropped, then boxes are suppressed again (unchanged masks first).
5. LangSplat's suppression compares masks, scored by stability times predicted IoU; see `mask_nms`.

The masks that remain keep the order of steps 3 and 4. If masks overlap, the later one counts.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property, partial
from itertools import product
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import torch
from jaxtyping import Bool, Float, Int32, Int64, UInt8
from torch import Tensor
from torch.nn.functional import pad

from normlift_ns.encoders.sam.library import load_network
from normlift_ns.encoders.sam.network import PromptedNetwork, resolve_precision
from normlift_ns.encoders.sam.rules import Suppression, boxes_of, mask_nms, stack_masks
from normlift_ns.encoders.sam.small_regions import clean_masks
from normlift_ns.encoders.sam.weights import check_sam, sam_identity
from normlift_ns.errors import InputError
from normlift_ns.options import DEFAULT_SAM, SamPrecision

Level = Literal["default", "s", "m", "l"]
LEVELS: tuple[Level, ...] = get_args(Level)
CropBox = tuple[int, int, int, int]
"""(x0, y0, x1, y1), with x1 and y1 exclusive."""
_GROUP_OFFSET = 2**22
"""Wider than any image; float32 represents every integer up to four times this."""


@dataclass(frozen=True)
class MaskRules:
    """Prompts and thresholds of the automatic masks; the defaults are LangSplat's settings."""

    points_per_side: int = 32
    """Prompts along each side of the image and of each crop."""
    crop_overlap: float = 512 / 1500
    """Overlap of neighboring crops, as a share of the shorter side of the image."""
    predicted_iou: float = 0.7
    """Keep masks with a predicted IoU above this."""
    stability: float = 0.85
    """Keep masks with at least this stability."""
    stability_offset: float = 1.0
    """Distance from 0 of the two logit thresholds that define stability."""
    edge: int = 20
    """Boxes within this many pixels of a border touch it."""
    box_iou: float = 0.7
    """Largest IoU of two boxes that are both kept."""
    region_area: int = 100
    """Remove holes and pieces with fewer pixels than this."""
    suppression: Suppression = field(default_factory=Suppression)


class _Candidates(NamedTuple):
    """Masks before suppression."""

    logits: Float[Tensor, "c y x"]
    """Logits at the resolution of the network."""
    channel: Int64[Tensor, " c"]
    """Index of the mask among the three masks of its point."""
    predicted_iou: Float[Tensor, " c"]
    stability: Float[Tensor, " c"]
    boxes: Int64[Tensor, "c 4"]
    """Boxes in the image, as `boxes_of` returns them."""
    crop: Int64[Tensor, " c"]
    """Index of the crop."""

    def at(self, index: Tensor) -> _Candidates:
        return _Candidates(*(value[index] for value in self))

    def in_level(self, level: Level) -> Int64[Tensor, " k"]:
        """Return the indices of the candidates of a level."""
        selected = torch.ones_like(self.channel) if level == "default" else self.channel == LEVELS.index(level) - 1
        return selected.nonzero()[:, 0]


@dataclass(frozen=True)
class SamMasks:
    """Regions of one level of SAM's automatic masks. The weights are loaded at the first use.

    Raises:
        ValueError: If the level or the precision is unknown, transformers is not installed, or the checkpoint is not a
            valid name.
        FileNotFoundError: If the checkpoint is a path that does not exist.
    """

    checkpoint: str = DEFAULT_SAM
    """Folder or file with weights of SAM, SAM 2, SAM 2.1 or HQ-SAM, or a name on the Hugging Face hub."""
    level: Level = "l"
    """s, m, l: SAM's subparts, parts, wholes. default: all three together."""
    device: str = "cpu"
    """Device of the network, the mask filtering and the label maps."""
    precision: SamPrecision = "auto"
    """Precision of the network. auto: float16 on a GPU, float32 elsewhere."""
    rules: MaskRules = field(default_factory=MaskRules)

    def __post_init__(self) -> None:
        if self.level not in LEVELS:
            raise InputError(f"unknown level {self.level!r} of SAM; --level is one of {', '.join(LEVELS)}")
        if self.precision not in get_args(SamPrecision):
            known = ", ".join(get_args(SamPrecision))
            raise InputError(f"unknown precision {self.precision!r} of SAM; --sam-precision is one of {known}")
        check_sam(self.checkpoint)

    @property
    def identity(self) -> dict[str, Any]:
        """Description of the regions, with the content of the checkpoint files instead of their path."""
        precision = resolve_precision(self.precision, self.device)
        return {"kind": "sam", "checkpoint": self._checkpoint, "precision": precision, "rules": asdict(self.rules)}

    @property
    def at_once(self) -> int:
        return 1

    @property
    def chosen(self) -> tuple[int, ...]:
        return (LEVELS.index(self.level),)

    def files(self, name: str) -> tuple[Path, ...]:
        return ()

    def labels(self, image: UInt8[Tensor, "h w 3"], name: str) -> Int32[Tensor, "levels depth h w"]:
        """Return label maps of the levels default, s, m and l, on the device; raises like `masks`."""
        maps = [stack_masks(masks) for masks in self.masks(image).values()]
        depth = max(len(labels) for labels in maps)
        return torch.stack([pad(labels, (0, 0, 0, 0, 0, depth - len(labels)), value=-1) for labels in maps])

    @torch.no_grad()
    def masks(
        self, image: UInt8[Tensor, "h w 3"], levels: Sequence[Level] = LEVELS
    ) -> dict[Level, Bool[Tensor, "m h w"]]:
        """Return the masks of some levels, on the device and in their order.

        Raises:
            FileNotFoundError: If the weights cannot be downloaded.
            ValueError: If the checkpoint is damaged or of another network, or if the installed torch cannot run it.
            MemoryError: If a single image or prompt does not fit into the memory of the device.
        """
        rules = self.rules
        size = image.shape[0], image.shape[1]
        crops = crop_boxes(*size, rules.crop_overlap)
        on_device = image.to(self.device)
        crop_images = [on_device[y0:y1, x0:x1] for x0, y0, x1, y1 in crops]
        embeddings = self.network.embed(self.network.pixels(crop_images))
        parts: list[_Candidates] = []
        per_crop: dict[Level, list[Tensor]] = {level: [] for level in levels}
        for i, embedding in enumerate(embeddings):
            candidates, before = self._candidates(embedding, crops[i], i, size), sum(len(part.crop) for part in parts)
            groups: dict[Level, Tensor] = {level: candidates.in_level(level) for level in levels}
            kept = _distinct(groups, candidates.boxes, candidates.predicted_iou, rules)
            rows = torch.cat(list(kept.values())).unique()
            parts.append(candidates.at(rows))
            for level, index in kept.items():
                per_crop[level].append(before + torch.searchsorted(rows, index))
        candidates = _Candidates(*map(torch.cat, zip(*parts)))
        area = torch.tensor([(x1 - x0) * (y1 - y0) for x0, y0, x1, y1 in crops], device=self.device)
        smaller_first = 1 / area[candidates.crop]
        groups = {level: torch.cat(index) for level, index in per_crop.items()}
        kept = _distinct(groups, candidates.boxes, smaller_first, rules)
        rows = torch.cat(list(kept.values())).unique()
        candidates = candidates.at(rows)
        masks = self._image_masks(candidates, crops, size)
        masks, changed = clean_masks(masks, rules.region_area)
        boxes, score = boxes_of(masks), candidates.stability * candidates.predicted_iou
        groups = {level: torch.searchsorted(rows, index) for level, index in kept.items()}
        kept = _distinct(groups, boxes, (~changed).float(), rules)
        return {
            level: masks[index[mask_nms(masks[index], score[index], rules.suppression)]]
            for level, index in kept.items()
        }

    def _candidates(self, embedding: Tensor, crop: CropBox, number: int, size: tuple[int, int]) -> _Candidates:
        """Return the masks of one crop that are good enough and do not end at its border."""
        x0, y0, x1, y1 = crop
        network, rules, crop_size = self.network, self.rules, (y1 - y0, x1 - x0)
        points = point_grid(rules.points_per_side) * torch.tensor([x1 - x0, y1 - y0])
        parts, channels, predicted = [], [], []
        for masks, ious in network.prompt(embedding, points, crop_size):
            point, channel = (ious > rules.predicted_iou).nonzero(as_tuple=True)
            parts.append(masks[point, channel])
            channels.append(channel)
            predicted.append(ious[point, channel])

        logits = torch.cat(parts)
        measured = network.measure(logits, crop_size, rules.stability_offset)
        boxes, stability = measured.boxes + torch.tensor([x0, y0, x0, y0], device=logits.device), measured.stability
        numbers = torch.full_like(stability, number).long()
        candidates = _Candidates(logits, torch.cat(channels), torch.cat(predicted), stability, boxes, numbers)
        good = (stability >= rules.stability) & (stability > 0) & ~near_crop_edge(boxes, crop, size, rules.edge)
        return candidates.at(good.nonzero()[:, 0])

    def _image_masks(
        self, candidates: _Candidates, crops: Sequence[CropBox], size: tuple[int, int]
    ) -> Bool[Tensor, "c h w"]:
        """Return the masks at the size of the image."""
        masks = torch.zeros(len(candidates.crop), *size, dtype=torch.bool, device=candidates.crop.device)
        for i, (x0, y0, x1, y1) in enumerate(crops):
            index, crop_size = (candidates.crop == i).nonzero()[:, 0], (y1 - y0, x1 - x0)
            parts = self.network.masks(partial(self._crop_masks, crop_size), candidates.logits[index])
            masks[index, y0:y1, x0:x1] = torch.cat([masks.new_zeros(0, *crop_size), *parts])
        return masks

    def _crop_masks(self, size: tuple[int, int], logits: Tensor) -> Tensor:
        return self.network.enlarge(logits, size) > 0

    @cached_property
    def _checkpoint(self) -> str:
        return sam_identity(self.checkpoint)

    @cached_property
    def network(self) -> PromptedNetwork:
        """Network with its weights, loaded at the first use; raises like `masks`."""
        return load_network(self.checkpoint, self.device, self.precision)


def point_grid(side: int) -> Float[Tensor, "p 2"]:
    """Return (x, y) of the centers of side x side cells of the unit square, row by row."""
    center = (torch.arange(side, dtype=torch.float64) + 0.5) / side
    y, x = torch.meshgrid(center, center, indexing="ij")
    return torch.stack([x.flatten(), y.flatten()], dim=1)


def crop_boxes(height: int, width: int, overlap: float) -> list[CropBox]:
    """Return the whole image and four crops of it, column by column; `overlap` is a share of the shorter side.

    >>> crop_boxes(960, 540, 512 / 1500)
    [(0, 0, 540, 960), (0, 0, 362, 572), (0, 388, 362, 960), (178, 0, 540, 572), (178, 388, 540, 960)]
    """
    shared = int(overlap * min(height, width))
    w, h = math.ceil((shared + width) / 2), math.ceil((shared + height) / 2)
    corners = product((0, w - shared), (0, h - shared))
    return [(0, 0, width, height), *((x, y, min(x + w, width), min(y + h, height)) for x, y in corners)]


def near_crop_edge(boxes: Int64[Tensor, "n 4"], crop: CropBox, size: tuple[int, int], edge: int) -> Bool[Tensor, " n"]:
    """Return a mask of the boxes with a side within `edge` pixels of that side of the crop, but not of the image.

    Args:
        boxes: Boxes in the image, as `boxes_of` returns them.
        size: Height and width of the image.
    """
    near_crop, near_image = (
        (boxes - torch.tensor(border, device=boxes.device)).abs() <= edge for border in (crop, (0, 0, size[1], size[0]))
    )
    return (near_crop & ~near_image).any(dim=1)


def _distinct(
    groups: Mapping[Level, Int64[Tensor, " k"]], boxes: Int64[Tensor, "n 4"], scores: Float[Tensor, " n"],
    rules: MaskRules,
) -> dict[Level, Int64[Tensor, " k"]]:  # fmt: skip
    """Suppress overlapping boxes within each group (non-maximum suppression).

    One call handles all groups, because each call waits for the GPU; an offset separates the boxes of different groups.

    Returns:
        The indices that are kept by group, highest score first; among equal scores, earlier ones first.
    """
    from torchvision.ops import nms  # noqa: PLC0415 (takes a second, and only SAM needs it)

    index = torch.cat(list(groups.values()))
    sizes = torch.tensor([len(group) for group in groups.values()], device=index.device)
    group = torch.repeat_interleave(torch.arange(len(groups), device=index.device), sizes)
    kept = nms((boxes[index] + group[:, None] * _GROUP_OFFSET).float(), scores[index], rules.box_iou)
    return {level: index[kept[group[kept] == i]] for i, level in enumerate(groups)}
