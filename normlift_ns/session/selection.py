"""Field, centers and neighbor graph of the Gaussians, for selections in space."""

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

from normlift_ns.analysis.objects import connected_components
from normlift_ns.core.field import SemanticField
from normlift_ns.core.neighbors import nearest_neighbors
from normlift_ns.options import OBJECT_MAX_GAP
from normlift_ns.query.engine import Answer, apply_threshold, run_query
from normlift_ns.query.question import Query
from normlift_ns.session.prompts import CLICK_THRESHOLD

_NEIGHBORS = 8
_CACHED_ANSWERS = 4
_MAX_SAMPLES = 4096
"""Maximum number of directions to average."""
_FRACTIONS = 11
"""Maximum number of shrinking steps plus one, so that the last step does not remove all Gaussians."""
_COSINE_STEP = 0.05
"""Decrease of the minimum cosine per step of growth."""


@dataclass(frozen=True, eq=False)
class SelectionContext:
    """Semantic field and the centers of its Gaussians, with caches that several users can share."""

    field: SemanticField
    means: Float[Tensor, "n 3"]
    _answers: OrderedDict[Any, Answer] = dataclasses.field(default_factory=OrderedDict, repr=False)
    _lock: Lock = dataclasses.field(default_factory=Lock, repr=False)

    def __len__(self) -> int:
        return len(self.means)

    def empty_mask(self) -> Bool[Tensor, " n"]:
        """Return a mask that is False for all Gaussians."""
        return torch.zeros(len(self), dtype=torch.bool, device=self.means.device)

    def answer(self, question: Query) -> Answer:
        """Return the answer to a query, as `run_query` does; cache the relevancies of the last four queries.

        Raises:
            ValueError: As in `run_query`.
        """
        negative = None if question.negative_embeddings is None else question.negative_embeddings.tobytes()
        key = (question.texts, question.embeddings.tobytes(), negative, question.rule, question.refined)
        with self._lock:
            result = self._answers.pop(key, None)
        result = run_query(self.field, self.means, question) if result is None else result
        with self._lock:
            self._answers[key] = result
            while len(self._answers) > _CACHED_ANSWERS:
                self._answers.popitem(last=False)
        return apply_threshold(result, question)

    def similar_to(
        self, vector: Float[Tensor, " d"], least: float = CLICK_THRESHOLD, *, refined: bool = True
    ) -> Bool[Tensor, " n"]:
        """Return the mask of the Gaussians whose direction has a cosine of at least `least` with `vector`."""
        cosine = self.field.query(vector[None], refined=refined)[:, 0]
        return (cosine >= least) & self.field.valid(refined=refined)

    def object_at(self, gaussian: int, selected: Bool[Tensor, " n"], *, refined: bool = True) -> Bool[Tensor, " n"]:
        """Return the mask of the object around a Gaussian.

        The object is a connected component of the selection if the Gaussian is selected. Otherwise, it is a connected
        component of all Gaussians similar to this one.

        Args:
            gaussian: Index of the Gaussian.
            selected: Mask of the selection.
        """
        if not bool(selected[gaussian]):
            (direction,) = self.field.directions(torch.tensor([gaussian], device=self.means.device), refined=refined)
            selected = self.similar_to(direction, refined=refined)
        labels = connected_components(self.means, selected)
        mask = labels == labels[gaussian] if int(labels[gaussian]) >= 0 else self.empty_mask()
        mask[gaussian] = True
        return mask

    def grow_or_shrink(self, selected: Bool[Tensor, " n"], steps: int, *, refined: bool = True) -> Bool[Tensor, " n"]:
        """Return the selection grown (steps > 0) or shrunk (steps < 0) over the neighbor graph.

        Each step of growing adds the nearest neighbors of the selection. Growing also adds Gaussians that are connected
        to the selection and similar to its mean direction. Their cosine with this direction is at least 0.95 for one
        step, and the limit decreases by 0.05 with each further step.

        In each connected component, shrinking keeps the Gaussians near the middle of the component. Their graph
        distance to the middle is at most a fraction of the largest distance. The fraction is 10/11 for one step, and
        decreases by 1/11 with each further step. More steps of growing never remove a Gaussian, and more steps of
        shrinking never add one.
        """
        if steps == 0 or not bool(selected.any()):
            return selected
        return self._grown(selected, steps, refined) if steps > 0 else self._shrunk(selected, -steps)

    def _grown(self, selected: Bool[Tensor, " n"], steps: int, refined: bool) -> Bool[Tensor, " n"]:
        from scipy.sparse import csgraph  # noqa: PLC0415 (a lift does not need it)

        grown = seeds = selected.cpu().numpy()
        first, second = self.neighbor_pairs
        for _ in range(steps):
            grown = grown.copy()
            grown[second[grown[first]]] = True
        rows = (selected & self.field.valid(refined=refined)).nonzero().squeeze(1)
        mean = self.field.directions(rows[:: 1 + len(rows) // _MAX_SAMPLES], refined=refined).sum(dim=0)
        if bool(mean.any()):
            similar = seeds | self.similar_to(mean, 1 - _COSINE_STEP * steps, refined=refined).cpu().numpy()
            _, labels = csgraph.connected_components(self._graph(similar), directed=False)
            reached = np.zeros(labels.max() + 1, bool)
            reached[labels[seeds]] = True
            grown = grown | (reached[labels] & similar)
        return torch.from_numpy(grown).to(selected.device)

    def _shrunk(self, selected: Bool[Tensor, " n"], steps: int) -> Bool[Tensor, " n"]:
        from scipy.sparse import csgraph  # noqa: PLC0415 (as above)

        rows = np.flatnonzero(selected.cpu().numpy())
        graph = self._graph(selected.cpu().numpy())[rows][:, rows]
        count, labels = csgraph.connected_components(graph, directed=False)
        means = np.nan_to_num(self.means.detach().double().cpu().numpy()[rows])
        size = np.bincount(labels, minlength=count)
        center = np.stack([np.bincount(labels, x, count) / size for x in means.T], axis=1)
        order = np.lexsort((((means - center[labels]) ** 2).sum(axis=1), labels))
        middles = order[np.unique(labels[order], return_index=True)[1]]
        hops = csgraph.dijkstra(graph, directed=False, indices=middles, unweighted=True, min_only=True)
        farthest = np.zeros(count)
        np.maximum.at(farthest, labels, hops)
        inner = torch.from_numpy(rows[hops * _FRACTIONS <= farthest[labels] * (_FRACTIONS - steps)])
        mask = self.empty_mask()
        mask[inner.to(mask.device)] = True
        return mask

    def _graph(self, mask: np.ndarray) -> Any:
        """Return the neighbor graph restricted to a mask of Gaussians, as a sparse matrix."""
        from scipy.sparse import csr_array  # noqa: PLC0415 (as above)

        first, second = self.neighbor_pairs
        inside = mask[first] & mask[second]
        pairs = (first[inside], second[inside])
        return csr_array((np.ones(len(pairs[0])), pairs), shape=(len(mask), len(mask)))

    @cached_property
    def neighbor_pairs(self) -> tuple[np.ndarray, np.ndarray]:
        """Indices of the first and of the second Gaussian of each pair of neighbors.

        The neighbors of a Gaussian are the 8 nearest within `OBJECT_MAX_GAP` times the median distance to the 8th.
        """
        neighbors = nearest_neighbors(self.means.detach().cpu(), _NEIGHBORS)
        last = neighbors.distance[:, -1]
        last = last[last.isfinite()]
        limit = OBJECT_MAX_GAP * float(last.median()) if len(last) > 0 else np.inf
        near = ((neighbors.index >= 0) & (neighbors.distance <= limit)).numpy()
        first, slot = np.nonzero(near)
        return first.astype(np.int32), neighbors.index.numpy()[first, slot]
