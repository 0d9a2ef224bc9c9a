"""Masks of texts in some views, lifted: every text is one region against the rest.

A Gaussian's relevancy for a text is the share of its weight that lies in the masks: sum_v E_in / sum_v (E_in + E_out),
with the weights of the rasterizer that trained the scene, over the views that vote. At first these are the views in
which the text was found. Then those whose mask shares more than half of what either covers with the answer so far,
drawn there: to miss a thing, or to take another for it, is what such masks do wrong, whole views at a time. A view that
does not vote is unlabelled, and dilutes: it counts against reliability, so that what was found in one view of eight has
the reliability of one view in eight. Agreement and reliability are those of `core.lift` for two regions per view, "in"
and "out", with the features (1, 0) and (0, 1).
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
from normlift_ns.encoders.source import joint_partition
from normlift_ns.errors import InputError
from normlift_ns.observing import spread
from normlift_ns.options import BackendName, RasterizeMode
from normlift_ns.raster.rasterize import rasterize_evidence
from normlift_ns.raster.settings import RasterSettings
from normlift_ns.selection import Selection

SHARE = 0.5
"""Relevancy above which a Gaussian is in what a text names: more of it is in the masks than outside."""


@dataclass(frozen=True)
class MaskAnswer:
    """What the masks of one text say of every Gaussian."""

    relevancy: Float[Tensor, " n"]
    """Share of its weight that lies in the masks, in 0..1; 0 where no view that votes sees it."""
    scalars: Scalars
    """Of the lift of two regions. c_inter: how far the views that vote agree; reliability: R."""
    voted: Bool[Tensor, " v"]
    """Views with a mask that agrees with the answer."""

    @property
    def seen(self) -> Bool[Tensor, " n"]:
        """Gaussians that a view sees."""
        return self.scalars.weight > 0

    @property
    def mask(self) -> Bool[Tensor, " n"]:
        """Gaussians of which more than half lies in the masks."""
        return self.relevancy > SHARE


@dataclass(frozen=True)
class MaskEvidence:
    """Masks of Q texts in V views, as weights of Gaussians.

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
    """Of the pieces that all masks of a view have in common."""
    inside: Bool[Tensor, "q s"]
    """Which pieces are in the masks of each text."""

    def answer(self, text: int, views: Sequence[int] | None = None, *, beta: float = 1.0) -> MaskAnswer:
        """What the masks of one text say, in all views or some.

        Args:
            text: its number.
            beta: as in `lift`.
        """
        evidence, inside = self.evidence, self.inside[text]
        if views is not None:
            inside = inside[evidence.columns_of(views)]
            evidence = evidence.select_views(views)
        column, weight = evidence.rows.column.long(), evidence.rows.weight.double()
        row, view = evidence.rows.row_index(), evidence.region_view[column].long()
        within = inside[column]

        def share(votes: Bool[Tensor, " v"]) -> Float[Tensor, " n"]:
            held, total = weight.new_zeros(2, evidence.num_gaussians)
            total.index_add_(0, row, weight * votes[view])
            held.index_add_(0, row, weight * (votes[view] & within))
            return torch.where(total > 0, held / total, 0.0)

        found = torch.zeros(evidence.num_views, dtype=torch.bool, device=inside.device)
        found[evidence.region_view[inside].long()] = True
        drawn = share(found)[row] > SHARE
        both, either = weight.new_zeros(2, evidence.num_views)
        both.index_add_(0, view, weight * (within & drawn))
        either.index_add_(0, view, weight * (within | drawn))
        votes = (both > 0.5 * either) | (either == 0)
        votes = votes if bool((votes & found).any()) else found
        sides = torch.where(votes[evidence.region_view.long()], 2 * evidence.region_view + (~inside).int(), -1)
        of_side = torch.arange(evidence.num_views, dtype=torch.int32, device=inside.device).repeat_interleave(2)
        table = torch.eye(2, device=inside.device, dtype=evidence.rows.weight.dtype).repeat(evidence.num_views, 1)
        scalars = lift(evidence.regroup(sides[None], of_side), table, beta=beta, unlabeled="dilute").scalars
        relevancy = torch.where(scalars.norm > 0, share(votes), 0.0).to(scalars.norm.dtype)
        return MaskAnswer(relevancy, scalars, votes & found)


def mask_evidence(
    scene: GaussianScene,
    cameras: Sequence[Camera],
    masks: Sequence[Bool[Tensor, "q h w"]],
    *,
    counted: Sequence[Bool[Tensor, "h w"] | None] | None = None,
    rasterize_mode: RasterizeMode = "classic",
    settings: RasterSettings | None = None,
    backend: BackendName = "auto",
    done: Callable[[], None] = lambda: None,
) -> MaskEvidence:
    """The evidence of masks of Q texts, rasterized once for all of them.

    Args:
        cameras: one per view.
        masks: per view the pixels that are what each text names; of a text that was not found, none.
        counted: per view where pixels count at all; None: everywhere.
        rasterize_mode, settings, backend: as in `rasterize_evidence`.
        done: called after every view.
    Raises:
        ValueError: no view, or masks of another number or size than their cameras.
    """
    if len(cameras) == 0 or len(masks) != len(cameras):
        raise InputError(
            f"masks are needed of at least one view, one set per camera; got {len(masks)} of {len(cameras)}"
        )
    labels: list[Int32[Tensor, "h w"]] = []
    inside: list[Bool[Tensor, "q c"]] = []
    for index, (camera, found) in enumerate(zip(cameras, masks)):
        if found.shape != (len(masks[0]), camera.height, camera.width) or len(found) == 0:
            raise InputError(
                f"masks of view {index} are {tuple(found.shape)}, expected [{max(1, len(masks[0]))}, {camera.height}, "
                f"{camera.width}]: one per text, of the size of the camera"
            )
        cells, of_cell = joint_partition(found.int())
        where = None if counted is None else counted[index]
        labels.append(cells if where is None else cells.where(where.to(cells.device), MASKED))
        inside.append(of_cell == 1)
    evidence = rasterize_evidence(
        scene,
        list(cameras),
        labels,
        num_regions=[part.shape[1] for part in inside],
        rasterize_mode=rasterize_mode,
        settings=settings,
        backend=backend,
        progress=lambda *_: done(),
    )
    return MaskEvidence(evidence, torch.cat(inside, dim=1).to(scene.means.device))


class Segmented(NamedTuple):
    """What SAM 3 answers to Q texts."""

    answers: list[MaskAnswer]
    """One per text."""
    views: list[str]
    """The photographs that it was asked in."""
    found: Bool[Tensor, "q v"]
    """In which of them it found the text."""
    min_reliability: float = 0.0
    """R below which a Gaussian is not selected."""

    def selected(self, text: int) -> Bool[Tensor, " n"]:
        """Gaussians of which more than half lies in the masks, of enough reliability."""
        answer = self.answers[text]
        return answer.mask & (answer.scalars.reliability >= self.min_reliability)

    def summarize(self, means: Float[Tensor, "n 3"], selected: Bool[Tensor, "n q"]) -> list[dict[str, Any]]:
        """The numbers of every text, ready for JSON.

        Args:
            means: centres of the Gaussians.
            selected: what the other answer selects for each text, to compare with.
        """
        return [self._row(text, means, selected[:, text]) for text in range(len(self.answers))]

    def _row(self, text: int, means: Tensor, other: Bool[Tensor, " n"]) -> dict[str, Any]:
        answer = self.answers[text]
        mask, scalars = self.selected(text).cpu(), answer.scalars
        arrays = (means, scalars.reliability, scalars.weight)
        numbers = Selection(len(mask), *(x.detach().cpu()[mask].numpy() for x in arrays))
        either = int((mask | other).sum())
        weight = scalars.weight.cpu()[mask].double()
        agreement = float((weight * scalars.c_inter.cpu()[mask]).sum() / weight.sum()) if bool(mask.any()) else None
        return {
            "fraction": numbers.fraction,
            "centroid": numbers.centroid,
            "extent": numbers.extent,
            "peak": float(answer.relevancy.max()) if bool(answer.seen.any()) else None,
            "agreement": agreement,
            "mean_reliability": numbers.mean_reliability,
            "min_reliability": self.min_reliability,
            "views": self.views,
            "agree": [name for name, there in zip(self.views, answer.voted.tolist()) if there],
            "found_in": [name for name, there in zip(self.views, self.found[text].tolist()) if there],
            "iou": int((mask & other).sum()) / either if either > 0 else None,
        }


def segment(
    scene: Scene,
    find: Callable[[UInt8[Tensor, "h w 3"], Sequence[str]], Bool[Tensor, "q h w"]],
    texts: Sequence[str],
    *,
    views: int,
    min_reliability: float = 0.0,
    settings: RasterSettings | None = None,
    device: str = "cpu",
    done: Callable[[], None] = lambda: None,
) -> Segmented:
    """Asks SAM 3 for texts in some training views, evenly spread, and lifts its masks.

    Args:
        find: what SAM 3 finds of each text in a photograph.
        views: how many, at most.
        min_reliability: R below which a Gaussian is not selected, in 0..1.
        settings: constants of the rasterizer.
        device: where to rasterize.
        done: called after every view.
    Raises:
        FileNotFoundError, ValueError: a photograph that is missing or damaged; a text that is too long.
    """
    chosen, masks, cameras, counted = spread(len(scene.train), views), [], [], []
    for index in chosen:
        view = scene.train[index]
        masks.append(find(view.image, texts).cpu())
        cameras.append(view.camera)
        counted.append(view.mask)
        done()
    gaussians = scene.gaussians.to(device)
    how = {"rasterize_mode": scene.rasterize_mode, "settings": settings}
    evidence = mask_evidence(gaussians, cameras, masks, counted=counted, **how)
    answers = [evidence.answer(text) for text in range(len(texts))]
    found = torch.stack([part.flatten(1).any(dim=1) for part in masks], dim=1)
    return Segmented(answers, [scene.train.names[index] for index in chosen], found, min_reliability)
