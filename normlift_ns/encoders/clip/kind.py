"""Registration of `--encoder open_clip`, without torch."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from normlift_ns.encoders import weights
from normlift_ns.encoders.kinds import EncoderKind
from normlift_ns.errors import InputError
from normlift_ns.options import SourceOptions

if TYPE_CHECKING:
    from normlift_ns.encoders.source import Encoder, TextEncoder
    from normlift_ns.encoders.texts.kept import KeptTexts

_DIGEST_PREFIXES = ("xxh3_128:", "blake2b:")
"""Prefixes of weight identities that are digests of file contents rather than tags."""
_REMEDY = (
    "give a local weight file with --encoder-pretrained, or use the encoder that needs no weights: --encoder colour"
)


def _make_encoder(options: SourceOptions, device: str) -> Encoder:
    from normlift_ns.encoders.clip.encoder import OpenClipEncoder  # noqa: PLC0415 (needs torch)

    model, pretrained = options.encoder_model, options.encoder_pretrained
    return OpenClipEncoder(model, pretrained, options.crop_fill, device, options.text_template)


def _make_texts(options: SourceOptions, device: str, cache: Path | None, recorded: Mapping[str, Any]) -> KeptTexts:
    """Make the text encoder of a lifted run, see `EncoderKind.texts`. A weight file is read completely at every use."""
    from normlift_ns.encoders.texts.kept import KeptTexts, text_identity  # noqa: PLC0415 (needs numpy)

    model, pretrained, template = options.encoder_model, options.encoder_pretrained, options.text_template
    _check_unchanged(pretrained, recorded.get("pretrained"))

    def network() -> TextEncoder:
        from normlift_ns.core.gpu import choose_device  # noqa: PLC0415 (needs torch)
        from normlift_ns.encoders.clip.text_tower import load_text_tower  # noqa: PLC0415

        text_device = "cpu" if device == "auto" else choose_device(device)  # faster than initializing a GPU
        tower: Any = load_text_tower(model, pretrained, template, text_device)
        if tower is not None:
            return tower
        return _make_encoder(options, choose_device(device))  # imports all of open_clip

    return KeptTexts(lambda: text_identity(model, pretrained, template), network, cache)


def _check_unchanged(pretrained: str, expected: object) -> None:
    """Raise InputError or FileNotFoundError unless the weights are those of the lift."""
    remedy = (
        "restore the file of the lift, give embeddings of your texts by the same network with --text-vectors, or lift "
        "again with: ns-normlift"
    )
    if not isinstance(expected, str):
        return
    from normlift_ns.core.disk.digests import file_digest  # noqa: PLC0415 (only queries need it)

    path, identity = Path(pretrained), pretrained
    if path.is_file():
        identity = file_digest(path, like=expected)
    elif expected.startswith(_DIGEST_PREFIXES) and os.path.lexists(path):
        raise InputError(f"weight file {path}, which the run was lifted with, is not a file anymore; {remedy}")
    elif expected.startswith(_DIGEST_PREFIXES):
        raise FileNotFoundError(f"weight file {path}, which the run was lifted with, does not exist; {remedy}")
    if identity != expected:
        raise InputError(
            f"{path} differs from the weights that the run was lifted with, and would give other results: it is "
            f"{identity}, expected {expected}. {remedy[0].upper()}{remedy[1:]}"
        )


def _check_weights(options: SourceOptions) -> None:
    """Raise FileNotFoundError if the weights are neither on this machine nor available for download."""
    model, pretrained = options.encoder_model, options.encoder_pretrained
    if Path(pretrained).is_file():
        return
    if weights.is_path(pretrained, 1):
        raise FileNotFoundError(f"weight file {pretrained} does not exist; check the path, or {_REMEDY}")
    if weights.clip_weights_at_hand(model, pretrained) is False:
        try:
            weights.reach_hub()
        except OSError as error:
            raise FileNotFoundError(
                f"weights {pretrained!r} of OpenCLIP model {model} are not on this machine and cannot be downloaded "
                f"({error}); go online once, {_REMEDY}"
            ) from None


def _has_patches(options: SourceOptions) -> bool:
    from normlift_ns.encoders.clip.patches import why_not_dense  # noqa: PLC0415 (needs torch)

    return why_not_dense(options.encoder_model) is None


OPEN_CLIP = EncoderKind(
    _make_encoder, check=_check_weights, texts=_make_texts, has_patches=_has_patches, paths=("encoder_pretrained",)
)
"""CLIP features of masked crops, or of patches."""
