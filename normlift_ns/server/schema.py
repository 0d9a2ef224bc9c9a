"""Request and response types of the HTTP API."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
import torch

from normlift_ns.errors import InputError
from normlift_ns.options import RelevancyRule
from normlift_ns.query.engine import Answer
from normlift_ns.query.question import Query, join_prompts
from normlift_ns.server.describe import region_mask
from normlift_ns.server.permalink import Finite, PageView
from normlift_ns.server.protocol import CameraValue, ColorMode, Ray, Region
from normlift_ns.server.runs import ServedRun
from normlift_ns.session import actions
from normlift_ns.session.objects import ObjectRow, list_objects
from normlift_ns.session.prompts import build_query, encode_prompts
from normlift_ns.session.state import State

Prompt = Annotated[str, msgspec.Meta(min_length=1, max_length=1000)]
Fraction = Annotated[float, msgspec.Meta(ge=0, le=1)]
Arrays = Literal["none", "safetensors"]
MAX_FEATURES = 2**17
"""Maximum number of Gaussians in one request for features."""


class Question(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Prompts and settings of a query, as in `LiftedRun.ask`."""

    texts: Annotated[list[Prompt], msgspec.Meta(min_length=1, max_length=64)]
    negatives: Annotated[list[Prompt], msgspec.Meta(max_length=64)] | None = None
    relevancy: RelevancyRule | Literal["auto"] = "auto"
    threshold: Finite | Literal["auto"] | None = None
    min_reliability: Fraction = 0.0
    refined: bool = True


class QueryRequest(Question, frozen=True, forbid_unknown_fields=True):
    """Question, and the format of the arrays in the response."""

    arrays: Arrays = "none"
    """safetensors: the response is a safetensors file with `relevancy` [N, Q] float32 and `selected` [N, Q] bool, and
    the JSON response in its metadata."""


class Selection(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Selection of Gaussians by prompts, an object, a ray, a region or a mask, or of the likely floaters."""

    question: Question | None = None
    """Prompts that select Gaussians; None to select without prompts."""
    prompt: Annotated[int, msgspec.Meta(ge=0)] | None = None
    """Index of the prompt to select by (default: all prompts)."""
    object: Annotated[int, msgspec.Meta(ge=1)] | None = None
    """Number of an object to select, from the response of /objects to the same question and prompt."""
    ray: Ray | None = None
    """Ray; the object that it hits is selected."""
    region: Region | None = None
    """Polygon in an image; the visible Gaussians inside it are selected."""
    floaters: bool = False
    """Select the likely floaters."""
    mask: Annotated[bytes, msgspec.Meta(max_length=2**22)] | None = None
    """Mask of all Gaussians as packed bits in base64. The highest bit of the first byte is the first Gaussian."""
    invert: bool = False
    """Select all other Gaussians instead."""


class ExportRequest(Selection, frozen=True, forbid_unknown_fields=True):
    """Selection to export; the response is a file."""

    format: Annotated[str, msgspec.Meta(max_length=20)] = "ply"


class SelectRequest(Selection, frozen=True, forbid_unknown_fields=True):
    """Selection, and the format of its mask in the response."""

    arrays: Literal["none", "npy"] = "none"
    """npy: the response is the mask [N] as an NPY file."""


class SaveRequest(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Question whose prompts to store in the run."""

    question: Question
    replace: bool = True
    """True to replace the prompts stored in the run, False to add the new prompts to them."""


class RenderRequest(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Request for an image of the scene; the response is a JPEG file."""

    view: str | int = 0
    """Name or index of the training image whose camera to use."""
    camera: CameraValue | None = None
    """Camera to use instead of that of a training image."""
    page_view: PageView | None = None
    """Camera as position and target, to use instead of that of a training image."""
    selection: Selection | None = None
    mode: ColorMode = "overlay"
    isolate: bool = False
    """Draw only the selection, in trained colors regardless of `mode`."""
    max_size: Annotated[int, msgspec.Meta(ge=16, le=2048)] = 800


class Histogram(msgspec.Struct, frozen=True):
    """Histogram of relevancies in bins of equal width, from `low` to `high`."""

    low: float
    high: float
    counts: list[int]
    median: float
    top: float


class PromptResult(msgspec.Struct, frozen=True):
    """Result for one prompt, as in `Finding`; positions are in scene units."""

    text: str
    fraction: float
    centroid: list[float] | None
    extent: list[float] | None
    peak: float | None
    mean_reliability: float | None
    verdict: str | None
    nearest: list[float] | None
    suggested_threshold: float | None
    histogram: Histogram | None
    count: int


class QueryResult(msgspec.Struct, frozen=True):
    """Answer to a question."""

    results: list[PromptResult]
    relevancy: str
    """Relevancy rule of the query."""
    threshold: float
    min_reliability: float
    num_gaussians: int


class ObjectResult(msgspec.Struct, frozen=True):
    """Object of a selection. Positions are in scene units."""

    id: int
    text: str
    count: int
    center: list[float]
    min: list[float]
    """Lower corner of the box around the central 98 % of the centers along each axis; `max` is its upper corner."""
    max: list[float]
    reliability: float
    views: float
    evidence: str


class ObjectsResult(msgspec.Struct, frozen=True):
    """Objects, ordered by prompt and by descending size."""

    objects: list[ObjectResult]
    left_out: int
    """Number of objects that are not listed."""
    in_smaller_parts: int
    """Number of Gaussians in components too small to be objects, counted separately for each prompt."""


class SelectResult(msgspec.Struct, frozen=True):
    """Size and position of a selection."""

    count: int
    visible: int
    center: list[float] | None
    min: list[float] | None
    max: list[float] | None


class VoteResult(msgspec.Struct, frozen=True):
    """Vote of an image for a selection."""

    name: str
    url: str | None
    """Image as a data URL; None if it cannot be read. It has outlines of the regions that voted, unless they cannot be
    drawn (see `ExplainResult.problem`)."""
    regions: int
    share: float
    agreement: float
    disagreement: float


class ExplainResult(msgspec.Struct, frozen=True):
    """Explanation of a selection by the images that voted for it."""

    text: str
    agreement: float
    effective_views: float
    problem: str | None
    support: list[VoteResult]
    disagreement: list[VoteResult]


MAX_OBJECTS = 64


def encode_question(served: ServedRun, question: Question) -> tuple[tuple[Any, ...], Query]:
    """Encode a question, and return its prompts and the query.

    Raises:
        ValueError: The encoder cannot encode a prompt.
    """
    settings: dict[str, Any] = {
        "negatives": question.negatives,
        "relevancy": question.relevancy,
        "threshold": question.threshold,
    }
    settings |= {"min_reliability": question.min_reliability, "refined": question.refined}
    prompts = encode_prompts(join_prompts(question.texts), served.read, served.stored())
    unknown = next((prompt.error for prompt in prompts if prompt.error), None)
    if unknown is not None:
        raise InputError(unknown)
    return build_query(served.space.field, prompts, served.read, **settings)


def answer(served: ServedRun, question: Question) -> Answer:
    """Return the answer to a question."""
    return served.space.answer(encode_question(served, question)[1])


def answered(served: ServedRun, question: Question) -> tuple[Answer, QueryResult]:
    """Return the answer to a question as arrays and as JSON types, from the cache if possible."""
    return served.cached(msgspec.json.encode(question), lambda: _answered(served, question), _answer_size)


def _answer_size(answered: tuple[Answer, QueryResult]) -> int:
    return answered[0].relevancy.nbytes + answered[0].selected.nbytes


def _answered(served: ServedRun, question: Question) -> tuple[Answer, QueryResult]:
    result = answer(served, question)
    return result, query_result(result)


def query_result(result: Answer) -> QueryResult:
    """Return an answer as JSON types."""
    rows = [{**finding.to_json(), "count": int(finding.mask.sum())} for finding in result]
    settings = result.question.settings()
    return msgspec.convert({"results": rows, "num_gaussians": len(result.valid), **settings}, QueryResult)


def select_state(served: ServedRun, selection: Selection) -> State:
    """Return a state with the requested selection.

    Raises:
        ValueError: A prompt cannot be encoded, the prompt or the object does not exist, the ray or the region selects
            no Gaussian, or the mask has the wrong size.
    """
    state = State(served.space, color_mode="overlay")
    if selection.question is not None:
        state = actions.ask(state, *encode_question(served, selection.question))
        texts = selection.question.texts
        if (selection.prompt or 0) >= len(texts):
            raise InputError(f"prompt is {selection.prompt}, expected an index from 0 to {len(texts) - 1}")
        state = actions.show_prompt(state, selection.prompt)
    if selection.object is not None:
        state = actions.select(state, find_object(state, selection.object).mask)
    elif selection.ray is not None:
        state = actions.click(state, served.weights(selection.ray.origin, selection.ray.direction))
    elif selection.region is not None:
        state = actions.select(state, region_mask(served, state, selection.region))
    elif selection.floaters:
        state = actions.select(state, served.floaters)
    elif selection.mask is not None:
        state = actions.select(state, unpack_mask(selection.mask, len(served.space)))
    return actions.invert(state) if selection.invert else state


def find_object(state: State, number: int) -> ObjectRow:
    """Return the object with this number in the list of objects; numbers start at 1.

    Raises:
        ValueError: The list has no object with this number.
    """
    objects = list_objects(state, max_objects=MAX_OBJECTS).objects
    if not 1 <= number <= len(objects):
        found = f"has {len(objects)} object{'s' * (len(objects) != 1)}, numbered from 1" if objects else "is empty"
        raise InputError(f"The list has no object {number}. It {found}.")
    return objects[number - 1]


def pack_mask(mask: torch.Tensor) -> bytes:
    """Pack a mask into bits; the inverse of `unpack_mask`."""
    return np.packbits(mask.cpu().numpy()).tobytes()


def unpack_mask(packed: bytes, count: int) -> torch.Tensor:
    """Unpack the mask of `count` Gaussians.

    Raises:
        ValueError: The number of bytes does not match the number of Gaussians.

    >>> unpack_mask(pack_mask(torch.tensor([True, False, True])), 3).tolist()
    [True, False, True]
    """
    if len(packed) != (count + 7) // 8:
        expected = f"expected {(count + 7) // 8:,}, with one bit for each Gaussian"
        raise InputError(f"The number of bytes of the mask is {len(packed):,}; {expected}.")
    return torch.from_numpy(np.unpackbits(np.frombuffer(packed, np.uint8), count=count).astype(bool))


def objects_result(state: State) -> ObjectsResult:
    """Return the objects of a selection."""
    found, rows = list_objects(state, max_objects=MAX_OBJECTS), []
    for number, row in enumerate(found.objects, 1):
        low, high = extent(state, row.mask)
        facts = (number, row.text, row.size, list(row.center), low, high, row.reliability, row.mean_views, row.evidence)
        rows.append(ObjectResult(*facts))
    return ObjectsResult(rows, found.left_out, found.in_smaller_parts)


def extent(state: State, mask: torch.Tensor) -> tuple[list[float], list[float]]:
    """Return the corners of the box around the central 98 % of the centers in `mask` along each axis."""
    low, high = np.quantile(state.space.means[mask].double().cpu().numpy(), (0.01, 0.99), axis=0)
    return low.tolist(), high.tolist()


def select_result(served: ServedRun, state: State) -> SelectResult:
    """Return the size and position of a selection."""
    mask = state.selection
    count, visible = int(mask.sum()), int((mask & served.visible).sum())
    if count == 0:
        return SelectResult(0, 0, None, None, None)
    low, high = extent(state, mask)
    return SelectResult(count, visible, state.space.means[mask].double().mean(dim=0).tolist(), low, high)


def isolated(state: State) -> State:
    """Return a state that draws only the selection, in trained colors."""
    return replace(actions.show_only(state), color_mode="rgb")
