"""Registration of the built-in encoders, without torch."""

from __future__ import annotations

import os
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from normlift_ns.encoders import weights
from normlift_ns.encoders.huggingface import (
    MODEL_FAMILIES,
    ModelFamily,
    check_huggingface_options,
    check_transformers_version,
    resolve_model_name,
)
from normlift_ns.encoders.open_clip import OPEN_CLIP_REMEDY, missing_patches_reason
from normlift_ns.encoders.registry import EncoderKind
from normlift_ns.errors import InputError
from normlift_ns.options import SourceOptions

if TYPE_CHECKING:
    from normlift_ns.encoders.base import Encoder
    from normlift_ns.encoders.color import ColorTextEncoder
    from normlift_ns.encoders.text_files import CachedTextEncoder, TextEncoder


_DIGEST_PREFIXES = ("xxh3_128:", "blake2b:")
"""Prefixes of weight identities that are digests of file contents rather than tags."""


def _make_encoder(options: SourceOptions, device: str) -> Encoder:
    from normlift_ns.encoders.open_clip_network import OpenClipEncoder  # noqa: PLC0415 (needs torch)

    model, pretrained = options.encoder_model, options.encoder_pretrained
    return OpenClipEncoder(model, pretrained, options.crop_fill, device, options.text_template)


def _make_texts(
    options: SourceOptions, device: str, cache: Path | None, recorded: Mapping[str, Any]
) -> CachedTextEncoder:
    """Make the text encoder of a lifted run, see `EncoderKind.texts`. A weight file is read completely at every use."""
    from normlift_ns.encoders.text_files import CachedTextEncoder, open_clip_text_identity  # noqa: PLC0415 (needs numpy)

    model, pretrained, template = options.encoder_model, options.encoder_pretrained, options.text_template
    _check_unchanged(pretrained, recorded.get("pretrained"))

    def network() -> TextEncoder:
        from normlift_ns.core.device import choose_device  # noqa: PLC0415 (needs torch)
        from normlift_ns.encoders.open_clip_network import load_text_tower  # noqa: PLC0415

        text_device = "cpu" if device == "auto" else choose_device(device)  # faster than initializing a GPU
        tower: Any = load_text_tower(model, pretrained, template, text_device)
        if tower is not None:
            return tower
        return _make_encoder(options, choose_device(device))  # imports all of open_clip

    return CachedTextEncoder(lambda: open_clip_text_identity(model, pretrained, template), network, cache)


def _check_unchanged(pretrained: str, expected: object) -> None:
    """Raise InputError or FileNotFoundError unless the weights are those of the lift."""
    remedy = (
        "restore the file of the lift, give embeddings of your texts by the same network with --text-vectors, or lift "
        "again with: ns-normlift"
    )
    if not isinstance(expected, str):
        return
    from normlift_ns.io.atomic import file_digest  # noqa: PLC0415 (only queries need it)

    path, identity = Path(pretrained), pretrained
    if path.is_file():
        identity = file_digest(path, compare_to=expected)
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
    if weights.is_local_path(pretrained, 1):
        raise FileNotFoundError(f"weight file {pretrained} does not exist; check the path, or {OPEN_CLIP_REMEDY}")
    if weights.has_local_clip_weights(model, pretrained) is False:
        try:
            weights.check_hub_access()
        except OSError as error:
            raise FileNotFoundError(
                f"weights {pretrained!r} of OpenCLIP model {model} are not on this machine and cannot be downloaded "
                f"({error}); go online once, {OPEN_CLIP_REMEDY}"
            ) from None


def _has_patches(options: SourceOptions) -> bool:
    return missing_patches_reason(options.encoder_model) is None


OPEN_CLIP = EncoderKind(
    _make_encoder, check=_check_weights, texts=_make_texts, has_patches=_has_patches, paths=("encoder_pretrained",)
)
"""CLIP features of masked crops, or of patches."""


# Registration of `--encoder siglip`, `siglip2` and `metaclip2`, without torch.
#
# SigLIP is trained with a sigmoid. The match of a text and an image is sigmoid(scale * cosine + bias), with one scale
# > 0 and one bias for all pairs. Of two texts, the one with the larger cosine also has the larger sigmoid, whatever
# scale and bias are. LERF's comparison with negatives therefore applies as with a softmax, and its tie, 0.5, is where
# the sigmoids of text and negative are equal. That rule and that threshold are the defaults.
#
# The sigmoid itself is not a suitable default. Its 0.5 stands for one right caption among the tens of thousands of a
# batch, odds that crops of regions hardly ever reach.


def _model_has_patches(options: SourceOptions) -> bool:
    return True


def _make_kind(family: ModelFamily) -> EncoderKind:
    def make(options: SourceOptions, device: str) -> Encoder:
        from normlift_ns.encoders.huggingface_network import HuggingFaceEncoder  # noqa: PLC0415 (needs torch)

        check_transformers_version(family)
        return HuggingFaceEncoder(
            family.name, resolve_model_name(options, family), options.crop_fill, device, options.text_template
        )

    check = partial(check_huggingface_options, family=family)
    return EncoderKind(make, check=check, has_patches=_model_has_patches, paths=("encoder_model",))


SIGLIP, SIGLIP2, METACLIP2 = (_make_kind(MODEL_FAMILIES[name]) for name in ("siglip", "siglip2", "metaclip2"))


# Registration of `--encoder colour`, without torch.


def _make_color_encoder(options: SourceOptions, device: str) -> Encoder:
    from normlift_ns.encoders.color import ColorEncoder  # noqa: PLC0415 (needs torch)

    _make_color_texts(options, device, None, {})
    return ColorEncoder()


def _make_color_texts(
    options: SourceOptions, device: str, cache: Path | None, recorded: Mapping[str, Any]
) -> ColorTextEncoder:
    from normlift_ns.encoders.color import ColorTextEncoder, check_no_template  # noqa: PLC0415 (needs numpy)

    check_no_template(options.text_template)
    return ColorTextEncoder()


COLOR = EncoderKind(_make_color_encoder, rule="cosine", negatives=(), texts=_make_color_texts, learned=False)
"""Mean colors compared with color names: a neighboring shade has a cosine of 0.9, another color less than 0.5."""
