"""Lift of SAM 3 masks, with two regions per prompt and view: inside and outside the mask.

The relevancy of a Gaussian for a prompt is the fraction of its weight inside the masks of the voting views, sum_v E_in
/ sum_v (E_in + E_out). The weights are those of the rasterizer with which the scene was trained.

The mask of a whole view can be wrong, because SAM 3 misses an object or confuses it with another one. Two rounds
therefore determine the voting views. In the first round, all views in which SAM 3 found the prompt vote. In the second
round, a view votes if the weighted intersection over union of its mask and the Gaussians selected in the first round
exceeds one half. It also votes if both are empty. If SAM 3 found the prompt in none of these views, the result is that
of the first round.

All pixels of a view that does not vote are unlabeled. The lift counts them with `unlabeled="dilute"`, so they lower the
reliability of the Gaussians that they show. Agreement and reliability are those of `core.lift` for two regions per
view, inside and outside, with the features (1, 0) and (0, 1).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Int32, UInt8
from torch import Tensor

from normlift_ns.core.evidence import MASKED, Evidence
from normlift_ns.core.gaussians import Camera, GaussianScene
from normlift_ns.core.lift import Scalars, lift
from normlift_ns.core.scene import Scene
from normlift_ns.encoders.base import joint_partition
from normlift_ns.errors import InputError
from normlift_ns.evidence_collection import sample_evenly
from normlift_ns.query.engine import SelectionStats
from normlift_ns.rasterization.rasterize import rasterize_evidence
from normlift_ns.rasterization.settings import RasterSettings

MIN_MASK_FRACTION = 0.5
"""A Gaussian is selected if the fraction of its weight inside the masks exceeds this number."""


@dataclass(frozen=True)
class MaskResult:
    """Result of lifting the masks of one prompt."""

    relevancy: Float[Tensor, " n"]
    """Fraction of each Gaussian's weight inside the masks, in 0..1; 0 for Gaussians without weight in voting views."""
    scalars: Scalars
    """Scalars of the lift with two regions per view. c_inter is the agreement of the voting views."""
    voting_views: Bool[Tensor, " v"]
    """Mask of the voting views in which SAM 3 found the prompt."""

    @property
    def is_visible(self) -> Bool[Tensor, " n"]:
        """Mask of the Gaussians that have weight in one or more views."""
        return self.scalars.weight > 0

    @property
    def mask(self) -> Bool[Tensor, " n"]:
        """Mask of the Gaussians with more than half of their weight inside the masks."""
        return self.relevancy > MIN_MASK_FRACTION


@dataclass(frozen=True)
class MaskEvidence:
    """Evidence of the masks of Q prompts in V views.

    >>> import torch
    >>> from normlift_ns import Camera, GaussianScene
    >>> means, quats = torch.tensor([[-0.5, 0, 1], [0.5, 0, 1]]), torch.tensor([[1.0, 0, 0, 0]]).expand(2, 4)
    >>> scene = GaussianScene(means, quats, scales=torch.full((2, 3), 0.01), opacities=torch.full((2,), 0.9))
    >>> camera = Camera(torch.tensor([[32.0, 0, 32], [0, 32, 16], [0, 0, 1]]), torch.eye(4), width=64, height=32)
    >>> left = torch.zeros(1, 32, 64, dtype=torch.bool)
    >>> left[:, :, :32] = True
    >>> evidence = mask_evidence(scene, [camera, camera], [left, left])
    >>> answer = evidence.answer(0)
    >>> answer.relevancy, answer.scalars.reliability  # two views that agree: 2 / (2 + 1)
    (tensor([1., 0.]), tensor([0.6667, 0.6667]))
    """

    evidence: Evidence
    """Evidence of cells; the masks of all prompts together partition each view into these cells."""
    inside: Bool[Tensor, "q s"]
    """True for the cells inside the mask of each prompt."""

    def answer(self, text: int) -> MaskResult:
        """Lift the masks of the prompt with index `text`."""
        evidence, inside = self.evidence, self.inside[text]
        column, weight = evidence.rows.column.long(), evidence.rows.weight.double()
        row, view = evidence.rows.row_index(), evidence.region_view[column].long()
        within = inside[column]

        def share(votes: Bool[Tensor, " v"]) -> Float[Tensor, " n"]:
            in_masks, total = weight.new_zeros(2, evidence.num_gaussians)
            total.index_add_(0, row, weight * votes[view])
            in_masks.index_add_(0, row, weight * (votes[view] & within))
            return torch.where(total > 0, in_masks / total, 0.0)

        has_mask = torch.zeros(evidence.num_views, dtype=torch.bool, device=inside.device)
        has_mask[evidence.region_view[inside].long()] = True
        selected = share(has_mask)[row] > MIN_MASK_FRACTION
        intersection, union = weight.new_zeros(2, evidence.num_views)
        intersection.index_add_(0, view, weight * (within & selected))
        union.index_add_(0, view, weight * (within | selected))
        votes = (intersection > 0.5 * union) | (union == 0)
        votes = votes if bool((votes & has_mask).any()) else has_mask
        sides = torch.where(votes[evidence.region_view.long()], 2 * evidence.region_view + (~inside).int(), -1)
        side_view = torch.arange(evidence.num_views, dtype=torch.int32, device=inside.device).repeat_interleave(2)
        table = torch.eye(2, device=inside.device, dtype=evidence.rows.weight.dtype).repeat(evidence.num_views, 1)
        scalars = lift(evidence.regroup(sides[None], side_view), table, unlabeled="dilute").scalars
        relevancy = torch.where(scalars.norm > 0, share(votes), 0.0).to(scalars.norm.dtype)
        return MaskResult(relevancy, scalars, votes & has_mask)


def mask_evidence(
    scene: GaussianScene,
    cameras: Sequence[Camera],
    masks: Sequence[Bool[Tensor, "q h w"]],
    *,
    valid_pixels: Sequence[Bool[Tensor, "h w"] | None] | None = None,
    **options: Any,
) -> MaskEvidence:
    """Rasterize the evidence of the masks of Q prompts; each view is rasterized once for all prompts.

    Args:
        cameras: One camera per view.
        masks: Masks of the Q prompts in each view. A mask is False everywhere if the prompt was not found.
        valid_pixels: Mask of the pixels to use in each view; None for all pixels.
        options: `rasterize_mode` and `settings` of `rasterize_evidence`.
    Raises:
        ValueError: There are no cameras or prompts, or the masks do not match the cameras in number or size.
    """
    if len(cameras) == 0 or len(masks) != len(cameras):
        raise InputError(
            f"cameras and masks must have the same length, at least 1; got lengths {len(cameras)} and {len(masks)}"
        )
    labels: list[Int32[Tensor, "h w"]] = []
    inside: list[Bool[Tensor, "q c"]] = []
    for index, (camera, view_masks) in enumerate(zip(cameras, masks)):
        if view_masks.shape != (len(masks[0]), camera.height, camera.width) or len(view_masks) == 0:
            raise InputError(
                f"masks of view {index} have shape {tuple(view_masks.shape)}, expected [{max(1, len(masks[0]))}, "
                f"{camera.height}, {camera.width}], one mask per prompt with the size of the camera"
            )
        cells, cell_values = joint_partition(view_masks.int())
        pixels = None if valid_pixels is None else valid_pixels[index]
        labels.append(cells if pixels is None else cells.where(pixels.to(cells.device), MASKED))
        inside.append(cell_values == 1)
    counts = [part.shape[1] for part in inside]
    evidence = rasterize_evidence(scene, list(cameras), labels, num_regions=counts, **options)
    return MaskEvidence(evidence, torch.cat(inside, dim=1).to(scene.means.device))


class SegmentationResult(NamedTuple):
    """Result of a SAM 3 query with Q prompts."""

    answers: list[MaskResult]
    """One result per prompt."""
    views: list[str]
    """Names of the images that SAM 3 segmented."""
    found: Bool[Tensor, "q v"]
    """True for images in which SAM 3 found the prompt."""
    min_reliability: float = 0.0
    """Minimum reliability R of a selected Gaussian, in 0..1."""

    def selected(self, text: int) -> Bool[Tensor, " n"]:
        """Return a mask of the sufficiently reliable Gaussians with most of their weight inside the SAM 3 masks."""
        answer = self.answers[text]
        return answer.mask & (answer.scalars.reliability >= self.min_reliability)

    def summarize(self, means: Float[Tensor, "n 3"], selected: Bool[Tensor, "n q"]) -> list[dict[str, Any]]:
        """Return summary statistics of every prompt as plain Python types.

        Args:
            means: Centers of the Gaussians.
            selected: Selections of another query with the same prompts, for comparison.
        """
        return [self._row(text, means, selected[:, text]) for text in range(len(self.answers))]

    def _row(self, text: int, means: Tensor, other: Bool[Tensor, " n"]) -> dict[str, Any]:
        answer = self.answers[text]
        mask, scalars = self.selected(text).cpu(), answer.scalars
        selection = SelectionStats.of(mask, *(x.cpu() for x in (means, scalars.reliability, scalars.weight)))
        union = int((mask | other).sum())
        weight = scalars.weight.cpu()[mask].double()
        agreement = float((weight * scalars.c_inter.cpu()[mask]).sum() / weight.sum()) if bool(mask.any()) else None
        return {
            "fraction": selection.fraction,
            "centroid": selection.centroid,
            "extent": selection.extent,
            "peak": float(answer.relevancy.max()) if bool(answer.is_visible.any()) else None,
            "agreement": agreement,
            "mean_reliability": selection.mean_reliability,
            "min_reliability": self.min_reliability,
            "views": self.views,
            "agree": [name for name, voted in zip(self.views, answer.voting_views.tolist()) if voted],
            "found_in": [name for name, found in zip(self.views, self.found[text].tolist()) if found],
            "iou": int((mask & other).sum()) / union if union > 0 else None,
        }


def query_sam3(
    scene: Scene,
    find_masks: Callable[[UInt8[Tensor, "h w 3"], Sequence[str]], Bool[Tensor, "q h w"]],
    texts: Sequence[str],
    *,
    views: int,
    min_reliability: float = 0.0,
    settings: RasterSettings | None = None,
    device: str = "cpu",
) -> SegmentationResult:
    """Segment evenly spaced training views with SAM 3, and lift the masks.

    Args:
        find_masks: Function that returns SAM 3's mask of each prompt in an image.
        texts: Prompts.
        views: Maximum number of views.
        min_reliability: Minimum reliability R of a selected Gaussian, in 0..1.
        settings: Rasterizer settings (default: those of gsplat 1.4).
        device: Device of the rasterizer.
    Raises:
        FileNotFoundError: An image does not exist.
        ValueError: An image is damaged, or a prompt is too long.
    """
    indices, masks, cameras, counted = sample_evenly(len(scene.train), views), [], [], []
    for index in indices:
        view = scene.train[index]
        masks.append(find_masks(view.image, texts).cpu())
        cameras.append(view.camera)
        counted.append(view.mask)
    gaussians = scene.gaussians.to(device)
    evidence = mask_evidence(
        gaussians, cameras, masks, valid_pixels=counted, rasterize_mode=scene.rasterize_mode, settings=settings
    )
    answers = [evidence.answer(text) for text in range(len(texts))]
    found = torch.stack([view_masks.flatten(1).any(dim=1) for view_masks in masks], dim=1)
    return SegmentationResult(answers, [scene.train.names[index] for index in indices], found, min_reliability)
