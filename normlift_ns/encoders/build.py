"""A feature source from `SourceOptions`."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import asdict, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any, get_args

from normlift_ns.encoders.foreign import Foreign
from normlift_ns.encoders.kinds import absolute_paths, encoder_kind, is_ours
from normlift_ns.encoders.langsplat.source import LangSplat
from normlift_ns.encoders.patches import PatchFeatures
from normlift_ns.encoders.regions import Grid, LabelFiles, Superpixels
from normlift_ns.encoders.sam.masks import SamMasks
from normlift_ns.encoders.sam.text_masks import Sam3Masks
from normlift_ns.encoders.sam.weights import local_sam
from normlift_ns.encoders.source import Encoder, FeatureSource, RegionFeatures, Regions, TextEncoder
from normlift_ns.encoders.texts.files import TextVectors
from normlift_ns.errors import InputError
from normlift_ns.options import DEFAULT_SAM, DEFAULT_SAM3, FeaturesName, RegionsName, SourceOptions


def make_source(options: SourceOptions, device: str = "cpu") -> FeatureSource:
    """Regions and encoder of the options, joined, or the features of a folder.

    Args:
        device: as in `make_encoder`.
    Raises:
        ValueError: as `make_regions` and `make_encoder`; features without a folder, or a folder without features.
        FileNotFoundError: as those; the folder does not exist.
    """
    if options.features not in get_args(FeaturesName):
        known = ", ".join(get_args(FeaturesName))
        raise InputError(f"unknown features {options.features!r}; --features is one of {known}")
    if options.features == "none":
        if options.features_dir is not None:
            raise InputError(
                f"--features-dir {options.features_dir} has no effect without --features langsplat; add that flag"
            )
        if options.text_vectors is not None:
            raise InputError(
                f"--text-vectors {options.text_vectors} is for imported features; add --features langsplat"
            )
        options = replace(options, regions=resolve_regions(options, device))
        if options.regions == "patches":
            return _make_patches(options, device)
        return RegionFeatures(make_regions(options, device), make_encoder(options, device))
    if options.features_dir is None:
        raise InputError(f"features {options.features!r} need their folder: give it with --features-dir")
    if options.regions != "auto" or options.regions_dir is not None:
        raise InputError(
            "--regions and --regions-dir cut images up, but --features brings regions of its own; leave one out"
        )
    if not encoder_kind(options.encoder).learned and options.text_vectors is None:
        raise InputError(
            f"encoder {options.encoder!r} did not make the features in {options.features_dir}; name the OpenCLIP model "
            "that did with --encoder-model and --encoder-pretrained, or give --text-vectors"
        )
    level: Any = options.level or "l"
    texts = make_texts(options, device)
    return LangSplat(options.features_dir, texts, level, options.features_missing, options.regions_resample)


_PATHS = ("regions_dir", "features_dir", "text_vectors")
"""Options that are paths."""


def source_settings(options: SourceOptions, device: str = "cpu") -> dict[str, Any]:
    """The options of a lift for its manifest, ready for JSON: "auto" decided, files by their absolute paths."""
    if options.features == "none":
        options = replace(options, regions=resolve_regions(options, device))
    settings = {**asdict(options), **absolute_paths(options)}
    settings["sam_model"] = None if options.sam_model is None else _absolute(options.sam_model)
    return {name: os.path.abspath(value) if isinstance(value, Path) else value for name, value in settings.items()}


def _absolute(weights: str) -> str:
    return os.path.abspath(weights) if os.path.exists(weights) else weights


def recorded_source(manifest: Mapping[str, Any], device: str = "cpu") -> FeatureSource:
    """The features that a field was lifted from, to be made again.

    Args:
        device: as in `make_encoder`.
    Raises:
        ValueError: the manifest does not name them, because they were the user's own or the version was an earlier
            one; or what it names gives other features now.
        FileNotFoundError: files that it names are gone.
    """
    settings = manifest.get("source")
    if settings is None:
        raise InputError(
            "the run does not say how its regions and features were made: they were given from Python, or an earlier "
            "version lifted it; lift again with: ns-normlift"
        )
    try:
        options = SourceOptions(**_restored(settings))
    except TypeError as error:
        raise InputError(
            f"the run's manifest names options for its features that this version does not know ({error}); lift again "
            "with: ns-normlift"
        ) from error
    source = make_source(options, device)
    wanted, found = (json.dumps(x, sort_keys=True) for x in (manifest.get("features"), source.identity))
    if wanted != found:
        raise InputError(
            f"the run was lifted from other features than its options give now: {wanted} then, {found} now; lift again "
            "with: ns-normlift"
        )
    return source


def _restored(settings: object) -> dict[str, Any]:
    if not isinstance(settings, Mapping):
        raise TypeError(f"found {type(settings).__name__}, expected an object")
    return {name: Path(x) if name in _PATHS and x is not None else x for name, x in settings.items()}


def make_texts(options: SourceOptions, device: str = "cpu") -> TextEncoder:
    """The text encoder of the options; arguments and errors as in `make_encoder` and `TextVectors`."""
    return make_encoder(options, device) if options.text_vectors is None else TextVectors(options.text_vectors)


def make_encoder(options: SourceOptions, device: str = "cpu") -> Encoder:
    """The encoder of the options.

    Args:
        device: where a network runs, such as "cuda"; results are on the CPU anyway.
    Raises:
        ValueError: an unknown encoder, model, tag of weights or fill; what an encoder of another package refuses.
        FileNotFoundError: a weight file that does not exist.
    """
    kind = encoder_kind(options.encoder)
    if is_ours(kind):
        return kind.make(options, device)
    return Foreign.made(options.encoder, lambda: kind.make(options, device))


def resolve_regions(options: SourceOptions, device: str = "cpu") -> RegionsName:
    """The regions of the options, "auto" decided.

    Raises:
        ValueError: unknown regions.
    """
    if options.regions not in get_args(RegionsName):
        raise InputError(f"unknown regions {options.regions!r}; --regions is one of {', '.join(get_args(RegionsName))}")
    if options.regions != "auto":
        return options.regions
    if options.regions_dir is not None:
        return "files"
    if options.sam_model is not None:
        return "sam"
    kind = encoder_kind(options.encoder)
    if not kind.learned:
        return "superpixel"
    if device.startswith("cuda") and find_spec("transformers") is not None and local_sam(DEFAULT_SAM) is not None:
        return "sam"
    return "patches" if kind.has_patches(options) else "superpixel"


def make_regions(options: SourceOptions, device: str = "cpu") -> Regions:
    """The regions of the options, but for patches, which are not to be had without their features.

    Args:
        device: where a network runs, such as "cuda"; results are on the CPU anyway.
    Raises:
        ValueError: unknown regions, "files" without a folder, a folder or a level that the regions have no use for;
            what `SamMasks` and `Sam3Masks` raise.
        FileNotFoundError: the folder, or the checkpoint of sam, does not exist.
    """
    kind = resolve_regions(options, device)
    if kind not in ("sam", "sam3"):
        _refuse_sam(options, kind)
    if kind != "sam3":
        _refuse(" ".join(options.region_texts) or None, "--region-texts", kind, "sam3")
    if kind == "files":
        if options.regions_dir is None:
            raise InputError(
                'regions "files" need a folder of label maps, one PNG or NPY file per image: give it with --regions-dir'
            )
        level = _number(options.level)
        return LabelFiles(options.regions_dir, options.regions_background, level, options.regions_resample)
    _refuse(options.regions_dir, "--regions-dir", kind, "files")
    if kind == "sam":
        level: Any = options.level or "l"
        return SamMasks(options.sam_model or DEFAULT_SAM, level, device, options.sam_precision)
    _refuse(options.level, "--level", kind, "files or sam")
    if kind == "sam3":
        return Sam3Masks(options.region_texts, options.sam_model or DEFAULT_SAM3, device, options.sam_precision)
    count = 256 if options.region_count is None else options.region_count
    if kind == "patches":
        raise InputError("patches are no regions that another encoder could look at; use make_source")
    return Superpixels(count) if kind == "superpixel" else Grid(count)


def _make_patches(options: SourceOptions, device: str) -> PatchFeatures:
    _refuse_sam(options, "patches")
    _refuse(" ".join(options.region_texts) or None, "--region-texts", "patches", "sam3")
    _refuse(options.regions_dir, "--regions-dir", "patches", "files")
    _refuse(options.level, "--level", "patches", "files or sam")
    encoder: Any = make_encoder(options, device)
    if not hasattr(encoder, "patches"):
        raise InputError(
            f"--regions patches are for encoders that have features of patches; {options.encoder!r} has none. Take "
            "--regions superpixel, or --encoder open_clip"
        )
    return PatchFeatures(encoder, 1024 if options.region_count is None else options.region_count)


def _refuse_sam(options: SourceOptions, kind: str) -> None:
    _refuse(options.sam_model, "--sam-model", kind, "sam")
    _refuse(options.sam_precision if options.sam_precision != "auto" else None, "--sam-precision", kind, "sam")


def _refuse(value: object, flag: str, kind: str, meant: str) -> None:
    if value is not None:
        raise InputError(f'{flag} {value} is for --regions {meant}, not for "{kind}"; leave one of the two out')


def _number(level: str | None) -> int | None:
    if level is not None and not (level.isascii() and level.isdigit()):
        raise InputError(f"--level of --regions files is the number of a map, 0, 1, ...; got {level!r}")
    return None if level is None else int(level)
