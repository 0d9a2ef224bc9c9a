"""Registry of encoders by `--encoder` name, and the built-in encoders.

Each encoder, built-in or from another package, is an entry point of the group `normlift_ns.encoders`. This module does
not import torch.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from normlift_ns.encoders import open_clip
from normlift_ns.encoders.huggingface import (
    MODEL_FAMILIES,
    ModelFamily,
    check_huggingface_options,
    check_transformers_version,
    find_local_model,
    resolve_model_name,
)
from normlift_ns.encoders.weights import CONNECT_ONCE, IMAGENET, check_hub_access, is_local_path, third_party_errors
from normlift_ns.errors import InputError
from normlift_ns.options import (
    CANONICAL_NEGATIVES,
    DEFAULT_MODEL,
    DEFAULT_PRETRAINED,
    RelevancyRule,
    SourceOptions,
)
from normlift_ns.registry import Registry

if TYPE_CHECKING:
    from normlift_ns.encoders.base import Encoder
    from normlift_ns.encoders.color import ColorEncoder
    from normlift_ns.encoders.text_files import CachedTextEncoder, LazyTextEncoder, TextEncoder


@dataclass(frozen=True)
class EncoderKind:
    """An encoder with its query defaults, as registered by an entry point of the group `normlift_ns.encoders`.

    The module of an entry point should import torch only inside `make`, so that queries start quickly.

    >>> from normlift_ns.encoders.registry import encoder_kind
    >>> encoder_kind("color").negatives, encoder_kind("open_clip").rule
    ((), 'lerf')
    """

    make: Callable[[SourceOptions, str], Encoder]
    """Function that makes the encoder for options and a device such as "cuda". Weights should be loaded at first
    use."""
    rule: RelevancyRule = "lerf"
    """Default relevancy rule of runs without a null vocabulary; other runs use "contrast"."""
    negatives: tuple[str, ...] = CANONICAL_NEGATIVES
    """Default negative prompts of runs that use `rule`, or () for none."""
    threshold: float | Literal["auto"] = 0.5
    """Default threshold on the relevancy by `rule`, or "auto" for a threshold from the histogram."""
    check: Callable[[SourceOptions], None] = lambda options: None
    """Function that raises InputError or FileNotFoundError for unusable options, without importing torch."""
    texts: Callable[[SourceOptions, str, Path | None, Mapping[str, Any]], LazyTextEncoder] | None = None
    """Function that makes the text encoder of a lifted run, or None to use the encoder itself and cache its embeddings.
    The arguments are the options, the device, the cache folder, and the identity of the encoder at the lift ({} if it
    is unknown)."""
    has_patches: Callable[[SourceOptions], bool] = lambda options: False
    """Function that returns True if the encoder can embed patches with the given options; see `DenseEncoder`."""
    has_null_words: bool = True
    """True if the encoder can embed the words of `build.null_words`. If so, lifts without precomputed prompt
    embeddings use these words as the null vocabulary."""
    known_words: Callable[[str], str] = str
    """Function that returns the words of a prompt that the encoder uses, or "" if the encoder ignores all of them."""
    words: Callable[[], Sequence[str]] = tuple
    """Function that returns the words that name objects in an inventory, or () if there are none."""
    suggested: tuple[float, float] = (0.4, 0.8)
    """Range of suggested thresholds, on a scale from the median relevancy (0) to the relevancy that 20 Gaussians
    exceed, or one Gaussian in a thousand if that is fewer (1)."""
    present_from: tuple[float, float] | None = None
    """Lower limits, for a weak match and for a match, on the cosine that one Gaussian in a thousand exceeds. If
    None, the null vocabulary or the relevancy rule determines the limits."""
    learned: bool = True
    """True if a network processes the images, so that better regions improve its features."""
    pools: bool = False
    """True if the encoder processes each image once and averages inside regions, so that regions take no more time than
    patches."""
    is_here: Callable[[], bool] = lambda: False
    """Function that returns True if the default weights and the packages of the encoder are on this machine.
    `--encoder auto` skips a built-in encoder if the function returns False."""
    paths: tuple[str, ...] = ()
    """Names of options that can be the path of a file or folder. Runs store existing paths as absolute paths."""


_DIGEST_PREFIXES = ("xxh3_128:", "blake2b:")
"""Prefixes of weight identities that are digests of file contents rather than tags."""


def _make_encoder(options: SourceOptions, device: str) -> Encoder:
    from normlift_ns.encoders.open_clip_network import OpenClipEncoder  # noqa: PLC0415 (needs torch)

    model, pretrained = options.encoder_model, options.encoder_pretrained
    return OpenClipEncoder(model, pretrained, options.crop_fill, device, options.prompt_template)


def _make_texts(
    options: SourceOptions, device: str, cache: Path | None, recorded: Mapping[str, Any]
) -> CachedTextEncoder:
    """Make the text encoder of a lifted run; see `EncoderKind.texts`. A local weight file is read in full each time, to
    compute its digest."""
    from normlift_ns.encoders.text_files import CachedTextEncoder, open_clip_text_identity  # noqa: PLC0415 (needs numpy)

    model, pretrained, template = options.encoder_model, options.encoder_pretrained, options.prompt_template
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
    """Raise InputError or FileNotFoundError if the weights differ from the recorded weights of the lift."""
    remedy = (
        "restore the weight file of the lift, give prompt embeddings of the same network with --text-embeddings, or "
        "lift again with: ns-normlift"
    )
    if not isinstance(expected, str):
        return
    from normlift_ns.io.atomic import file_digest  # noqa: PLC0415 (only queries need it)

    path, identity = Path(pretrained), pretrained
    if path.is_file():
        identity = file_digest(path, compare_to=expected)
    elif expected.startswith(_DIGEST_PREFIXES) and os.path.lexists(path):
        raise InputError(f"weight file {path}, which the run was lifted with, is no longer a file; {remedy}")
    elif expected.startswith(_DIGEST_PREFIXES):
        raise FileNotFoundError(f"weight file {path}, which the run was lifted with, does not exist; {remedy}")
    if identity != expected:
        raise InputError(
            f"{path} differs from the weights that the run was lifted with: found {identity}, expected {expected}. "
            f"{remedy[0].upper()}{remedy[1:]}"
        )


def _check_weights(options: SourceOptions) -> None:
    """Raise FileNotFoundError if the weights are neither on this machine nor available for download."""
    model, pretrained, remedy = options.encoder_model, options.encoder_pretrained, open_clip.OPEN_CLIP_REMEDY
    if Path(pretrained).is_file():
        return
    if is_local_path(pretrained, 1):
        raise FileNotFoundError(f"weight file {pretrained} does not exist; check the path, or {remedy}")
    if open_clip.has_local_clip_weights(model, pretrained) is False:
        problem = f"weights {pretrained!r} of OpenCLIP model {model} are not on this machine and cannot be downloaded"
        with third_party_errors(problem, f"{CONNECT_ONCE}, or {remedy}", FileNotFoundError):
            check_hub_access()


OPEN_CLIP = EncoderKind(
    _make_encoder,
    check=_check_weights,
    texts=_make_texts,
    has_patches=lambda options: open_clip.missing_patches_reason(options.encoder_model) is None,
    is_here=lambda: open_clip.has_local_clip_weights(DEFAULT_MODEL, DEFAULT_PRETRAINED) is True,
    paths=("encoder_pretrained",),
)
"""Encoder with CLIP features of masked crops or patches."""


# Registration of `--encoder siglip`, `siglip2` and `metaclip2`, without torch.
#
# SigLIP is trained with a sigmoid. The match of a text and an image is sigmoid(scale * cosine + bias), and all pairs
# share the same scale > 0 and bias. A larger cosine therefore always means a larger sigmoid, so LERF's comparison with
# negatives is valid. Its relevancy is 0.5 if the sigmoids of the prompt and the negative are equal. LERF's rule and the
# threshold 0.5 are therefore the defaults.
#
# The sigmoid itself is not a suitable default. It is calibrated to find one caption among the tens of thousands of a
# training batch, and crops of regions hardly ever reach 0.5.


def _make_kind(family: ModelFamily) -> EncoderKind:
    def make(options: SourceOptions, device: str) -> Encoder:
        from normlift_ns.encoders.huggingface_network import HuggingFaceEncoder  # noqa: PLC0415 (needs torch)

        check_transformers_version(family)
        model = resolve_model_name(options, family)
        return HuggingFaceEncoder(family, model, options.crop_fill, device, options.prompt_template)

    def is_here() -> bool:
        with suppress(InputError):
            check_transformers_version(family)
            return find_local_model(family.default_model) is not None
        return False

    check = partial(check_huggingface_options, family=family)
    return EncoderKind(make, check=check, has_patches=lambda options: True, is_here=is_here, paths=("encoder_model",))


SIGLIP, SIGLIP2, METACLIP2 = (_make_kind(MODEL_FAMILIES[name]) for name in ("siglip", "siglip2", "metaclip2"))


def _make_imagenet_encoder(options: SourceOptions, device: str) -> Encoder:
    from normlift_ns.encoders.imagenet_network import ImageNetEncoder  # noqa: PLC0415 (needs torch)

    for name in _options_of_clip(options):
        flag = f"--{name.replace('_', '-')} {getattr(options, name)}"
        raise InputError(f"{flag} has no effect on --encoder imagenet; remove it")
    return ImageNetEncoder(device)


def _imagenet_words() -> Sequence[str]:
    from normlift_ns.encoders.imagenet import class_names  # noqa: PLC0415 (reads a file)

    return tuple(dict.fromkeys(class_names()))


def _known_to_imagenet(prompt: str) -> str:
    from normlift_ns.encoders.imagenet import known_words  # noqa: PLC0415 (reads a file)

    return known_words(prompt)


IMAGENET_CLASSES = EncoderKind(
    _make_imagenet_encoder,
    known_words=_known_to_imagenet,
    words=_imagenet_words,
    rule="cosine",
    negatives=(),
    threshold="auto",
    check=lambda options: IMAGENET.check(),
    has_patches=lambda options: True,
    pools=True,
    is_here=lambda: IMAGENET.is_here,
)
"""Encoder with dense features of a classifier, which are compared with the vectors of its classes."""


def _make_color_encoder(options: SourceOptions, *_: object) -> ColorEncoder:
    from normlift_ns.encoders.color import ColorEncoder  # noqa: PLC0415 (needs numpy)

    if options.prompt_template != "{}":
        raise InputError(
            f"--prompt-template {options.prompt_template!r} has no effect on --encoder color; remove it, or lift with "
            "--encoder open_clip"
        )
    return ColorEncoder()


def _color_words() -> Sequence[str]:
    from normlift_ns.encoders.color import xkcd_colors  # noqa: PLC0415 (needs numpy)

    return [name for name in xkcd_colors() if "/" not in name]


def _known_to_color(prompt: str) -> str:
    from normlift_ns.encoders.color import find_color_names  # noqa: PLC0415 (needs numpy)

    names = ", ".join(find_color_names(prompt))
    return names.replace("grey", "gray") if "gray" in prompt.lower() else names


COLOR = EncoderKind(
    _make_color_encoder,
    known_words=_known_to_color,
    words=_color_words,
    rule="cosine",
    negatives=(),
    threshold=0.7,
    texts=_make_color_encoder,
    has_null_words=False,
    suggested=(0.8, 0.8),
    present_from=(0.66, 0.74),
    learned=False,
    is_here=lambda: True,
)
"""Encoder with mean colors, which are compared with color names. Most shades of a color have cosines of 0.7 or more
with its name; most other colors have smaller cosines."""


ENCODERS = Registry(
    "normlift_ns.encoders",
    {
        **{name: f"normlift_ns.encoders.registry:{name.upper()}" for name in ("open_clip", *MODEL_FAMILIES)},
        "imagenet": "normlift_ns.encoders.registry:IMAGENET_CLASSES",
        "color": "normlift_ns.encoders.registry:COLOR",
    },
    EncoderKind,
    "encoder",
    "--encoder",
    "open_clip",
)
"""Encoders by `--encoder` name."""


_PREFERENCE = ("open_clip", "siglip2", "siglip", "metaclip2", "imagenet", "color")
"""Encoders that `--encoder auto` tries, in order of preference. The last one is always available."""


def _options_of_clip(options: SourceOptions) -> list[str]:
    """Return the names of non-default options that apply only to networks trained on captions."""
    names, default = ("encoder_model", "encoder_pretrained", "prompt_template"), SourceOptions()
    return [name for name in names if getattr(options, name) != getattr(default, name)]


def with_encoder(options: SourceOptions) -> SourceOptions:
    """Return the options with "auto" replaced by the preferred encoder on this machine.

    The replacement is `open_clip` for LangSplat's features, which OpenCLIP computed, and if `encoder_model`,
    `encoder_pretrained` or `prompt_template` differs from its default.
    """
    if options.encoder != "auto":
        return options
    if options.features == "langsplat" or len(_options_of_clip(options)) > 0:
        return replace(options, encoder="open_clip")
    return replace(options, encoder=next(name for name in _PREFERENCE if ENCODERS.load(name).is_here()))


def canonical_name(encoder: str) -> str:
    """Return the documented name of an encoder. Commands and recorded runs can also use the spelling "colour"."""
    return "color" if encoder == "colour" else encoder


def encoder_kind(name: str) -> EncoderKind:
    """Return the encoder kind with this name. Raises the same errors as `Registry.load`."""
    return ENCODERS.load(canonical_name(name))


def find_encoder_kind(name: object) -> EncoderKind | None:
    """Return the encoder kind with this name, or None if the name is unknown or the kind cannot be loaded."""
    try:
        return encoder_kind(name) if isinstance(name, str) else None
    except InputError:
        return None


def absolute_paths(options: SourceOptions) -> dict[str, str]:
    """Return the options of the encoder that can be paths. Paths of existing files and folders are made absolute."""
    kind = find_encoder_kind(options.encoder)
    return {name: absolute_if_exists(getattr(options, name)) for name in (() if kind is None else kind.paths)}


def absolute_if_exists(name: str) -> str:
    """Return the absolute path if `name` is an existing file or folder, else `name` unchanged."""
    return os.path.abspath(name) if os.path.exists(name) else name


def make_texts(options: SourceOptions, device: str = "cpu") -> TextEncoder:
    """Make the text encoder that the options select. For errors, see `make_encoder` and `TextEmbeddingFile`."""
    from normlift_ns.encoders.text_files import TextEmbeddingFile  # noqa: PLC0415 (needs numpy)

    file = options.text_embeddings
    return make_encoder(options, device) if file is None else TextEmbeddingFile(file)


def make_encoder(options: SourceOptions, device: str = "cpu") -> Encoder:
    """Make the encoder that the options select.

    Args:
        device: Device of the network, such as "cuda"; results are always on the CPU.
    Raises:
        ValueError: If the encoder, the model or the weights tag is unknown, or the prompt template has no placeholder.
        ValueError: If an option does not apply to the encoder, or a required package is missing or too old.
        ValueError: If an encoder of another package rejects the options.
        FileNotFoundError: If a weight file or model folder does not exist.
    """
    from normlift_ns.encoders.plugins import PluginEncoder  # noqa: PLC0415 (needs torch)

    options = with_encoder(options)
    kind = encoder_kind(options.encoder)
    if canonical_name(options.encoder) in ENCODERS.built_in:
        return kind.make(options, device)
    return PluginEncoder.made(options.encoder, lambda: kind.make(options, device))
