"""Asking a lifted run: texts become relevancies of Gaussians, selections and a few numbers about them."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from normlift_ns.core.field import SemanticField
from normlift_ns.core.gaussians import GaussianScene
from normlift_ns.core.query import CANONICAL_NEGATIVES, RelevancyForm
from normlift_ns.encoders.build import SourceOptions, make_texts
from normlift_ns.encoders.cache import CachedTexts
from normlift_ns.encoders.open_clip import OpenClipEncoder
from normlift_ns.encoders.source import FeatureSource, TextEncoder
from normlift_ns.encoders.text_vectors import TextVectors
from normlift_ns.plugin.queries import Question

ENCODER_KEYS = ("encoder", "encoder_model", "encoder_pretrained", "crop_fill", "text_template", "text_vectors")
"""Options that say which encoder made a field, or knows the texts; they stand in its manifest."""
THRESHOLDS: dict[RelevancyForm, float] = {"cosine": 0.5, "lerf": 0.5, "margin": 0.02}
"""Relevancy above which a Gaussian is selected. margin: the paper's; lerf: a draw; cosine: for the colour encoder."""
_CENTRAL = (0.05, 0.95)


@dataclass(frozen=True)
class Answer:
    """What a field answers to Q texts."""

    question: Question
    relevancy: Float[Tensor, "n q"]
    valid: Bool[Tensor, " n"]
    """Gaussians that have a direction."""
    selected: Bool[Tensor, "n q"]
    """Valid, above the threshold and reliable enough."""

    @property
    def texts(self) -> tuple[str, ...]:
        """The Q texts."""
        return self.question.texts


def encoder_settings(options: SourceOptions) -> dict[str, Any]:
    """What `encoder_of` needs to know, ready for JSON; paths absolute."""
    vectors = options.text_vectors
    settings = {key: getattr(options, key) for key in ENCODER_KEYS}
    return {**settings, "text_vectors": None if vectors is None else os.path.abspath(vectors)}


def with_texts(field: SemanticField, *, vectors: Path | None = None, template: str | None = None) -> SemanticField:
    """The field, with texts looked up in another file, or read in another template; None: as it was lifted."""
    changes = {
        "text_vectors": None if vectors is None else os.path.abspath(vectors),
        "text_template": template,
    }
    given = {key: value for key, value in changes.items() if value is not None}
    return replace(field, manifest={**field.manifest, "encoder": {**field.manifest.get("encoder", {}), **given}})


def encoder_of(field: SemanticField, device: str = "cpu", cache: Path | None = None) -> TextEncoder:
    """The encoder of texts that fits the field.

    Args:
        cache: folder in which to keep vectors of texts that a network has read.
    Raises:
        ValueError: the manifest names none that this version knows.
        FileNotFoundError: its weights, or its text vectors, are not there any more.
    """
    texts = make_texts(_options(field), device)
    return CachedTexts(texts, cache) if cache is not None and isinstance(texts, OpenClipEncoder) else texts


def _options(field: SemanticField) -> SourceOptions:
    stored = field.manifest.get("encoder")
    if not isinstance(stored, Mapping) or set(stored) != set(ENCODER_KEYS):
        raise ValueError(f"the field's manifest names no encoder (found {stored!r}); lift again with: ns-normlift")
    vectors = stored["text_vectors"]
    return SourceOptions(**{**stored, "text_vectors": None if vectors is None else Path(vectors)})


def default_negatives(field: SemanticField) -> tuple[str, ...]:
    """LERF's negatives where the encoder knows them: the colour encoder does not, a file of text vectors may."""
    stored = field.manifest.get("encoder")
    if not isinstance(stored, Mapping) or stored.get("encoder") != "open_clip":
        return ()
    vectors = stored.get("text_vectors")
    known = CANONICAL_NEGATIVES if vectors is None else TextVectors(Path(vectors)).names
    return CANONICAL_NEGATIVES if set(CANONICAL_NEGATIVES) <= set(known) else ()


def pose(
    field: SemanticField,
    encoder: TextEncoder | FeatureSource,
    texts: Sequence[str],
    *,
    negatives: Sequence[str] | None = None,
    form: RelevancyForm | Literal["auto"] = "auto",
    threshold: float | None = None,
    min_reliability: float = 0.0,
    refined: bool = True,
) -> Question:
    """Texts as a question to a field.

    Args:
        negatives: what the texts are compared with; None: `default_negatives`.
        form: "auto": lerf with negatives, cosine without.
        threshold: None: that of `THRESHOLDS`.
        min_reliability: least R of a selected Gaussian, in 0..1.
        refined: ask the refined directions.
    Raises:
        ValueError: a text that is empty or that the encoder does not understand.
    """
    negatives = tuple(default_negatives(field) if negatives is None else negatives)
    if form == "auto":
        form = "cosine" if len(negatives) == 0 else "lerf"
    return Question(
        texts=tuple(texts),
        vectors=encoder.text(texts),
        negatives=negatives,
        negative_vectors=encoder.text(negatives) if len(negatives) > 0 else None,
        form=form,
        threshold=THRESHOLDS[form] if threshold is None else threshold,
        min_reliability=min_reliability,
        refined=refined,
    )


def respond(field: SemanticField, question: Question) -> Answer:
    """Relevancy and selection of every Gaussian for each text.

    Raises:
        ValueError: vectors of another length than the field's, a form without its negatives.
    """
    negatives = None if question.form == "cosine" else question.negative_vectors
    relevancy = field.relevancy(question.vectors, negatives, form=question.form, refined=question.refined)
    found = Answer(question, relevancy, field.valid(refined=question.refined), relevancy.new_empty(0, 0).bool())
    return judge(field, found, question.threshold, question.min_reliability)


def judge(field: SemanticField, answer: Answer, threshold: float, min_reliability: float) -> Answer:
    """The same relevancies with another selection."""
    sure = answer.valid & (field.scalars.reliability >= min_reliability)
    question = replace(answer.question, threshold=threshold, min_reliability=min_reliability)
    return replace(answer, question=question, selected=(answer.relevancy > threshold) & sure[:, None])


def ask(field: SemanticField, encoder: TextEncoder, texts: Sequence[str], **options: Any) -> Answer:
    """Relevancy and selection of every Gaussian for each text; arguments and errors as in `pose` and `respond`."""
    return respond(field, pose(field, encoder, texts, **options))


def summarize(answer: Answer, field: SemanticField, scene: GaussianScene) -> list[dict[str, Any]]:
    """Per text: fraction of Gaussians selected, centroid and extent of the selection, peak relevancy, mean reliability.

    Centroid and mean reliability are weighted by W_j, what the views saw of each Gaussian; the extent is the size of
    the box that holds the central 90 % of the selected Gaussians along each axis. Both in the scene's own units; None
    where nothing is selected.
    """
    rows = []
    for q, text in enumerate(answer.texts):
        chosen = answer.selected[:, q]
        means, weight = scene.means[chosen].double(), field.scalars.weight[chosen].double() + 1e-12
        share = weight / weight.sum()
        found = len(means) > 0
        box = np.quantile(means.numpy(), _CENTRAL, axis=0) if found else np.zeros((2, 3))
        reliability = field.scalars.reliability[chosen].double()
        rows.append(
            {
                "text": text,
                "fraction": float(chosen.double().mean()),
                "centroid": (share[:, None] * means).sum(0).tolist() if found else None,
                "extent": (box[1] - box[0]).tolist() if found else None,
                "peak": float(answer.relevancy[answer.valid, q].max()) if bool(answer.valid.any()) else None,
                "mean_reliability": float((share * reliability).sum()) if found else None,
            }
        )
    return rows


def pixel_relevancy(values: Float[Tensor, "h w q"], alpha: Float[Tensor, "h w"]) -> Float[Tensor, "h w q"]:
    """Composited relevancies per unit of opacity; 0 where (almost) nothing is drawn."""
    return torch.where(alpha[:, :, None] > 0.05, values / alpha[:, :, None].clamp(min=1e-6), 0.0)
