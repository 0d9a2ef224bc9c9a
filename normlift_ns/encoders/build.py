"""Construction of feature sources from `SourceOptions`."""

from __future__ import annotations

import json
import os
import warnings
from collections.abc import Mapping
from dataclasses import asdict
from functools import cache
from pathlib import Path
from typing import Any

from jaxtyping import Float
from torch import Tensor

from normlift_ns.encoders.base import FeatureSource, PrecomputedFeatures, RegionFeatures
from normlift_ns.encoders.plugins import PluginRegions
from normlift_ns.encoders.registry import absolute_if_exists, absolute_paths, find_encoder_kind, make_encoder
from normlift_ns.encoders.text_files import CachedTextEncoder, TextEmbeddingFile, TextEncoder
from normlift_ns.errors import InputError, json_type
from normlift_ns.options import SourceOptions
from normlift_ns.segmentation.registry import MASK_SOURCES, check_mask_options, resolve_source


def make_source(options: SourceOptions, device: str = "cpu") -> FeatureSource:
    """Make the feature source that the options select: regions with an encoder, or a source with its own features.

    Args:
        device: Device of the networks; see `make_encoder`.
    Raises:
        ValueError: If the name of the regions or of the features is unknown.
        ValueError: If a folder or level is missing, or has no effect with the other options.
        FileNotFoundError: If the folder of features does not exist.
        ValueError, FileNotFoundError: For the same reasons as `make_encoder`, `SamMasks` and `Sam3Masks`.
    """
    if options.features != "none":
        return _make_masks(options, options.features, device)
    if options.features_dir is not None:
        raise InputError(
            f"--features-dir {options.features_dir} has no effect without --features langsplat; add that flag"
        )
    if (file := options.text_embeddings) is not None:
        raise InputError(
            f"--text-embeddings {file} has no effect without precomputed features; add --features langsplat"
        )
    options = resolve_source(options, device)
    name = options.regions
    masks = _make_masks(options, name, device)
    return masks if MASK_SOURCES.load(name).has_features else RegionFeatures(masks, make_encoder(options, device))


def _make_masks(options: SourceOptions, name: str, device: str) -> Any:
    """Check the options of a mask source, and make its `Regions`, or its `FeatureSource` if it has features."""
    source = check_mask_options(options, name)
    if name in MASK_SOURCES.built_in or source.has_features:
        return source.make(options, device)
    return PluginRegions.made(name, lambda: source.make(options, device))


_PATHS = ("regions_dir", "features_dir", "text_embeddings")
"""Names of options of type `Path`."""


def source_settings(options: SourceOptions, device: str = "cpu") -> dict[str, Any]:
    """Return the options of a lift as JSON-serializable values for its manifest.

    `resolve_source` replaces an automatic encoder and automatic regions. Paths are made absolute.
    """
    options = resolve_source(options, device)
    settings = {**asdict(options), **absolute_paths(options)}
    settings["sam_model"] = None if options.sam_model is None else absolute_if_exists(options.sam_model)
    return {name: os.path.abspath(value) if isinstance(value, Path) else value for name, value in settings.items()}


def restore_source(manifest: Mapping[str, Any], device: str = "cpu") -> FeatureSource:
    """Recreate the feature source from which a field was lifted.

    Args:
        device: Device of the networks; see `make_encoder`.
    Raises:
        ValueError: If the manifest has no feature options, because features were passed from Python or an older
            version lifted the run.
        ValueError: If the recorded options now give different features, or this version does not support them.
        FileNotFoundError: If a recorded file no longer exists.
    """
    settings = manifest.get("source")
    if settings is None:
        raise InputError(
            "the run does not record its feature options: the features were passed from Python, or an older version "
            "lifted the run; lift again with: ns-normlift"
        )
    try:
        if not isinstance(settings, Mapping):
            raise TypeError(f"found {json_type(settings)}, expected an object")
        values: Any = {name: Path(x) if name in _PATHS and x is not None else x for name, x in settings.items()}
        options = SourceOptions(**values)
    except TypeError as error:
        raise InputError(
            f"the run's manifest has feature options that this version does not support ({error}); lift again "
            "with: ns-normlift"
        ) from error
    source = make_source(options, device)
    recorded, current = (json.dumps(x, sort_keys=True) for x in (manifest.get("features"), source.identity))
    if recorded != current:
        raise InputError(
            f"the recorded options of the run now give different features ({recorded} at the lift, {current} now); "
            "lift again with: ns-normlift"
        )
    return source


# Null vocabulary of unrelated words, whose cosines calibrate the cosines of prompts for any encoder.
#
# A Gaussian matches a prompt if its cosine with the prompt is larger than its cosines with almost all unrelated words.
# A prompt is in the scene if its best match is better than those of almost all unrelated words. See
# `core.field.with_null_level`.


_FEWEST = 5
"""Smallest number of words in a null vocabulary."""


@cache
def null_words() -> tuple[str, ...]:
    """Return the 200 object names that research/null_words.py selected."""
    return tuple(json.loads(Path(__file__).with_name("null_words.json").read_text(encoding="utf8")))


def null_vectors(
    source: FeatureSource, encoder: Mapping[str, Any], cache: Path | None = None
) -> Float[Tensor, "m d"] | None:
    """Return the vectors of the null vocabulary of a lift.

    The vocabulary consists of the prompts that were supplied with precomputed features or in a file of text embeddings.
    For other lifts, it is `null_words` if the encoder supports them, and otherwise empty. The result is None if the
    vocabulary has fewer than five words, or the encoder cannot embed a word. It is also None, with a warning, if the
    weights of the encoder are missing.

    Args:
        encoder: Encoder settings from the manifest.
        cache: Folder that caches the vectors of `null_words`, because loading a network for them takes seconds; None to
            compute them each time.
    """
    kind, file = find_encoder_kind(encoder.get("encoder")), encoder.get("text_vectors")
    texts: TextEncoder = source
    if isinstance(source, PrecomputedFeatures):
        words: tuple[str, ...] = tuple(source.texts)
    elif file is not None:
        words = tuple(TextEmbeddingFile(Path(file)).texts)
    else:
        words = null_words() if kind is not None and kind.has_null_words else ()
        identity = {"source": source.identity, "encoder": dict(encoder)}
        texts = CachedTextEncoder(lambda: identity, lambda: source, cache)
    if len(words) < _FEWEST:
        return None
    try:
        return texts.text(words)
    except InputError:  # the encoder cannot embed these words
        return None
    except FileNotFoundError as error:
        remark = "queries of this run cannot compare the scene with unrelated words"
        warnings.warn(f"{remark}, because the text encoder cannot be loaded: {error}", stacklevel=2)
        return None
