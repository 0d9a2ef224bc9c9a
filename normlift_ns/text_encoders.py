"""Who reads the texts of a lifted run: the encoder that its manifest names. Needs torch for texts that are new to a
network, and for nothing else.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, NamedTuple, Protocol, TypeVar

from normlift_ns.core.disk.digests import text_digest
from normlift_ns.encoders.kinds import EncoderKind, Texts, absolute_paths, encoder_kind, known_kind
from normlift_ns.encoders.texts.files import TextVectors
from normlift_ns.encoders.texts.kept import KeptTexts
from normlift_ns.errors import InputError
from normlift_ns.options import Rule, SourceOptions

ENCODER_KEYS = ("encoder", "encoder_model", "encoder_pretrained", "crop_fill", "text_template", "text_vectors")
"""Options that say which encoder made a field, or knows the texts; they stand in its manifest."""
GIVEN = "given"
"""In the manifest in place of an encoder: features of the user's own."""
_CHOSEN = "texts_chosen"
"""Key in the manifest of an opened run: texts are looked up in a file that the user named, whatever the lift had."""


class DefaultRule(NamedTuple):
    """A rule of relevancy, what it compares with, and its threshold; "auto": what the histogram suggests."""

    rule: Rule
    negatives: tuple[str, ...]
    threshold: float | Literal["auto"]


_COSINES = DefaultRule("cosine", (), "auto")


class Field(Protocol):
    """A semantic field, in tensors or in arrays."""

    @property
    def manifest(self) -> Mapping[str, Any]:
        """What is known of it."""
        ...


FieldT = TypeVar("FieldT", bound=Any)


def encoder_settings(options: SourceOptions) -> dict[str, Any]:
    """What `encoder_of` needs to know, ready for JSON; paths of files absolute, so that they mean the same anywhere."""
    settings = {key: getattr(options, key) for key in ENCODER_KEYS} | absolute_paths(options)
    vectors = options.text_vectors
    return {**settings, "text_vectors": None if vectors is None else os.path.abspath(vectors)}


def given_settings(text_vectors: str | None) -> dict[str, Any]:
    """What `encoder_of` needs to know of features of the user's own.

    Args:
        text_vectors: name of a file of texts in the folder of the field; None: there is none.
    """
    return {**encoder_settings(SourceOptions()), "encoder": GIVEN, "text_vectors": text_vectors}


def with_texts(field: FieldT, *, vectors: Path | None = None, template: str | None = None) -> FieldT:
    """The field, with texts looked up in another file, or read in another template; None: as it was lifted."""
    changes = {
        "text_vectors": None if vectors is None else os.path.abspath(vectors),
        "text_template": template,
    }
    given = {key: value for key, value in changes.items() if value is not None}
    encoder = {**(field.manifest.get("encoder") or {}), **given}
    chosen = {} if vectors is None else {_CHOSEN: True}
    return replace(field, manifest={**field.manifest, "encoder": encoder, **chosen})


def encoder_of(field: Field, device: str = "cpu", cache: Path | None = None) -> Texts:
    """The encoder of texts that fits the field.

    Args:
        device: where a network runs, as `choose_device` takes it; "auto": on the CPU where it is a plain text tower.
        cache: folder in which to keep vectors of texts that a network has read.
    Raises:
        ValueError: the manifest names none that this version knows, or other files of weights or text vectors are in
            the place of those of the lift.
        FileNotFoundError: its weights, or its text vectors, are not there any more.
    """
    options = _options(field)
    if options.text_vectors is not None:
        if not field.manifest.get(_CHOSEN):
            _check_vectors(options.text_vectors, _identity(field.manifest.get("features")).get("content"))
        vectors = TextVectors(options.text_vectors)
        if vectors.dimension != field.manifest.get("dimension", vectors.dimension):
            raise InputError(
                f"the vectors in {vectors.file} have {vectors.dimension} numbers, the features of the run "
                f"{field.manifest['dimension']}; give texts with vectors of the network that made them (--text-vectors)"
            )
        return vectors
    kind = _kind(options.encoder)
    recorded = _identity(field.manifest.get("features"))
    if kind.texts is not None:
        return kind.texts(options, device, cache, recorded)
    return _read_and_kept(kind, options, device, cache, recorded)


def _kind(name: str) -> EncoderKind:
    try:
        return encoder_kind(name)
    except InputError as error:
        raise InputError(
            f"the run was lifted with an encoder that is not to be had here: {error}. Install its package, or give "
            "texts with vectors of it (--text-vectors)"
        ) from None


def _read_and_kept(
    kind: EncoderKind, options: SourceOptions, device: str, cache: Path | None, recorded: Mapping[str, Any]
) -> KeptTexts:
    """The texts of an encoder, which is made where a text is new; it must be that of the lift."""

    def network() -> Any:
        from normlift_ns.core.gpu import choose_device  # noqa: PLC0415 (needs torch)
        from normlift_ns.encoders.build import make_encoder  # noqa: PLC0415

        encoder = make_encoder(options, choose_device(device))
        if len(recorded) > 0 and json.dumps(encoder.identity, sort_keys=True) != json.dumps(recorded, sort_keys=True):
            raise InputError(
                f"the encoder {options.encoder} is not what the run was lifted with, and would give other answers: it "
                f"is {encoder.identity}, expected {dict(recorded)}. Put its files of the lift back; or give texts with "
                "vectors of the same network, --text-vectors; or lift again with: ns-normlift"
            )
        return encoder

    def settings() -> dict[str, Any]:
        identity = recorded if len(recorded) > 0 else network().identity
        return {"encoder": identity, "template": options.text_template}

    return KeptTexts(settings, network, cache)


def _identity(features: object) -> Mapping[str, Any]:
    """What the manifest says of the encoder that made features; nothing where it does not."""
    found = features.get("texts", features.get("encoder")) if isinstance(features, Mapping) else None
    return found if isinstance(found, Mapping) else {}


def encoder_digest(manifest: Mapping[str, Any]) -> str | None:
    """Tells the encoder of one field from that of another; None where the manifest does not name it."""
    features = manifest.get("features")
    if not isinstance(features, Mapping) or len(features) == 0:
        return None
    return text_digest(json.dumps(features.get("texts", features.get("encoder", features)), sort_keys=True))


def _check_vectors(path: Path, expected: object) -> None:
    """Makes sure that a file of text vectors has the content that it had in the lift. It is read whole at every use."""
    remedy = (
        "put the file of the lift back there; or give texts with vectors of the same network, --text-vectors; or lift "
        "again with: ns-normlift"
    )
    if os.path.lexists(path) and not path.is_file():
        raise InputError(f"the run's file of text vectors {path} is no file any more; {remedy}")
    if not path.is_file():
        raise FileNotFoundError(f"the run's file of text vectors {path} does not exist; {remedy}")
    if isinstance(expected, str) and (found := TextVectors(path).identity["content"]) != expected:
        raise InputError(
            f"{path} is not what the run was lifted with, and would give other answers: its content is {found}, "
            f"expected {expected}. {remedy[0].upper()}{remedy[1:]}"
        )


def _options(field: Field) -> SourceOptions:
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


def encoder_name(field: Field) -> str | None:
    """The name of the encoder that made a field; None where the manifest does not name it."""
    stored = field.manifest.get("encoder")
    name = stored.get("encoder") if isinstance(stored, Mapping) else None
    return name if isinstance(name, str) else None


def default_rule(field: Field) -> DefaultRule:
    """How the encoder of a field is asked unless a question says otherwise. A file of text vectors may not know its
    negatives; then cosines are left, as of an encoder that is not known here."""
    stored = field.manifest.get("encoder")
    if not isinstance(stored, Mapping):
        return _COSINES
    name, vectors = stored.get("encoder"), stored.get("text_vectors")
    kind = known_kind("open_clip" if name == GIVEN else name)
    if kind is None:
        return _COSINES
    if vectors is not None:  # it may be written later, with the run
        known = TextVectors(Path(vectors)).names if Path(vectors).is_file() else ()
        if not set(kind.negatives) <= set(known):
            return _COSINES
    return DefaultRule(kind.rule, kind.negatives, kind.threshold)
