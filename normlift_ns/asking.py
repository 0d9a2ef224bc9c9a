"""Asking a semantic field: texts become relevancies of Gaussians, selections and a few numbers about them."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from normlift_ns.core.disk.digests import file_digest
from normlift_ns.core.field import SemanticField
from normlift_ns.core.query import CANONICAL_NEGATIVES
from normlift_ns.encoders.build import make_texts
from normlift_ns.encoders.cache import CachedTexts
from normlift_ns.encoders.clip.encoder import OpenClipEncoder
from normlift_ns.encoders.source import FeatureSource, TextEncoder
from normlift_ns.encoders.text_vectors import TextVectors
from normlift_ns.errors import InputError
from normlift_ns.objects import SceneObject, find_objects
from normlift_ns.options import THRESHOLDS, Rule, SourceOptions
from normlift_ns.ranges import check_bool, check_number, shown

ENCODER_KEYS = ("encoder", "encoder_model", "encoder_pretrained", "crop_fill", "text_template", "text_vectors")
"""Options that say which encoder made a field, or knows the texts; they stand in its manifest."""
GIVEN = "given"
"""In the manifest in place of an encoder: features of the user's own."""
_CHOSEN = "texts_chosen"
"""Key in the manifest of an opened run: texts are looked up in a file that the user named, whatever the lift had."""
_OF_FILES = ("xxh3_128:", "blake2b:")
"""How the identities of weights begin that are the content of a file, and no tag."""
_CENTRAL = (0.05, 0.95)


@dataclass(frozen=True)
class Question:
    """Q texts as the encoder of a field sees them, and what is selected by them."""

    texts: tuple[str, ...]
    vectors: Float[Tensor, "q d"]
    """One per text, of any length > 0."""
    negatives: tuple[str, ...] = ()
    """What the texts are compared with, where the rule compares."""
    negative_vectors: Float[Tensor, "b d"] | None = None
    rule: Rule = "cosine"
    threshold: float = 0.5
    """Relevancy above which a Gaussian is selected."""
    min_reliability: float = 0.0
    """Minimum R of a selected Gaussian, in 0..1."""
    refined: bool = True
    """Use refined features."""


@dataclass(frozen=True, eq=False, repr=False)
class Answer:
    """What a field answers to Q texts. `answer["fox"]` is what it says of one of them; see `Finding`.

    >>> import torch
    >>> from normlift_ns import Evidence, SemanticField, lift
    >>> from normlift_ns.asking import Question, answer
    >>> from normlift_ns.core.evidence import Entries
    >>> seen = Entries(torch.tensor([0, 1]), torch.tensor([1, 2]), torch.ones(2), (2,))
    >>> means = torch.tensor([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]])
    >>> field = SemanticField.build(lift(Evidence.from_entries([seen], 3), torch.eye(2)), means)
    >>> found = answer(field, means, Question(("fox", "shield"), torch.eye(2)))
    >>> found["fox"].mask.tolist(), found["shield"].relevancy.tolist(), found["shield"].centroid
    ([True, False, False], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0])
    """

    question: Question
    field: SemanticField
    means: Float[Tensor, "n 3"]
    """Centres of the Gaussians, in the scene's own units."""
    relevancy: Float[Tensor, "n q"]
    valid: Bool[Tensor, " n"]
    """Gaussians that have a direction."""
    selected: Bool[Tensor, "n q"]
    """Valid, above the threshold and reliable enough."""

    @property
    def texts(self) -> tuple[str, ...]:
        """The Q texts."""
        return self.question.texts

    @property
    def mask(self) -> Bool[Tensor, " n"]:
        """What any of the texts selects."""
        return self.selected.any(dim=1)

    def __len__(self) -> int:
        return len(self.texts)

    def __iter__(self) -> Iterator[Finding]:
        return (Finding(self, index) for index in range(len(self)))

    def __contains__(self, text: object) -> bool:
        return text in self.texts

    def __repr__(self) -> str:
        counts = ", ".join(f"{found.text!r}: {int(found.mask.sum()):,}" for found in self)
        return f"Answer of {len(self.valid):,} Gaussians, selected {counts}"

    def __getitem__(self, text: str) -> Finding:
        """What the field says of one text.

        Raises:
            KeyError: a text that was not asked.
        """
        if text not in self.texts:
            raise KeyError(f"{text!r} was not asked; the texts are {', '.join(map(repr, self.texts))}")
        return Finding(self, self.texts.index(text))


@dataclass(frozen=True, eq=False, repr=False)
class Finding:
    """What a field says of one text. Places are in the scene's own units; None where nothing is selected.

    Means are weighted by W_j, what the views saw of each Gaussian.

    >>> import torch
    >>> from normlift_ns import Evidence, SemanticField, lift
    >>> from normlift_ns.asking import Question, answer
    >>> from normlift_ns.core.evidence import Entries
    >>> seen = Entries(torch.tensor([0, 1, 2]), torch.tensor([1, 1, 2]), torch.tensor([3.0, 1.0, 1.0]), (2,))
    >>> means = torch.tensor([[0.0, 0, 0], [4, 0, 0], [9, 9, 9]])
    >>> field = SemanticField.build(lift(Evidence.from_entries([seen], 3), torch.eye(2)), means)
    >>> fox = answer(field, means, Question(("fox",), torch.tensor([[1.0, 0]])))["fox"]
    >>> fox.mask.tolist(), [round(x, 3) for x in fox.centroid], fox.peak, fox.mean_reliability
    ([True, True, False], [1.0, 0.0, 0.0], 1.0, 0.5)
    """

    answer: Answer
    index: int
    """Of the text."""

    def __repr__(self) -> str:
        return f"Finding {self.text!r}: {int(self.mask.sum()):,} of {len(self.mask):,} Gaussians"

    @property
    def text(self) -> str:
        """The text."""
        return self.answer.texts[self.index]

    @property
    def relevancy(self) -> Float[Tensor, " n"]:
        """Of every Gaussian."""
        return self.answer.relevancy[:, self.index]

    @property
    def mask(self) -> Bool[Tensor, " n"]:
        """The selected Gaussians."""
        return self.answer.selected[:, self.index]

    @property
    def fraction(self) -> float:
        """Share of all Gaussians that is selected."""
        return float(self.mask.double().mean())

    @property
    def centroid(self) -> list[float] | None:
        """Weighted mean of the selected centres, x, y, z."""
        return (self._share[:, None] * self._means).sum(0).tolist() if len(self._means) > 0 else None

    @property
    def extent(self) -> list[float] | None:
        """Size of the box that holds the central 90 % of the selected centres along each axis."""
        if len(self._means) == 0:
            return None
        low, high = np.quantile(self._means.cpu().numpy(), _CENTRAL, axis=0)
        return (high - low).tolist()

    @property
    def peak(self) -> float | None:
        """Largest relevancy of a Gaussian that has a direction."""
        valid = self.answer.valid
        return float(self.relevancy[valid].max()) if bool(valid.any()) else None

    @property
    def mean_reliability(self) -> float | None:
        """Weighted mean of R of the selected Gaussians."""
        reliability = self.answer.field.scalars.reliability[self.mask].double()
        return float((self._share * reliability).sum()) if len(self._means) > 0 else None

    @property
    def objects(self) -> list[SceneObject]:
        """The parts of the selection that hang together in space, the largest first."""
        return find_objects(self.answer.field, self.answer.means, self.mask).objects

    @cached_property
    def _means(self) -> Tensor:
        return self.answer.means[self.mask].double()

    @cached_property
    def _share(self) -> Tensor:
        weight = self.answer.field.scalars.weight[self.mask].double() + 1e-12
        return weight / weight.sum()


def encoder_settings(options: SourceOptions) -> dict[str, Any]:
    """What `encoder_of` needs to know, ready for JSON; paths of files absolute, so that they mean the same anywhere."""
    vectors, pretrained = options.text_vectors, options.encoder_pretrained
    settings = {key: getattr(options, key) for key in ENCODER_KEYS}
    settings["encoder_pretrained"] = os.path.abspath(pretrained) if os.path.isfile(pretrained) else pretrained
    return {**settings, "text_vectors": None if vectors is None else os.path.abspath(vectors)}


def given_settings(text_vectors: str | None) -> dict[str, Any]:
    """What `encoder_of` needs to know of features of the user's own.

    Args:
        text_vectors: name of a file of texts in the folder of the field; None: there is none.
    """
    return {**encoder_settings(SourceOptions()), "encoder": GIVEN, "text_vectors": text_vectors}


def with_texts(field: SemanticField, *, vectors: Path | None = None, template: str | None = None) -> SemanticField:
    """The field, with texts looked up in another file, or read in another template; None: as it was lifted."""
    changes = {
        "text_vectors": None if vectors is None else os.path.abspath(vectors),
        "text_template": template,
    }
    given = {key: value for key, value in changes.items() if value is not None}
    encoder = {**(field.manifest.get("encoder") or {}), **given}
    chosen = {} if vectors is None else {_CHOSEN: True}
    return replace(field, manifest={**field.manifest, "encoder": encoder, **chosen})


def encoder_of(field: SemanticField, device: str = "cpu", cache: Path | None = None) -> TextEncoder:
    """The encoder of texts that fits the field.

    Args:
        cache: folder in which to keep vectors of texts that a network has read.
    Raises:
        ValueError: the manifest names none that this version knows, or other files of weights or text vectors are in
            the place of those of the lift.
        FileNotFoundError: its weights, or its text vectors, are not there any more.
    """
    options = _options(field)
    if not field.manifest.get(_CHOSEN):
        _check_files(field.manifest.get("features"), options)
    texts = make_texts(options, device)
    return CachedTexts(texts, cache) if cache is not None and isinstance(texts, OpenClipEncoder) else texts


def _check_files(features: object, options: SourceOptions) -> None:
    """Makes sure that the files of the encoder have the content that they had in the lift, by its digests in the
    manifest. Files are read whole at every use.
    """
    remedy = (
        "put the file of the lift back there; or give texts with vectors of the same network, --text-vectors; or lift "
        "again with: ns-normlift"
    )
    texts = features.get("texts", features.get("encoder")) if isinstance(features, Mapping) else None
    texts = texts if isinstance(texts, Mapping) else {}
    if options.text_vectors is not None:
        path, expected, found = options.text_vectors, texts.get("content"), ""
        if not path.is_file():
            raise FileNotFoundError(f"the run's file of text vectors {path} does not exist; {remedy}")
        if isinstance(expected, str):
            found = TextVectors(path).identity["content"]
    elif options.encoder == "open_clip":
        path, expected, found = Path(options.encoder_pretrained), texts.get("pretrained"), options.encoder_pretrained
        if path.is_file():
            found = file_digest(path, like=str(expected))
        elif isinstance(expected, str) and expected.startswith(_OF_FILES):
            raise FileNotFoundError(f"weight file {path}, with which the run was lifted, does not exist; {remedy}")
    else:
        return
    if isinstance(expected, str) and found != expected:
        raise InputError(
            f"{path} is not what the run was lifted with, and would give other answers: its content is {found}, "
            f"expected {expected}. {remedy[0].upper()}{remedy[1:]}"
        )


def _options(field: SemanticField) -> SourceOptions:
    stored = field.manifest.get("encoder")
    if not isinstance(stored, Mapping) or set(stored) != set(ENCODER_KEYS):
        raise InputError(f"the field's manifest names no encoder (found {stored!r}); lift again with: ns-normlift")
    vectors = stored["text_vectors"]
    if stored["encoder"] == GIVEN and vectors is None:
        raise InputError(
            "this run was lifted from features of your own, without texts; name a file of texts and their vectors "
            "(--text-vectors), or lift again and give texts"
        )
    encoder = "open_clip" if stored["encoder"] == GIVEN else stored["encoder"]  # which the texts do without
    return SourceOptions(**{**stored, "encoder": encoder})


def default_negatives(field: SemanticField) -> tuple[str, ...]:
    """LERF's negatives where the encoder knows them: the colour encoder does not, a file of text vectors may."""
    stored = field.manifest.get("encoder")
    if not isinstance(stored, Mapping) or stored.get("encoder") not in ("open_clip", GIVEN):
        return ()
    vectors = stored.get("text_vectors")
    known = CANONICAL_NEGATIVES if vectors is None else TextVectors(Path(vectors)).names
    return CANONICAL_NEGATIVES if set(CANONICAL_NEGATIVES) <= set(known) else ()


def make_question(
    field: SemanticField,
    encoder: TextEncoder | FeatureSource,
    texts: Sequence[str],
    *,
    negatives: Sequence[str] | None = None,
    rule: Rule | Literal["auto"] = "auto",
    threshold: float | None = None,
    min_reliability: float = 0.0,
    refined: bool = True,
) -> Question:
    """Texts as a question to a field.

    Args:
        negatives: what the texts are compared with; None: `default_negatives`.
        rule: "auto": lerf with negatives, cosine without.
        threshold: None: that of `THRESHOLDS`.
        min_reliability: minimum R of a selected Gaussian, in 0..1.
        refined: use refined features.
    Raises:
        ValueError: a text that is empty or that the encoder does not understand.
    """
    if negatives is not None and not isinstance(negatives, Sequence):
        raise InputError(f"negatives must be a list of texts, got {shown(negatives)}")
    if isinstance(negatives, str):
        raise InputError(f"negatives must be a list of texts, got the single text {negatives!r}; write [{negatives!r}]")
    if rule not in ("auto", *get_args(Rule)):
        raise InputError(f"rule must be auto, {', '.join(get_args(Rule))}; got {rule!r}")
    min_reliability = check_number("min_reliability", min_reliability)
    threshold = None if threshold is None else check_number("threshold", threshold)
    check_bool("refined", refined)
    negatives = tuple(default_negatives(field) if negatives is None else negatives)
    if rule == "auto":
        rule = "cosine" if len(negatives) == 0 else "lerf"
    return Question(
        texts=tuple(texts),
        vectors=encoder.text(texts),
        negatives=negatives,
        negative_vectors=encoder.text(negatives) if len(negatives) > 0 else None,
        rule=rule,
        threshold=THRESHOLDS[rule] if threshold is None else threshold,
        min_reliability=min_reliability,
        refined=refined,
    )


def answer(field: SemanticField, means: Float[Tensor, "n 3"], question: Question) -> Answer:
    """Relevancy and selection of every Gaussian for each text.

    Args:
        means: centres of the Gaussians.
    Raises:
        ValueError: vectors of another length than the field's, a rule without its negatives.
    """
    negatives = None if question.rule == "cosine" else question.negative_vectors
    relevancy = field.relevancy(question.vectors, negatives, rule=question.rule, refined=question.refined)
    valid = field.valid(refined=question.refined)
    found = Answer(question, field, means.detach(), relevancy, valid, relevancy.new_empty(0, 0).bool())
    return reselect(found, question.threshold, question.min_reliability)


def reselect(found: Answer, threshold: float, min_reliability: float) -> Answer:
    """The same relevancies with another selection."""
    sure = found.valid & (found.field.scalars.reliability >= min_reliability)
    question = replace(found.question, threshold=threshold, min_reliability=min_reliability)
    return replace(found, question=question, selected=(found.relevancy > threshold) & sure[:, None])


def summarize(found: Answer) -> list[dict[str, Any]]:
    """The numbers of every `Finding`, ready for JSON."""
    names = ("text", "fraction", "centroid", "extent", "peak", "mean_reliability")
    return [{name: getattr(finding, name) for name in names} for finding in found]


def pixel_relevancy(values: Float[Tensor, "h w q"], alpha: Float[Tensor, "h w"]) -> Float[Tensor, "h w q"]:
    """Composited relevancies per unit of opacity; 0 where (almost) nothing is drawn."""
    return torch.where(alpha[:, :, None] > 0.05, values / alpha[:, :, None].clamp(min=1e-6), 0.0)
