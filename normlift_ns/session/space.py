"""Where a person selects: the field, the places of its Gaussians, and which of them are neighbours."""

from __future__ import annotations

import dataclasses
from collections import OrderedDict
from dataclasses import dataclass
from functools import cached_property
from threading import Lock
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from normlift_ns.asking import Answer, answer, reselect, settled
from normlift_ns.core.field import SemanticField
from normlift_ns.core.neighbors import nearest_neighbors
from normlift_ns.objects import connected_components
from normlift_ns.options import REACH
from normlift_ns.question import Question
from normlift_ns.session.prompts import ALIKE

_NEIGHBORS = 8
_KEPT_ANSWERS = 4
_SAMPLE = 4096
"""Directions that a mean is made of, at most."""
_PARTS = 11
"""One more than steps of shrinking, so that the last one leaves something."""
_STEP = 0.05
"""How much less alike a neighbour may be with every step of growth."""


@dataclass(frozen=True, eq=False)
class Space:
    """A field and the centres of its Gaussians. Shared by all persons: what it remembers changes no answer."""

    field: SemanticField
    means: Float[Tensor, "n 3"]
    _answers: OrderedDict[Any, Answer] = dataclasses.field(default_factory=OrderedDict, repr=False)
    _lock: Lock = dataclasses.field(default_factory=Lock, repr=False)

    def __len__(self) -> int:
        return len(self.means)

    def none(self) -> Bool[Tensor, " n"]:
        """A mask of no Gaussian."""
        return torch.zeros(len(self), dtype=torch.bool, device=self.means.device)

    def answer(self, question: Question) -> Answer:
        """As `asking.answer`; relevancies of the last few questions are kept.

        Raises:
            ValueError: vectors of another length than the field's, a rule without its negatives.
        """
        negative = None if question.negative_vectors is None else question.negative_vectors.tobytes()
        key = (question.texts, question.vectors.tobytes(), negative, question.rule, question.refined)
        with self._lock:
            found = self._answers.pop(key, None)
        found = answer(self.field, self.means, question) if found is None else found
        with self._lock:
            self._answers[key] = found
            while len(self._answers) > _KEPT_ANSWERS:
                self._answers.popitem(last=False)
        question = settled(question, found.relevancy, found.valid)
        return reselect(found, question.threshold, question.min_reliability)

    def alike(self, vector: Float[Tensor, " d"], least: float = ALIKE, *, refined: bool = True) -> Bool[Tensor, " n"]:
        """Gaussians whose cosine to a direction is at least so large."""
        cosine = self.field.query(vector[None], refined=refined)[:, 0]
        return (cosine >= least) & self.field.valid(refined=refined)

    def object_at(self, gaussian: int, selected: Bool[Tensor, " n"], *, refined: bool = True) -> Bool[Tensor, " n"]:
        """The connected object of a Gaussian: of the selection where it is selected, else of all that is like it."""
        if not bool(selected[gaussian]):
            (direction,) = self.field.directions(torch.tensor([gaussian], device=self.means.device), refined=refined)
            selected = self.alike(direction, refined=refined)
        labels = connected_components(self.means, selected)
        found = labels == labels[gaussian] if int(labels[gaussian]) >= 0 else self.none()
        found[gaussian] = True
        return found

    def resized(self, selected: Bool[Tensor, " n"], steps: int, *, refined: bool = True) -> Bool[Tensor, " n"]:
        """The selection grown (steps > 0) or shrunk (steps < 0) over the neighbour graph.

        Growing takes in what hangs together with the selection and is like its mean direction: a cosine of at least
        0.95 at the first step, 0.05 less with every further one. Shrinking keeps the middle of every connected part:
        what is at most 10/11 of the way, counted in neighbours, from its middle to its farthest Gaussian, 9/11 at the
        second step. Every step holds the one before it.
        """
        if steps == 0 or not bool(selected.any()):
            return selected
        return self._grown(selected, steps, refined) if steps > 0 else self._shrunk(selected, -steps)

    def _grown(self, selected: Bool[Tensor, " n"], steps: int, refined: bool) -> Bool[Tensor, " n"]:
        rows = (selected & self.field.valid(refined=refined)).nonzero().squeeze(1)
        if len(rows) == 0:
            return selected
        mean = self.field.directions(rows[:: 1 + len(rows) // _SAMPLE], refined=refined).mean(dim=0)
        if not bool(mean.any()):
            return selected
        chosen = selected.cpu().numpy()
        able = chosen | self.alike(mean, 1 - _STEP * steps, refined=refined).cpu().numpy()
        _, labels = _components(self._graph(able))
        reached = np.zeros(labels.max() + 1, bool)
        reached[labels[chosen]] = True
        return torch.from_numpy(reached[labels] & able).to(selected.device)

    def _shrunk(self, selected: Bool[Tensor, " n"], steps: int) -> Bool[Tensor, " n"]:
        from scipy.sparse.csgraph import dijkstra  # noqa: PLC0415 (a lift does without)

        rows = np.flatnonzero(selected.cpu().numpy())
        graph = self._graph(selected.cpu().numpy())[rows][:, rows]
        count, labels = _components(graph)
        places = np.nan_to_num(self.means.detach().double().cpu().numpy()[rows])
        size = np.bincount(labels, minlength=count)
        centre = np.stack([np.bincount(labels, x, count) / size for x in places.T], axis=1)
        order = np.lexsort((((places - centre[labels]) ** 2).sum(axis=1), labels))
        middles = order[np.unique(labels[order], return_index=True)[1]]
        hops = dijkstra(graph, directed=False, indices=middles, unweighted=True, min_only=True)
        farthest = np.zeros(count)
        np.maximum.at(farthest, labels, hops)
        kept = torch.from_numpy(rows[hops * _PARTS <= farthest[labels] * (_PARTS - steps)])
        found = self.none()
        found[kept.to(found.device)] = True
        return found

    def _graph(self, able: np.ndarray) -> Any:
        """The neighbours among some of the Gaussians, as a sparse matrix."""
        from scipy.sparse import csr_array  # noqa: PLC0415 (a lift does without)

        first, second = self._edges
        inside = able[first] & able[second]
        pairs = (first[inside], second[inside])
        return csr_array((np.ones(len(pairs[0])), pairs), shape=(len(able), len(able)))

    @cached_property
    def _edges(self) -> tuple[np.ndarray, np.ndarray]:
        """Pairs of neighbours: 8 nearest, not farther than `REACH` medians of the distance to the last of them."""
        found = nearest_neighbors(self.means.detach().cpu(), _NEIGHBORS)
        last = found.distance[:, -1]
        last = last[last.isfinite()]
        limit = REACH * float(last.median()) if len(last) > 0 else np.inf
        near = ((found.index >= 0) & (found.distance <= limit)).numpy()
        first, slot = np.nonzero(near)
        return first.astype(np.int32), found.index.numpy()[first, slot]


def _components(graph: Any) -> tuple[int, np.ndarray]:
    from scipy.sparse.csgraph import connected_components as components_of_graph  # noqa: PLC0415 (likewise)

    return components_of_graph(graph, directed=False)


@dataclass(frozen=True)
class Box:
    """A box to cut with, in the scene's own units."""

    centre: tuple[float, float, float]
    size: tuple[float, float, float]
    """Lengths of its sides, > 0."""
    wxyz: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    """Its rotation as a quaternion."""
    keeps_inside: bool = True
    """Whether what is inside stays selected, or what is outside."""

    @property
    def corners(self) -> Float[np.ndarray, "8 3"]:
        """Its corners: the lowest bit of their numbers is along the first axis of the box, the highest along the last.

        >>> Box((0, 0, 0), (2, 4, 6)).corners[[0, 1, 7]].tolist()
        [[-1.0, -2.0, -3.0], [1.0, -2.0, -3.0], [1.0, 2.0, 3.0]]
        """
        signs = np.array([[1 if number >> axis & 1 else -1 for axis in range(3)] for number in range(8)])
        w, *imaginary = np.array(self.wxyz) / np.linalg.norm(self.wxyz)
        local, axis = signs * np.array(self.size) / 2, np.array(imaginary)
        turn = 2 * np.cross(axis, local)
        return np.array(self.centre) + local + w * turn + np.cross(axis, turn)

    def kept(self, means: Float[Tensor, "n 3"]) -> Bool[Tensor, " n"]:
        """Gaussians whose centres the box keeps.

        >>> Box((0, 0, 0), (2, 2, 2)).kept(torch.tensor([[0.5, 0.5, 0.5], [1.5, 0.0, 0.0]])).tolist()
        [True, False]
        """
        w, *imaginary = torch.nn.functional.normalize(torch.tensor(self.wxyz, dtype=torch.float64), dim=0)
        axis = -torch.stack(imaginary).to(means.device)
        offset = means.double() - torch.tensor(self.centre, dtype=torch.float64, device=means.device)
        turn = 2 * torch.linalg.cross(axis.expand_as(offset), offset)
        local = offset + w.to(means.device) * turn + torch.linalg.cross(axis.expand_as(offset), turn)
        half = torch.tensor(self.size, dtype=torch.float64, device=means.device) / 2
        inside = (local.abs() <= half).all(dim=1)
        return inside if self.keeps_inside else ~inside
