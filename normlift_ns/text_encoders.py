"""Who reads the texts of a lifted run: the encoder that its manifest names. Needs torch for texts that are new to a
network, and for nothing else.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol, TypeVar, get_args

from normlift_ns.core.disk.digests import file_digest, text_digest
from normlift_ns.encoders.texts.colours import ColourTexts, refuse_template
from normlift_ns.encoders.texts.files import TextVectors
from normlift_ns.encoders.texts.kept import ClipTexts
from normlift_ns.errors import InputError
from normlift_ns.options import CANONICAL_NEGATIVES, EncoderName, SourceOptions

ENCODER_KEYS = ("encoder", "encoder_model", "encoder_pretrained", "crop_fill", "text_template", "text_vectors")
"""Options that say which encoder made a field, or knows the texts; they stand in its manifest."""
GIVEN = "given"
"""In the manifest in place of an encoder: features of the user's own."""
_CHOSEN = "texts_chosen"
"""Key in the manifest of an opened run: texts are looked up in a file that the user named, whatever the lift had."""
_OF_FILES = ("xxh3_128:", "blake2b:")
"""How the identities of weights begin that are the content of a file, and no tag."""
Texts = ColourTexts | TextVectors | ClipTexts
"""Readers of texts: `rows` gives arrays, `text` tensors."""


class Field(Protocol):
    """A semantic field, in tensors or in arrays."""

    @property
    def manifest(self) -> Mapping[str, Any]:
        """What is known of it."""
        ...


FieldT = TypeVar("FieldT", bound=Any)


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
    if not field.manifest.get(_CHOSEN):
        _check_files(field.manifest.get("features"), options)
    if options.text_vectors is not None:
        vectors = TextVectors(options.text_vectors)
        if vectors.dimension != field.manifest.get("dimension", vectors.dimension):
            raise InputError(
                f"the vectors in {vectors.file} have {vectors.dimension} numbers, the features of the run "
                f"{field.manifest['dimension']}; give texts with vectors of the network that made them (--text-vectors)"
            )
        return vectors
    if options.encoder == "colour":
        refuse_template(options.text_template)
        return ColourTexts()
    if options.encoder != "open_clip":
        raise InputError(f"unknown encoder {options.encoder!r}; it is one of {', '.join(get_args(EncoderName))}")

    def network() -> Any:
        from normlift_ns.core.gpu import choose_device  # noqa: PLC0415 (needs torch)
        from normlift_ns.encoders.clip.text_tower import load_text_tower  # noqa: PLC0415

        there = "cpu" if device == "auto" else choose_device(device)  # a text takes less than waking a GPU
        tower = load_text_tower(options.encoder_model, options.encoder_pretrained, options.text_template, there)
        if tower is not None:
            return tower
        from normlift_ns.encoders.build import make_texts  # noqa: PLC0415 (imports open_clip)

        return make_texts(options, choose_device(device))

    return ClipTexts(options.encoder_model, options.encoder_pretrained, options.text_template, network, cache)


def encoder_digest(manifest: Mapping[str, Any]) -> str | None:
    """Tells the encoder of one field from that of another; None where the manifest does not name it."""
    features = manifest.get("features")
    if not isinstance(features, Mapping) or len(features) == 0:
        return None
    return text_digest(json.dumps(features.get("texts", features.get("encoder", features)), sort_keys=True))


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
        if os.path.lexists(path) and not path.is_file():
            raise InputError(f"the run's file of text vectors {path} is no file any more; {remedy}")
        if not path.is_file():
            raise FileNotFoundError(f"the run's file of text vectors {path} does not exist; {remedy}")
        if isinstance(expected, str):
            found = TextVectors(path).identity["content"]
    elif options.encoder == "open_clip":
        path, expected, found = Path(options.encoder_pretrained), texts.get("pretrained"), options.encoder_pretrained
        if path.is_file():
            found = file_digest(path, like=str(expected))
        elif isinstance(expected, str) and expected.startswith(_OF_FILES) and os.path.lexists(path):
            raise InputError(f"weight file {path}, with which the run was lifted, is no file any more; {remedy}")
        elif isinstance(expected, str) and expected.startswith(_OF_FILES):
            raise FileNotFoundError(f"weight file {path}, with which the run was lifted, does not exist; {remedy}")
    else:
        return
    if isinstance(expected, str) and found != expected:
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


def default_negatives(field: Field) -> tuple[str, ...]:
    """LERF's negatives where the encoder knows them: the colour encoder does not, a file of text vectors may."""
    stored = field.manifest.get("encoder")
    if not isinstance(stored, Mapping) or stored.get("encoder") not in ("open_clip", GIVEN):
        return ()
    vectors = stored.get("text_vectors")
    known = CANONICAL_NEGATIVES if vectors is None else TextVectors(Path(vectors)).names
    return CANONICAL_NEGATIVES if set(CANONICAL_NEGATIVES) <= set(known) else ()
