"""Text encoders for a lifted run, determined by its manifest.

This module needs torch only to encode prompts that are not in the cache.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, NamedTuple, Protocol, TypeVar

from normlift_ns.encoders.registry import (
    absolute_paths,
    canonical_name,
    encoder_kind,
    find_encoder_kind,
    make_encoder,
    with_encoder,
)
from normlift_ns.encoders.text_files import CachedTextEncoder, LazyTextEncoder, TextEmbeddingFile
from normlift_ns.errors import InputError
from normlift_ns.io.atomic import text_digest
from normlift_ns.options import CANONICAL_NEGATIVES, RelevancyRule, SourceOptions, names_of_0_2, option_name

ENCODER_KEYS = ("encoder", "encoder_model", "encoder_pretrained", "crop_fill", "text_template", "text_vectors")
"""Options that determine the encoder or text embeddings of a field, under their names in manifests (version 0.2)."""
PRECOMPUTED = "given"
"""Encoder name in the manifest for features provided by the user."""
_CHOSEN = "texts_chosen"
"""Manifest key that is set in memory if the user replaced the text embeddings of the lift with another file."""


class DefaultRule(NamedTuple):
    """Default relevancy rule of a field, with negatives and threshold. "auto" stands for the suggested threshold."""

    rule: RelevancyRule
    negatives: tuple[str, ...]
    threshold: float | Literal["auto"]


_PLAIN_COSINE = DefaultRule("cosine", (), "auto")
_CONTRAST = DefaultRule("contrast", (), 0.5)


class HasManifest(Protocol):
    """Interface of objects with a manifest, such as semantic fields of tensors or NumPy arrays."""

    @property
    def manifest(self) -> Mapping[str, Any]:
        """Metadata of the field."""
        ...


FieldT = TypeVar("FieldT", bound=Any)


def encoder_settings(options: SourceOptions) -> dict[str, Any]:
    """Return the settings for `text_encoder_for` as JSON types, with absolute paths."""
    options = with_encoder(options)
    stored = names_of_0_2(options)
    settings = {key: stored[key] for key in ENCODER_KEYS} | absolute_paths(options)
    vectors = options.text_embeddings
    return {**settings, "text_vectors": None if vectors is None else os.path.abspath(vectors)}


def precomputed_settings(text_vectors: str | None) -> dict[str, Any]:
    """Return the settings for `text_encoder_for`, for features provided by the user.

    Args:
        text_vectors: Name of a file of text embeddings in the folder of the field; None if there is none.
    """
    settings = encoder_settings(SourceOptions(encoder="open_clip"))
    return {**settings, "encoder": PRECOMPUTED, "text_vectors": text_vectors}


def with_text_source(field: FieldT, *, text_embeddings: Path | None = None, template: str | None = None) -> FieldT:
    """Return a copy of the field with another source of text embeddings.

    Args:
        text_embeddings: File of text embeddings (default: that of the lift).
        template: Prompt template (default: that of the lift).
    """
    changes = {
        "text_vectors": None if text_embeddings is None else os.path.abspath(text_embeddings),
        "text_template": template,
    }
    changes = {key: value for key, value in changes.items() if value is not None}
    encoder = {**(field.manifest.get("encoder") or {}), **changes}
    chosen = {} if text_embeddings is None else {_CHOSEN: True}
    return replace(field, manifest={**field.manifest, "encoder": encoder, **chosen})


def text_encoder_for(field: HasManifest, device: str = "cpu", cache: Path | None = None) -> LazyTextEncoder:
    """Return the text encoder that fits a field.

    Args:
        device: Device of the network, as in `choose_device`; "auto" runs the text tower of OpenCLIP on the CPU.
        cache: Folder for a cache of embeddings; None for no cache.
    Raises:
        ValueError: The encoder is not available, or a weight file or the text embeddings are not those of the lift. A
            network is compared with that of the lift when it encodes its first prompt.
        FileNotFoundError: A weight file of the lift or the file of text embeddings no longer exists.
    """
    options = _options(field)
    if options.text_embeddings is not None:
        if not field.manifest.get(_CHOSEN):
            _check_vectors(options.text_embeddings, _identity(field.manifest.get("features")).get("content"))
        vectors = TextEmbeddingFile(options.text_embeddings)
        if vectors.dimension != field.manifest.get("dimension", vectors.dimension):
            raise InputError(
                f"the vectors in {vectors.file} have {vectors.dimension} dimensions, but the features of the run have "
                f"{field.manifest['dimension']}. Set {option_name('text_embeddings')} to a file of text embeddings "
                "from the encoder of these features."
            )
        return vectors
    try:
        kind = encoder_kind(options.encoder)
    except InputError as error:
        problem = str(error).partition(";")[0]  # the rest suggests another encoder, which a lifted run cannot use
        raise InputError(
            f"The encoder of this run is not available: {problem}. Install or repair its package, or set "
            f"{option_name('text_embeddings')} to a file of text embeddings from that encoder."
        ) from None
    recorded = _identity(field.manifest.get("features"))
    if kind.texts is not None:
        return kind.texts(options, device, cache, recorded)
    return _cached_texts(options, device, cache, recorded)


def _cached_texts(
    options: SourceOptions, device: str, cache: Path | None, recorded: Mapping[str, Any]
) -> CachedTextEncoder:
    """Return a text encoder with a cache.

    It loads its network for prompts that are not in the cache, and raises InputError if the network is not that of the
    lift.
    """

    def network() -> Any:
        from normlift_ns.core.device import choose_device  # noqa: PLC0415 (needs torch)

        encoder = make_encoder(options, choose_device(device))
        if len(recorded) > 0 and json.dumps(encoder.identity, sort_keys=True) != json.dumps(recorded, sort_keys=True):
            raise InputError(
                f"The encoder {options.encoder} on this machine differs from the one that the lift used, so results "
                f"would differ. Its settings are {encoder.identity}, expected {dict(recorded)}. Restore the original "
                f"files of the encoder, set {option_name('text_embeddings')} to a file of text embeddings from the "
                "same network, or lift again with: ns-normlift"
            )
        return encoder

    def settings() -> dict[str, Any]:
        identity = recorded if len(recorded) > 0 else network().identity
        return {"encoder": identity, "template": options.prompt_template}

    return CachedTextEncoder(settings, network, cache)


def _identity(features: object) -> Mapping[str, Any]:
    """Return the identity of the text encoder from the manifest entry `features`; {} if it is not recorded."""
    identity = features.get("texts", features.get("encoder")) if isinstance(features, Mapping) else None
    return identity if isinstance(identity, Mapping) else {}


def encoder_digest(manifest: Mapping[str, Any]) -> str | None:
    """Return a digest that identifies the encoder of a field; None if its manifest does not record the encoder."""
    features = manifest.get("features")
    if not isinstance(features, Mapping) or len(features) == 0:
        return None
    return text_digest(json.dumps(features.get("texts", features.get("encoder", features)), sort_keys=True))


def _check_vectors(path: Path, expected: object) -> None:
    """Raise if a file of text embeddings is missing, or its content has changed since the lift."""
    remedy = (
        f"restore the file, set {option_name('text_embeddings')} to a file of text embeddings from the same network, "
        "or lift again with: ns-normlift"
    )
    if os.path.lexists(path) and not path.is_file():
        raise InputError(f"the run's file of text embeddings {path} is no longer a regular file; {remedy}")
    if not path.is_file():
        raise FileNotFoundError(f"the run's file of text embeddings {path} does not exist; {remedy}")
    if isinstance(expected, str) and (actual := TextEmbeddingFile(path).identity["content"]) != expected:
        raise InputError(
            f"{path} is not the file that the lift used, so results would differ. The digest of its content is "
            f"{actual}, expected {expected}. {remedy[0].upper()}{remedy[1:]}"
        )


def _options(field: HasManifest) -> SourceOptions:
    stored = field.manifest.get("encoder")
    if not isinstance(stored, Mapping) or set(stored) != set(ENCODER_KEYS):
        raise InputError(f"the field's manifest has no valid encoder (found {stored!r}). Lift again with: ns-normlift")
    vectors = stored["text_vectors"]
    if stored["encoder"] == PRECOMPUTED and vectors is None:
        raise InputError(
            "This run was lifted from your own features without text embeddings. Set "
            f"{option_name('text_embeddings')} to a file of text embeddings, or lift again with the argument texts."
        )
    placeholder = {"encoder": "open_clip"} if stored["encoder"] == PRECOMPUTED else {}  # never loaded
    return SourceOptions.stored({**stored, **placeholder})


def encoder_name(field: HasManifest) -> str | None:
    """Return the canonical name of the encoder of a field; None if the manifest does not record it."""
    stored = field.manifest.get("encoder")
    name = stored.get("encoder") if isinstance(stored, Mapping) else None
    return canonical_name(name) if isinstance(name, str) else None


def own_words(field: HasManifest) -> tuple[str, ...]:
    """Return the texts of the field's file of text embeddings, without default negatives, or else the encoder's words.

    Raises:
        ValueError, FileNotFoundError: The file is damaged or does not exist.
    """
    stored = field.manifest.get("encoder")
    vectors = stored.get("text_vectors") if isinstance(stored, Mapping) else None
    if vectors is not None:
        return tuple(text for text in TextEmbeddingFile(Path(vectors)).texts if text not in CANONICAL_NEGATIVES)
    kind = find_encoder_kind(encoder_name(field))
    return () if kind is None else tuple(kind.words())


def default_rule(field: HasManifest) -> DefaultRule:
    """Return the default rule, negatives and threshold of queries of a field.

    The rule is contrast for a field with a null level. For other fields, it is the rule of the encoder, or cosine if
    the encoder is unknown or a file of text embeddings lacks the default negatives of the encoder.
    """
    if field.manifest.get("null_words") is not None:
        return _CONTRAST
    stored = field.manifest.get("encoder")
    if not isinstance(stored, Mapping):
        return _PLAIN_COSINE
    name, vectors = stored.get("encoder"), stored.get("text_vectors")
    kind = find_encoder_kind("open_clip" if name == PRECOMPUTED else name)
    if kind is None:
        return _PLAIN_COSINE
    if vectors is not None:  # the file may not exist yet, if it is written together with the run
        names = TextEmbeddingFile(Path(vectors)).texts if Path(vectors).is_file() else ()
        if not set(kind.negatives) <= set(names):
            return _PLAIN_COSINE
    return DefaultRule(kind.rule, kind.negatives, kind.threshold)
