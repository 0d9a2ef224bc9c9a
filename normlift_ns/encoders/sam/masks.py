"""Automatic masks of SAM, in the four lists of LangSplat's preprocessing.

The image and four crops of it, a 2 x 2 grid that overlaps by 512/1500 of the shorter side, are each prompted with a
grid of points. Every point gives three masks: a subpart, a part and the whole of what lies there. Level "s" holds the
first of them, "m" the second, "l" the third, "default" all three; each level goes through the same rules on its own:

1. predicted IoU and stability (the IoU of the mask with itself at two thresholds of the logits) above their bounds;
2. no side of the box at the border of a crop unless it is the border of the image too;
3. non-maximum suppression of boxes within each crop (better predicted IoU first), then across crops (smaller first);
4. small holes filled and small pieces dropped, then suppression of boxes again (untouched masks first);
5. LangSplat's suppression of masks, by stability times predicted IoU: `mask_nms`.

What survives keeps the order of the third and fourth step, which decides where masks overlap: later ones count.
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
Box = tuple[int, int, int, int]
"""(x0, y0, x1, y1), the ends outside."""
_ASIDE = 2**22
"""Wider than any image; float32 holds every whole number up to four times that."""


@dataclass(frozen=True)
class MaskRules:
    """Which masks to ask for and which to keep; the defaults are LangSplat's settings."""

    points_per_side: int = 32
    """Prompts along each side of the image and of each crop."""
    crop_overlap: float = 512 / 1500
    """How much neighbouring crops overlap, as a share of the shorter side of the image."""
    predicted_iou: float = 0.7
    """The predicted IoU of a mask must be above this."""
    stability: float = 0.85
    """The stability of a mask must be at least this."""
    stability_offset: float = 1.0
    """Distance of the two thresholds of the stability from 0, in logits."""
    edge: int = 20
    """Pixels within which a box is at a border."""
    box_iou: float = 0.7
    """Largest IoU of two boxes that both stay."""
    region_area: int = 100
    """Holes and pieces with fewer pixels are small."""
    suppression: Suppression = field(default_factory=Suppression)


class _Candidates(NamedTuple):
    """Masks that may stay."""

    logits: Float[Tensor, "c y x"]
    """At the resolution of the network."""
    channel: Int64[Tensor, " c"]
    """Which of the three masks of its point."""
    predicted_iou: Float[Tensor, " c"]
    stability: Float[Tensor, " c"]
    boxes: Int64[Tensor, "c 4"]
    """In the image, as `boxes_of` returns them."""
    crop: Int64[Tensor, " c"]

    def at(self, index: Tensor) -> _Candidates:
        return _Candidates(*(value[index] for value in self))

    def of(self, level: Level) -> Int64[Tensor, " k"]:
        """Indices of the candidates of a level."""
        mine = torch.ones_like(self.channel) if level == "default" else self.channel == LEVELS.index(level) - 1
        return mine.nonzero()[:, 0]


@dataclass(frozen=True)
class SamMasks:
    """Regions that SAM finds, one level of them. The weights are loaded at the first use.

    Raises:
        ValueError: an unknown level or precision; transformers is not installed; a name that is none.
        FileNotFoundError: a checkpoint that does not exist.
    """

    checkpoint: str = DEFAULT_SAM
    """A folder or file with weights, or a name on the hub; of SAM, SAM 2, SAM 2.1 or HQ-SAM."""
    level: Level = "l"
    """s, m, l: SAM's subparts, parts, wholes. default: all three together."""
    device: str = "cpu"
    """Where the network runs, and the rules; where its label maps are."""
    precision: SamPrecision = "auto"
    """Of the network. auto: float16 on a GPU, float32 elsewhere."""
    rules: MaskRules = field(default_factory=MaskRules)

    def __post_init__(self) -> None:
        if self.level not in LEVELS:
            raise InputError(f"SAM has the levels {', '.join(LEVELS)}; got {self.level!r}: choose with --level")
        if self.precision not in get_args(SamPrecision):
            known = ", ".join(get_args(SamPrecision))
            raise InputError(f"unknown precision of SAM {self.precision!r}; --sam-precision is one of {known}")
        check_sam(self.checkpoint)

    @property
    def identity(self) -> dict[str, Any]:
        """Files count by their content, wherever they lie."""
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
        """As in `Regions`: default, s, m, l; on the device. Raises as `masks`."""
        maps = [stack_masks(masks) for masks in self.masks(image).values()]
        depth = max(len(each) for each in maps)
        return torch.stack([pad(each, (0, 0, 0, 0, 0, depth - len(each)), value=-1) for each in maps])

    @torch.no_grad()
    def masks(
        self, image: UInt8[Tensor, "h w 3"], levels: Sequence[Level] = LEVELS
    ) -> dict[Level, Bool[Tensor, "m h w"]]:
        """The masks of some levels, on the device and in their order.

        Raises:
            FileNotFoundError: the weights cannot be downloaded.
            ValueError: a checkpoint that is damaged, of another network, or of one that the installed torch cannot run.
            MemoryError: the memory of the device does not hold a single image or prompt.
        """
        rules = self.rules
        size = image.shape[0], image.shape[1]
        crops = crop_boxes(*size, rules.crop_overlap)
        there = image.to(self.device)
        cuts = [there[y0:y1, x0:x1] for x0, y0, x1, y1 in crops]
        embeddings = self.network.embed(self.network.pixels(cuts))
        parts: list[_Candidates] = []
        alone: dict[Level, list[Tensor]] = {level: [] for level in levels}  # what stays of each crop
        for i, embedding in enumerate(embeddings):
            found, before = self._candidates(embedding, crops[i], i, size), sum(len(part.crop) for part in parts)
            every: dict[Level, Tensor] = {level: found.of(level) for level in levels}
            stay = _distinct(every, found.boxes, found.predicted_iou, rules)
            some = torch.cat(list(stay.values())).unique()
            parts.append(found.at(some))
            for level, index in stay.items():
                alone[level].append(before + torch.searchsorted(some, index))
        found = _Candidates(*map(torch.cat, zip(*parts)))
        area = torch.tensor([(x1 - x0) * (y1 - y0) for x0, y0, x1, y1 in crops], device=self.device)
        smaller_first = 1 / area[found.crop]
        joined: dict[Level, Tensor] = {level: torch.cat(index) for level, index in alone.items()}
        kept = _distinct(joined, found.boxes, smaller_first, rules)
        chosen = torch.cat(list(kept.values())).unique()
        found = found.at(chosen)
        masks = self._whole(found, crops, size)
        masks, changed = clean_masks(masks, rules.region_area)
        boxes, score = boxes_of(masks), found.stability * found.predicted_iou
        places: dict[Level, Tensor] = {level: torch.searchsorted(chosen, index) for level, index in kept.items()}
        last = _distinct(places, boxes, (~changed).float(), rules)
        return {
            level: masks[index[mask_nms(masks[index], score[index], rules.suppression)]]
            for level, index in last.items()
        }

    def _candidates(self, embedding: Tensor, crop: Box, number: int, size: tuple[int, int]) -> _Candidates:
        """The masks of one crop that are good enough and do not end where it ends."""
        x0, y0, x1, y1 = crop
        network, rules, within = self.network, self.rules, (y1 - y0, x1 - x0)
        points = point_grid(rules.points_per_side) * torch.tensor([x1 - x0, y1 - y0])
        logits, channel, predicted = [], [], []
        for masks, ious in network.prompt(embedding, points, within):
            point, which = (ious > rules.predicted_iou).nonzero(as_tuple=True)
            logits.append(masks[point, which])
            channel.append(which)
            predicted.append(ious[point, which])

        every = torch.cat(logits)
        measured = network.measure(every, within, rules.stability_offset)
        boxes, stable = measured.boxes + torch.tensor([x0, y0, x0, y0], device=every.device), measured.stability
        whole = torch.full_like(stable, number).long()
        found = _Candidates(every, torch.cat(channel), torch.cat(predicted), stable, boxes, whole)
        good = (stable >= rules.stability) & (stable > 0) & ~cut_off(boxes, crop, size, rules.edge)
        return found.at(good.nonzero()[:, 0])

    def _whole(self, found: _Candidates, crops: Sequence[Box], size: tuple[int, int]) -> Bool[Tensor, "c h w"]:
        masks = torch.zeros(len(found.crop), *size, dtype=torch.bool, device=found.crop.device)
        for i, (x0, y0, x1, y1) in enumerate(crops):
            index, within = (found.crop == i).nonzero()[:, 0], (y1 - y0, x1 - x0)
            inside = self.network.masks(partial(self._inside, within), found.logits[index])
            masks[index, y0:y1, x0:x1] = torch.cat([masks.new_zeros(0, *within), *inside])
        return masks

    def _inside(self, size: tuple[int, int], logits: Tensor) -> Tensor:
        return self.network.enlarge(logits, size) > 0

    @cached_property
    def _checkpoint(self) -> str:
        return sam_identity(self.checkpoint)

    @cached_property
    def network(self) -> PromptedNetwork:
        """The network with its weights, loaded at the first use; raises as `masks`."""
        return load_network(self.checkpoint, self.device, self.precision)


def point_grid(side: int) -> Float[Tensor, "p 2"]:
    """(x, y) of the centres of side x side cells of the unit square, row by row."""
    centre = (torch.arange(side, dtype=torch.float64) + 0.5) / side
    y, x = torch.meshgrid(centre, centre, indexing="ij")
    return torch.stack([x.flatten(), y.flatten()], dim=1)


def crop_boxes(height: int, width: int, overlap: float) -> list[Box]:
    """The whole image and four crops of it, column by column; `overlap` as a share of the shorter side.

    >>> crop_boxes(960, 540, 512 / 1500)
    [(0, 0, 540, 960), (0, 0, 362, 572), (0, 388, 362, 960), (178, 0, 540, 572), (178, 388, 540, 960)]
    """
    shared = int(overlap * min(height, width))
    w, h = math.ceil((shared + width) / 2), math.ceil((shared + height) / 2)
    corners = product((0, w - shared), (0, h - shared))
    return [(0, 0, width, height), *((x, y, min(x + w, width), min(y + h, height)) for x, y in corners)]


def cut_off(boxes: Int64[Tensor, "n 4"], crop: Box, size: tuple[int, int], edge: int) -> Bool[Tensor, " n"]:
    """Which boxes have a side within `edge` pixels of that side of the crop but not of that side of the image.

    Args:
        boxes: in the image, as `boxes_of` returns them.
        size: height and width of the image.
    """
    near_crop, near_image = (
        (boxes - torch.tensor(border, device=boxes.device)).abs() <= edge for border in (crop, (0, 0, size[1], size[0]))
    )
    return (near_crop & ~near_image).any(dim=1)


def _distinct(
    groups: Mapping[Level, Int64[Tensor, " k"]], boxes: Int64[Tensor, "n 4"], scores: Float[Tensor, " n"],
    rules: MaskRules,
) -> dict[Level, Int64[Tensor, " k"]]:  # fmt: skip
    """Non-maximum suppression of boxes within each group; what stays, highest score first, earlier ones first among
    equals.

    All groups go through one call, because each waits for the GPU: the boxes of every group are put aside.
    """
    from torchvision.ops import nms  # noqa: PLC0415 (takes a second, and not everybody asks SAM)

    index = torch.cat(list(groups.values()))
    sizes = torch.tensor([len(group) for group in groups.values()], device=index.device)
    group = torch.repeat_interleave(torch.arange(len(groups), device=index.device), sizes)
    stays = nms((boxes[index] + group[:, None] * _ASIDE).float(), scores[index], rules.box_iou)
    return {level: index[stays[group[stays] == i]] for i, level in enumerate(groups)}
