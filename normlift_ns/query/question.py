"""Queries for a semantic field: lines of prompts, their embeddings, and the rule that selects Gaussians.

This module does not need torch.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from jaxtyping import Float

from normlift_ns.core.relevancy import RELEVANCY_RULES
from normlift_ns.errors import InputError
from normlift_ns.io.arrays import check_array, load_arrays, save_arrays
from normlift_ns.io.run_dir import MANIFEST_FILE, read_manifest
from normlift_ns.options import (
    CANONICAL_NEGATIVES,
    RelevancyRule,
    check_bool,
    check_number,
    option_name,
    option_setting,
    renamed,
    short_repr,
)
from normlift_ns.query.text_encoder import DefaultRule, HasManifest, default_rule, encoder_digest

_PROMPT = re.compile(r'\s*(?:"([^"]*)"|([^,;\n]*))\s*(?:[,;\n]|$)')


def split_prompts(text: str) -> list[str]:
    """Split a text into prompts at commas, semicolons and line breaks outside quotes; drop duplicates.

    >>> split_prompts('red mug , bowl;;"salt, pepper"; bowl')
    ['red mug', 'bowl', 'salt, pepper']
    """
    parts = (" ".join((quoted or bare).split()) for quoted, bare in _PROMPT.findall(text))
    return list(dict.fromkeys(part for part in parts if part))


def split_texts(name: str, texts: Sequence[str]) -> tuple[str, ...]:
    """Split the texts of an option into prompts with `split_prompts`; drop duplicates.

    Raises:
        ValueError: There are texts, but they contain no prompt.
    """
    prompts = tuple(dict.fromkeys(prompt for text in texts for prompt in split_prompts(text)))
    if len(texts) > 0 and len(prompts) == 0:
        raise InputError(f"{name} contains no prompt, got {', '.join(map(repr, texts))}; give at least one prompt")
    return prompts


def join_prompts(texts: Sequence[str]) -> str:
    """Join texts into a line from which `split_prompts` recovers them, apart from quotes, extra blanks and duplicates.

    >>> join_prompts(["red mug", "salt, pepper"])
    'red mug, "salt, pepper"'
    """
    lines = (" ".join(text.replace('"', " ").split()) for text in texts)
    return ", ".join(f'"{line}"' if re.search("[,;]", line) else line for line in lines)


def as_numpy(array: Any) -> np.ndarray:
    """Convert a tensor on any device to a NumPy array; return a NumPy array unchanged."""
    return array if isinstance(array, np.ndarray) else array.detach().cpu().numpy()


@dataclass(frozen=True, eq=False)
class Query:
    """Query with Q prompts, their embeddings and the settings that select Gaussians. Tensors become NumPy arrays."""

    texts: tuple[str, ...]
    embeddings: Float[np.ndarray, "q d"]
    """One embedding per prompt, with any norm > 0."""
    negatives: tuple[str, ...] = ()
    """Negative prompts, for rules that need them."""
    negative_embeddings: Float[np.ndarray, "b d"] | None = None
    rule: RelevancyRule = "cosine"
    threshold: float = 0.5
    """Relevancy above which a Gaussian is selected."""
    min_reliability: float = 0.0
    """Minimum reliability R of a selected Gaussian, in 0..1."""
    refined: bool = True
    """Use refined directions."""
    encoder: str | None = None
    """Digest of the encoder that computed the embeddings, from `encoder_digest`; None if unknown."""
    suggest_threshold: bool = False
    """Use the threshold that the histogram of all relevancies suggests. The query in the answer has this threshold."""
    gated: bool = False
    """Select no Gaussian for a prompt that is probably not in the scene."""

    def __post_init__(self) -> None:
        for name in ("embeddings", "negative_embeddings"):
            value = getattr(self, name)
            if value is not None:
                object.__setattr__(self, name, as_numpy(value))

    def settings(self) -> dict[str, Any]:
        """Return the settings that select Gaussians, under their names in JSON files."""
        return {"relevancy": self.rule, "threshold": self.threshold, "min_reliability": self.min_reliability}


@renamed(rule="relevancy")
def make_query(
    field: HasManifest,
    encode: Callable[[Sequence[str]], Any],
    texts: Sequence[str],
    *,
    negatives: Sequence[str] | None = None,
    relevancy: RelevancyRule | Literal["auto"] = "auto",
    threshold: float | Literal["auto"] | None = None,
    min_reliability: float = 0.0,
    refined: bool = True,
) -> Query:
    """Encode prompts as a query for a field.

    Args:
        field: Field to query.
        encode: Function that returns one embedding per text, from an encoder that fits the field.
        texts: Prompts.
        negatives: Negative prompts. If None, use those of `default_rule`, or else `CANONICAL_NEGATIVES` if the rule
            needs negatives.
        relevancy: Relevancy rule. "auto" is the rule of `default_rule` if `negatives` is None, cosine if `negatives` is
            empty, and lerf otherwise.
        threshold: Relevancy above which a Gaussian is selected. "auto" is the threshold that the histogram suggests.
            None is the threshold of `default_rule` for the default rule of the field. For other rules, it is that of
            `RELEVANCY_RULES` if the rule needs negatives, else "auto", because no threshold suits all encoders.
        min_reliability: Minimum reliability R of a selected Gaussian, in 0..1.
        refined: Use refined directions.
    Raises:
        ValueError: An argument is not valid, or the encoder cannot encode a prompt, for instance because it is empty.
    """
    _check_rules(negatives, relevancy, threshold)
    min_reliability = check_number("min_reliability", min_reliability)
    check_bool("refined", refined)
    default = default_rule(field)
    if relevancy == "auto":
        relevancy = default.rule if negatives is None else "cosine" if len(negatives) == 0 else "lerf"
    gated, threshold = threshold in (None, "auto"), _resolve_threshold(default, relevancy, threshold)
    negatives = _resolve_negatives(default, relevancy, negatives)
    return Query(
        texts=tuple(texts),
        embeddings=encode(texts),
        negatives=negatives,
        negative_embeddings=encode(negatives) if len(negatives) > 0 else None,
        rule=relevancy,
        threshold=RELEVANCY_RULES[relevancy].threshold if threshold == "auto" else threshold,
        suggest_threshold=threshold == "auto",
        gated=gated,
        min_reliability=min_reliability,
        refined=refined,
        encoder=encoder_digest(field.manifest),
    )


def _resolve_threshold(
    default: DefaultRule, relevancy: RelevancyRule, threshold: float | str | None
) -> float | Literal["auto"]:
    if threshold == "auto":
        return "auto"
    if threshold is not None:
        return check_number("threshold", threshold)
    if relevancy == default.rule:
        return default.threshold
    return RELEVANCY_RULES[relevancy].threshold if RELEVANCY_RULES[relevancy].needs_negatives else "auto"


def _resolve_negatives(
    default: DefaultRule, relevancy: RelevancyRule, negatives: Sequence[str] | None
) -> tuple[str, ...]:
    needed = CANONICAL_NEGATIVES if RELEVANCY_RULES[relevancy].needs_negatives else ()
    if negatives is None:
        return tuple(default.negatives or needed)
    if needed and len(negatives) == 0:
        rule, names = option_setting("relevancy", relevancy), option_name("negatives")
        raise InputError(f"{rule} needs at least one entry in {names}, got none")
    return tuple(negatives)


def _check_rules(negatives: object, relevancy: str, threshold: object) -> None:
    if negatives is not None and not isinstance(negatives, Sequence):
        raise InputError(f"negatives must be a list of strings, got {short_repr(negatives)}")
    if isinstance(negatives, str):
        raise InputError(
            f"negatives must be a list of strings, got the single string {negatives!r}. Write [{negatives!r}]."
        )
    if relevancy not in ("auto", *RELEVANCY_RULES):
        raise InputError(f"relevancy must be one of auto, {', '.join(RELEVANCY_RULES)}; got {relevancy!r}")
    if isinstance(threshold, str) and threshold != "auto":
        raise InputError(f'threshold must be a number or "auto", got {short_repr(threshold)}')


# Storage of a query in a run.
#
# nerfstudio's own commands can render a stored query without a text encoder.


QUERIES_FILE = "queries.safetensors"
"""Name of the file that stores a query in the folder of a field. The embeddings are tensors; the rest is metadata."""
_METADATA_KEY, _VECTORS = "question", ("vectors", "negative_vectors")
_REMEDY = "delete it, or store the query again with: ns-normlift-query --load-config ... --text ... --save-query True"

NonBlankText = Annotated[str, msgspec.Meta(pattern=r"\S")]


class _Metadata(msgspec.Struct, forbid_unknown_fields=True, rename={"rule": "form"}):
    """JSON metadata of the file: the fields of a `Query`, except the embeddings and `suggest_threshold`."""

    texts: Annotated[tuple[NonBlankText, ...], msgspec.Meta(min_length=1)]
    negatives: tuple[NonBlankText, ...]
    refined: bool
    rule: RelevancyRule
    threshold: float
    min_reliability: Annotated[float, msgspec.Meta(ge=0, le=1)]
    encoder: str | None = None
    gated: bool = False


def save_query(folder: Path, question: Query) -> Path:
    """Write queries.safetensors to the folder of a field, replacing an existing file, and return its path.

    Raises:
        ValueError: The query is not valid, or does not match the field.
        FileNotFoundError: The folder no longer exists.
        OSError: The file cannot be written.
    """
    if not folder.is_dir():
        raise FileNotFoundError(
            f"{folder} no longer exists, so the query was not stored. The run was moved or deleted while it was open. "
            "If it was moved, open it again at its new path."
        )
    if question.suggest_threshold:
        raise InputError(
            'The query cannot be stored because its threshold is "auto". Run the query, then store the `question` of '
            "its answer."
        )
    metadata = _Metadata(**{name: getattr(question, name) for name in _Metadata.__struct_fields__})
    rows = zip(_VECTORS, (question.embeddings, question.negative_embeddings))
    arrays = {name: value.astype(np.float32) for name, value in rows if value is not None}
    try:
        encoded = msgspec.json.encode(metadata).decode()
        _decode(folder, encoded, arrays)
    except (ValueError, TypeError) as error:
        raise InputError(f"The query cannot be stored: {error}") from error
    save_arrays(folder / QUERIES_FILE, arrays, {_METADATA_KEY: encoded}, overwrite=True)
    return folder / QUERIES_FILE


def load_query(folder: Path) -> Query | None:
    """Load the query stored in the folder of a field; return None if there is none.

    Raises:
        ValueError: The file is damaged, contains no query, or does not match the field.
    """
    path = folder / QUERIES_FILE
    if not os.path.lexists(path):
        return None
    if not os.path.isfile(path):
        raise InputError(f"{path} is not a regular file; delete it")
    arrays, metadata, _ = load_arrays(path, legacy_keys=(_METADATA_KEY,), remedy=_REMEDY)
    try:
        if set(metadata) != {_METADATA_KEY}:
            raise InputError(f"its metadata keys are {sorted(metadata)}, expected {_METADATA_KEY}")
        return _decode(folder, metadata[_METADATA_KEY], arrays)
    except (ValueError, RecursionError) as error:  # msgspec's errors are ValueErrors
        raise InputError(f"{path} cannot be used ({error}); {_REMEDY}") from error


def _decode(folder: Path, encoded: str, arrays: dict[str, np.ndarray]) -> Query:
    """Check the metadata and the arrays of embeddings, and return the query that they contain.

    Raises:
        ValueError: The metadata or an embedding is not valid, they contradict each other, or they do not match the
            field in the folder.
    """
    metadata = msgspec.json.decode(encoded, type=_Metadata)
    if not math.isfinite(metadata.threshold):
        raise InputError(f"the threshold is {metadata.threshold}, expected a finite number")
    if not {"vectors"} <= set(arrays) <= set(_VECTORS):
        raise InputError(
            f"it contains {', '.join(sorted(arrays)) or 'nothing'}; expected {_VECTORS[0]}, with or without "
            f"{_VECTORS[1]}"
        )
    negative = arrays.get("negative_vectors")
    if (negative is None) != (len(metadata.negatives) == 0):
        found = "no array" if negative is None else "an array"
        raise InputError(f"its number of negatives is {len(metadata.negatives)}, but it has {found} negative_vectors")
    if RELEVANCY_RULES[metadata.rule].needs_negatives and negative is None:
        raise InputError(f"the rule {metadata.rule!r} needs negatives, but there are none")
    size = arrays["vectors"].shape[-1] if arrays["vectors"].ndim > 0 else 0
    _check_vectors("vectors", arrays["vectors"], metadata.texts, size)
    if negative is not None:
        _check_vectors("negative_vectors", negative, metadata.negatives, size)
    question = Query(embeddings=arrays["vectors"], negative_embeddings=negative, **msgspec.structs.asdict(metadata))
    if (folder / MANIFEST_FILE).exists():
        _check_encoder(question, read_manifest(folder)[0])
    return question


def _check_encoder(question: Query, manifest: Mapping[str, Any]) -> None:
    """Raise ValueError if the dimension or the encoder of the embeddings differs from that of the field."""
    size, field_encoder = question.embeddings.shape[1], encoder_digest(manifest)
    if size != manifest["dimension"]:
        raise InputError(
            f"the vectors have {size} dimensions, but the features of the run have {manifest['dimension']}"
        )
    if question.encoder is not None and field_encoder is not None and question.encoder != field_encoder:
        raise InputError(
            f"the prompts are from another encoder ({question.encoder}) than the features of the run ({field_encoder})"
        )


def _check_vectors(name: str, vectors: np.ndarray, texts: Sequence[str], size: int) -> None:
    check_array(f"the array {name}", vectors, "float32", (len(texts), max(1, size)), -math.inf)
    for text, row in zip(texts, vectors):
        if not np.isfinite(row).all() or not row.any():
            raise InputError(f"the vector of {text!r} is zero or not finite")
