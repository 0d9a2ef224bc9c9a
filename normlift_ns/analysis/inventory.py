"""Objects of a scene, found without prompts: parts whose Gaussians share regions in the images.

Two neighboring Gaussians get a score from each image in which both have a region. The score is 1 if both have the same
region. Otherwise, it is the similarity of the two regions, max(0, 1 - (1 - cos) / (3 s)). Here, s measures how much
the views typically disagree. It is the mean of 1 - median ||f_j|| before and after the consensus, with f_j the mean
feature of Gaussian j. The affinity of two parts is the mean of the scores over all images and all pairs of neighbors
across their border, reduced if there are few scores::

    a(A, B) = sum of scores / max(number of scores, m sqrt(min(|A|, |B|)))

Here, m is the median number of images per pair. The square root estimates the length of the border, which is a line on
a surface. This denominator keeps two parts separate if only a few pairs connect them. Initially, every Gaussian is a
part. Each part is merged into the part with the largest affinity to it if that part is larger. This is repeated for
affinities of at least 0.95, then 0.9, and so on down to 0.5. The method corresponds to the ultrametric contour map of
Arbelaez et al. ("Contour Detection and Hierarchical Image Segmentation", PAMI 2011), with votes of regions in place of
edge strengths. Random borders of a segmentation differ between images, so the affinity across them is high. Borders of
objects are the same in all images, so the affinity across them is low.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int32, Int64
from torch import Tensor

from normlift_ns.analysis.explain import RecordedVotes
from normlift_ns.analysis.objects import Catalogue, Instances, SimilarityTransform, make_catalogue
from normlift_ns.core.evidence import Evidence
from normlift_ns.core.field import SemanticField
from normlift_ns.core.neighbors import nearest_neighbors
from normlift_ns.core.sparse import SparseRows
from normlift_ns.encoders.build import null_words
from normlift_ns.encoders.registry import EncoderKind, find_encoder_kind
from normlift_ns.errors import InputError, truncate_text
from normlift_ns.options import OBJECT_MIN_GAUSSIANS, check_prompt_list

MAX_OBJECTS = 20
"""Maximum number of objects in an inventory."""
MIN_EVIDENCE = 0.001
"""Minimum weight of an object, as a fraction of the weight of all Gaussians, both summed over all images."""
_NEIGHBORS = 8
_MIN_VISIBLE = 0.25
"""Minimum weight of a Gaussian in an image that shows it, as a fraction of its largest weight in any image."""
_MIN_REGION = 0.25
"""Minimum weight of a Gaussian in its region of an image, as a fraction of its weight in the image over all levels."""
_SPREADS = 3.0
"""Disagreement of two regions at which their similarity is 0, as a multiple of the typical disagreement s."""
_LEVELS = tuple(level / 20 for level in range(19, 9, -1))
"""Minimum affinities of the successive rounds of merging, from 0.95 to 0.5."""
_MANY_WORDS = 100
"""Minimum number of words for the test of names against chance."""
_FALSE_NAMES = 0.25
"""Expected number of wrong names that the test allows."""
_SAMPLE = 5000
"""Approximate number of sampled Gaussians over which the cosines of each word are standardized; see `best_words`."""


@dataclass(frozen=True, eq=False)
class Inventory:
    """Main objects of a scene, by descending evidence: large objects and those that many images show come first."""

    instance_id: Int32[Tensor, " n"]
    """Object number of every Gaussian, from 1; 0 for Gaussians without an object."""
    catalog: Catalogue
    """Catalog of the objects. The text of an object is a word of the vocabulary, or a numbered name such as "object 3";
    see `name_objects`."""

    def __len__(self) -> int:
        return len(self.catalog.objects)

    def mask(self, number: int) -> Bool[Tensor, " n"]:
        """Return the mask of the Gaussians of an object.

        Raises:
            ValueError: The inventory has no object with this number.
        """
        if not 1 <= number <= len(self):
            expected = "the inventory has no objects" if len(self) == 0 else f"expected a number in 1..{len(self)}"
            raise InputError(f"Object {number} does not exist; {expected}")
        return self.instance_id == number


@dataclass(frozen=True)
class Vocabulary:
    """Candidate names of objects, with functions that encode words and search the run."""

    words: tuple[str, ...]
    kind: EncoderKind | None
    """Kind of the encoder of the run; None if it is unknown."""
    encode: Callable[[Sequence[str]], Float[np.ndarray, "w d"]]
    """Function that returns one unit vector per word."""
    ask: Callable[[Sequence[str]], Any]
    """Function that returns the `Answer` to a query for the words."""

    @classmethod
    def of(
        cls,
        words: Sequence[str],
        encoder: str | None,
        encode: Callable[[Sequence[str]], Float[np.ndarray, "w d"]],
        ask: Callable[[Sequence[str]], Any],
    ) -> Vocabulary:
        """Return a vocabulary without duplicates for the encoder with the name `encoder`.

        Raises:
            ValueError: A word is empty, or the encoder cannot encode it.
        """
        words, kind = tuple(dict.fromkeys(words)), find_encoder_kind(encoder)
        check_prompt_list("vocabulary", words)
        unknown = [word for word in words if kind is not None and not kind.known_words(word)]
        if len(unknown) > 0:
            raise InputError(
                f"the encoder of the run cannot encode some words of the vocabulary ({len(unknown)} of {len(words)}); "
                f"remove or replace: {truncate_text(', '.join(unknown), 400)}"
            )
        return cls(words, kind, encode, ask)


class ViewRegions(NamedTuple):
    """Gaussians [M] that an image shows, and the region of each as a column index of the evidence."""

    gaussian: Int64[Tensor, " m"]
    region: Int64[Tensor, " m"]


class _Borders(NamedTuple):
    """Pairs of adjacent parts, with the sum and the number of the scores across their border."""

    first: Int64[np.ndarray, " e"]
    second: Int64[np.ndarray, " e"]
    total: Float64[np.ndarray, " e"]
    observed: Float64[np.ndarray, " e"]

    def joined(self, part: Int64[np.ndarray, " n"]) -> _Borders:
        """Return the borders after merging parts; `part[i]` is the new index of part i."""
        first, second = part[self.first], part[self.second]
        keep = first != second
        low, high = np.minimum(first, second)[keep], np.maximum(first, second)[keep]
        key, index = np.unique(low * len(part) + high, return_inverse=True)
        sums = (np.bincount(index, x[keep], len(key)) for x in (self.total, self.observed))
        return _Borders(key // len(part), key % len(part), *sums)


def list_inventory(
    votes: RecordedVotes,
    vocabulary: Vocabulary,
    transform: SimilarityTransform,
    *,
    meters_per_unit: float | None = None,
    device: str = "cpu",
) -> Inventory:
    """Find and name the main objects of a scene, and return them with their catalog.

    Args:
        votes: Evidence of the lift, with its scene and its field.
        vocabulary: Candidate names. An object that none of them fits is named by its number, such as "object 3".
        transform, meters_per_unit, device: As in `make_catalogue`.
    Raises:
        ValueError, FileNotFoundError: As in `RecordedVotes.table` and `make_catalogue`.
    """
    scene, field = votes.scene, votes.field
    evidence, features = votes.table
    instance_id = find_inventory(evidence, features, scene.gaussians.means, votes.disagreement)
    names = name_objects(field, instance_id, mean_directions(evidence, features, instance_id), vocabulary)
    instances = as_instances(instance_id, names)
    catalog = make_catalogue(scene, field, instances, transform, meters_per_unit=meters_per_unit, device=device)
    return Inventory(instance_id, catalog)


def find_inventory(
    evidence: Evidence,
    features: Float[Tensor, "s d"],
    means: Float[Tensor, "n 3"],
    spread: float,
) -> Int32[Tensor, " n"]:
    """Find the main objects of a scene; return the object number of every Gaussian, 0 for none.

    There are at most 20 objects, numbered from 1 by descending weight over all images. Each has at least 20 Gaussians,
    and at least a thousandth of the weight of all Gaussians.

    Args:
        features: One unit row per column (region) of the evidence.
        means: Centers of the Gaussians.
        spread: Typical disagreement of the views about a Gaussian, from `RecordedVotes.disagreement`.
    """
    evidence = evidence.to("cpu")
    part = _join(len(means), _neighbor_borders(view_regions(evidence), features.cpu(), means.cpu(), spread))
    weight = (evidence.rows.row_sums() + evidence.unlabeled.row_sums()).numpy()
    size, total = np.bincount(part), np.bincount(part, weight)
    order = np.argsort(-total, kind="stable")
    large = (size[order] >= OBJECT_MIN_GAUSSIANS) & (total[order] >= MIN_EVIDENCE * weight.sum()) & (total[order] > 0)
    listed = order[large][:MAX_OBJECTS]
    number = np.zeros(len(size), np.int32)
    number[listed] = np.arange(1, len(listed) + 1)
    return torch.from_numpy(number[part]).to(means.device)


def view_regions(evidence: Evidence) -> Iterator[ViewRegions]:
    """Yield, for each image, the Gaussians that it shows and the region in which each has its largest weight."""
    rows, groups, view = evidence.rows, evidence.view_group_offsets, evidence.region_view.long()
    weight, column, gaussian = rows.weight.double(), rows.column.long(), rows.row_index()
    total = SparseRows.add(evidence.view_weights(), evidence.unlabeled)
    largest = torch.zeros(evidence.num_gaussians, dtype=torch.float64)
    largest.scatter_reduce_(0, total.row_index(), total.weight, "amax")
    group = torch.repeat_interleave(torch.arange(len(groups) - 1), groups.diff())
    best = torch.zeros(len(groups) - 1, dtype=torch.float64).scatter_reduce_(0, group, weight, "amax")
    entry = (weight == best[group]).nonzero().squeeze(1)
    entry = entry[torch.cat([torch.ones(min(1, len(entry)), dtype=torch.bool), group[entry].diff() > 0])]  # the first
    gaussian, column, weight = gaussian[entry], column[entry], weight[entry]
    key = total.row_index() * evidence.num_views + total.column.long()
    here = total.weight[torch.searchsorted(key, gaussian * evidence.num_views + view[column])]
    shown = (here >= _MIN_VISIBLE * largest[gaussian]) & (weight >= _MIN_REGION * here)
    gaussian, column = gaussian[shown], column[shown]
    order = view[column].argsort(stable=True)
    counts = torch.bincount(view[column], minlength=evidence.num_views).tolist()
    for part in order.split(counts):
        yield ViewRegions(gaussian[part], column[part])


def _neighbor_borders(
    views: Iterable[ViewRegions], features: Float[Tensor, "s d"], means: Float[Tensor, "n 3"], spread: float
) -> _Borders:
    """Return the borders between every Gaussian and its nearest neighbors, with each Gaussian as a separate part."""
    neighbors = nearest_neighbors(means, _NEIGHBORS).index.long()
    here = torch.arange(len(means))[:, None].expand_as(neighbors)
    low, high = torch.minimum(here, neighbors), torch.maximum(here, neighbors)
    key = (low * len(means) + high)[neighbors >= 0].unique()
    first, second = key // max(len(means), 1), key % max(len(means), 1)
    total, count = (torch.zeros(len(key), dtype=torch.float64) for _ in range(2))
    label = torch.full((len(means),), -1)
    for shown in views:
        label[shown.gaussian] = shown.region
        pair = ((label[first] >= 0) & (label[second] >= 0)).nonzero().squeeze(1)
        one, other = label[first[pair]], label[second[pair]]
        total[pair] += _similarity(one, other, features, spread)
        count[pair] += 1
        label[shown.gaussian] = -1
    known = count > 0
    return _Borders(*(x[known].numpy() for x in (first, second, total, count)))


def _similarity(one: Tensor, other: Tensor, features: Tensor, spread: float) -> Float64[Tensor, " p"]:
    """Return the similarity of each of P pairs of regions in one image, in 0..1; 1 if both are the same region."""
    count = torch.ones(len(one), dtype=torch.float64)
    differs = (one != other).nonzero().squeeze(1)
    key, index = (one[differs] * len(features) + other[differs]).unique(return_inverse=True)
    cosine = (features[key // len(features)].double() * features[key % len(features)].double()).sum(dim=1)
    count[differs] = (1 - (1 - cosine) / (_SPREADS * max(spread, 1e-6))).clamp(0, 1)[index]
    return count


def _join(num_gaussians: int, borders: _Borders) -> Int64[np.ndarray, " n"]:
    """Merge Gaussians into parts, and return the index of each Gaussian's part, from 0 without gaps."""
    part, size = np.arange(num_gaussians), np.ones(num_gaussians)
    images = float(np.median(borders.observed)) if len(borders.observed) > 0 else 0.0
    for level in _LEVELS:
        while True:
            least = images * np.sqrt(np.minimum(size[borders.first], size[borders.second]))
            affinity = borders.total / np.maximum(borders.observed, least)
            target = _targets(borders, affinity, size, np.flatnonzero(affinity >= level))
            if np.array_equal(target, np.arange(len(size))):
                break
            while not np.array_equal(target, target[target]):
                target = target[target]
            _, number = np.unique(target, return_inverse=True)
            part, size, borders = number[part], np.bincount(number, size), borders.joined(number)
    return part


def _targets(
    borders: _Borders, affinity: Float64[np.ndarray, " e"], size: Float64[np.ndarray, " n"], chosen: np.ndarray
) -> Int64[np.ndarray, " n"]:
    """Return the part that each part is merged into: the one with the largest affinity if it is larger, or else itself.

    Only the borders with the indices `chosen` are used. Ties go to the larger part, then to the part with the smaller
    index. Of two equally large parts, the part with the smaller index counts as larger.
    """
    source = np.concatenate([borders.first[chosen], borders.second[chosen]])
    target = np.concatenate([borders.second[chosen], borders.first[chosen]])
    order = np.lexsort((target, -size[target], -np.tile(affinity[chosen], 2), source))
    source, target = source[order], target[order]
    best = np.ones(len(source), bool)
    best[1:] = source[1:] != source[:-1]
    source, target = source[best], target[best]
    larger = (size[target] > size[source]) | ((size[target] == size[source]) & (target < source))
    result = np.arange(len(size))
    result[source[larger]] = target[larger]
    return result


def as_instances(instance_id: Int32[Tensor, " n"], names: tuple[str, ...]) -> Instances:
    """Return the objects as instances, each with its own class, for the catalog and exports."""
    return Instances(names, instance_id, instance_id, tuple(range(1, len(names) + 1)))


def mean_directions(
    evidence: Evidence, features: Float[Tensor, "s d"], instance_id: Int32[Tensor, " n"]
) -> Float64[Tensor, "m d"]:
    """Return the evidence-weighted mean feature of every object, normalized to length 1."""
    count, rows = int(instance_id.max()) if len(instance_id) > 0 else 0, evidence.rows
    ids = instance_id.to(rows.weight.device).long()[rows.row_index()]
    key = ids * evidence.num_regions + rows.column.long()
    weight = torch.zeros((count + 1) * evidence.num_regions, dtype=torch.float64, device=key.device)
    weight.index_add_(0, key, rows.weight.double())
    return torch.nn.functional.normalize(weight.view(count + 1, -1)[1:] @ features.to(weight), dim=1)


def name_objects(
    field: SemanticField, instance_id: Int32[Tensor, " n"], directions: Float64[Tensor, "m d"], vocabulary: Vocabulary
) -> tuple[str, ...]:
    """Return a name for every object: a word of the vocabulary, or a numbered name such as "object 3".

    The word must be the best name and stand out from other words (see `best_words`). It must also have the verdict
    "found" and select more than half of the object's Gaussians.

    Args:
        directions: Unit directions of the objects, from `mean_directions`.
    """
    names = [f"object {number}" for number in range(1, len(directions) + 1)]
    if len(vocabulary.words) == 0 or len(names) == 0:
        return tuple(names)
    chosen = _words_of_objects(field, directions, vocabulary)
    answer = vocabulary.ask(tuple(dict.fromkeys(chosen.values()))) if len(chosen) > 0 else {}
    for number, word in chosen.items():
        selected = torch.as_tensor(answer[word].mask)[instance_id == number]
        if answer[word].verdict == "found" and float(selected.float().mean()) > 0.5:
            names[number - 1] = word
    return tuple(names)


def _words_of_objects(
    field: SemanticField, directions: Float64[Tensor, "m d"], vocabulary: Vocabulary
) -> dict[int, str]:
    """Return the best name of each object for which a word stands out, by object number."""
    words, kind = vocabulary.words, vocabulary.kind
    others = null_words() if kind is not None and kind.has_null_words and len(words) < _MANY_WORDS else ()
    compared = tuple(dict.fromkeys((*words, *others)))
    absolute = len(compared) < _MANY_WORDS or (kind is not None and kind.present_from is not None)
    sample = field.directions(torch.arange(0, len(field), max(1, len(field) // _SAMPLE)))
    vectors, limit = torch.from_numpy(vocabulary.encode(compared)), float("inf") if absolute else _FALSE_NAMES
    best = best_words(directions, sample, vectors, by_chance=limit, count=len(words))
    return {number: words[index] for number, index in enumerate(best, 1) if index is not None}


def best_words(
    directions: Float64[Tensor, "m d"],
    scene: Float[Tensor, "k d"],
    vectors: Float[Tensor, "w d"],
    *,
    by_chance: float,
    count: int,
) -> list[int | None]:
    """Return the index of the best name of every object; None if the best name does not stand out from other words.

    Some words are similar to everything. The cosines of each word are therefore standardized over the scene, and then
    those of each object over the words that are not names. The score of the best name must exceed a limit. For normally
    distributed scores of 20 objects, the expected number of pairs (object, name) above this limit is `by_chance`.
    If all words are names, the scores are standardized over all words, and the best name must also have the best score.

    Args:
        directions: Unit directions of the objects, from `mean_directions`.
        scene: Directions of a sample of the Gaussians of the scene.
        vectors: One unit row per word, names first.
        by_chance: Expected number of pairs that exceed the limit by chance; inf accepts every best name.
        count: Number of words that are names.
    """
    cosine = directions @ vectors.to(directions).T
    best = cosine[:, :count].argmax(dim=1)
    if by_chance == float("inf") or len(best) == 0:
        return best.tolist()
    usual = scene.to(directions) @ vectors.to(directions).T
    score = (cosine - usual.mean(dim=0)) / usual.std(dim=0).clamp(min=1e-9)
    others = score[:, count:] if count < len(vectors) else score
    score = ((score - others.mean(dim=1, keepdim=True)) / others.std(dim=1, keepdim=True).clamp(min=1e-9))[:, :count]
    limit = float(torch.special.ndtri(torch.tensor(1 - by_chance / (MAX_OBJECTS * count), dtype=torch.float64)))
    clear = score.gather(1, best[:, None])[:, 0] > limit
    if count == len(vectors):
        clear &= score.argmax(dim=1) == best
    return [word if stands_out else None for word, stands_out in zip(best.tolist(), clear.tolist())]
