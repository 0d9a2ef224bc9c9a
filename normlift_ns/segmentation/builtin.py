"""The built-in mask sources, without torch: one entry each."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from normlift_ns.encoders.registry import encoder_kind
from normlift_ns.errors import InputError
from normlift_ns.options import DEFAULT_SAM, DEFAULT_SAM3, SourceOptions, short_repr
from normlift_ns.segmentation.registry import MASK_OPTIONS, MaskSource

if TYPE_CHECKING:
    from normlift_ns.encoders.base import FeatureSource, Regions

_COUNT, _PATCH_COUNT = 256, 1024
"""Default number of regions and of patches per image."""
_LEVELS = ("s", "m", "l", "default")


def _check_level(options: SourceOptions, name: str, levels: Sequence[str]) -> None:
    if options.level is not None and options.level not in levels:
        raise InputError(f"--level must be one of {', '.join(levels)} for {name}, got {short_repr(options.level)}")


def _make_sam(options: SourceOptions, device: str) -> Regions:
    from normlift_ns.segmentation.sam import SamMasks  # noqa: PLC0415 (needs torch)

    level: Any = options.level or "l"
    return SamMasks(options.sam_model or DEFAULT_SAM, level, device, options.sam_precision)


def _check_sam(options: SourceOptions) -> None:
    _check_level(options, "sam", _LEVELS)


SAM_MASKS = MaskSource(_make_sam, _check_sam, ("sam_model", "sam_precision", "level"))
"""Masks of SAM, SAM 2 or HQ-SAM for a grid of points."""


def _make_sam3(options: SourceOptions, device: str) -> Regions:
    from normlift_ns.segmentation.sam3 import Sam3Masks  # noqa: PLC0415 (needs torch)

    return Sam3Masks(options.region_texts, options.sam_model or DEFAULT_SAM3, device, options.sam_precision)


def _check_sam3(options: SourceOptions) -> None:
    if len(options.region_texts) == 0:
        raise InputError('regions "sam3" need text prompts: give them with --queries, such as --queries mug plate')


SAM3_MASKS = MaskSource(_make_sam3, _check_sam3, ("sam_model", "sam_precision", "region_texts"))
"""Masks of SAM 3 for text prompts."""


def _make_patches(options: SourceOptions, device: str) -> FeatureSource:
    from normlift_ns.encoders.base import PatchFeatures  # noqa: PLC0415 (needs torch)
    from normlift_ns.encoders.build import make_encoder  # noqa: PLC0415 (needs torch)

    encoder: Any = make_encoder(options, device)
    if not hasattr(encoder, "patches"):
        raise InputError(
            f"--regions patches needs an encoder with patch features; --encoder {options.encoder} has none. Use "
            "--regions superpixel or --encoder open_clip"
        )
    return PatchFeatures(encoder, _PATCH_COUNT if options.region_count is None else options.region_count)


PATCHES = MaskSource(_make_patches, has_features=True)
"""Patches of the encoder's vision transformer."""


def _make_superpixels(options: SourceOptions, device: str) -> Regions:
    from normlift_ns.segmentation.regions import Superpixels  # noqa: PLC0415 (needs torch)

    return Superpixels(_COUNT if options.region_count is None else options.region_count)


SUPERPIXEL = MaskSource(_make_superpixels)
"""SLIC superpixels."""


def _make_grid(options: SourceOptions, device: str) -> Regions:
    from normlift_ns.segmentation.regions import Grid  # noqa: PLC0415 (needs torch)

    return Grid(_COUNT if options.region_count is None else options.region_count)


GRID = MaskSource(_make_grid)
"""Square cells."""


def _make_files(options: SourceOptions, device: str) -> Regions:
    from normlift_ns.segmentation.regions import LabelFiles  # noqa: PLC0415 (needs torch)

    assert options.regions_dir is not None  # checked below
    level = None if options.level is None else int(options.level)
    return LabelFiles(options.regions_dir, options.regions_background, level, options.regions_resample)


def _check_files(options: SourceOptions) -> None:
    if options.regions_dir is None:
        raise InputError(
            'regions "files" need a folder of label maps, one PNG or NPY file per image: give it with --regions-dir'
        )
    if options.level is not None and not (options.level.isascii() and options.level.isdigit()):
        raise InputError(
            f"--level must be the number of a map, 0, 1, ..., for --regions files; got {short_repr(options.level)}"
        )


FILES = MaskSource(_make_files, _check_files, ("regions_dir", "level"))
"""Label maps from a folder."""


def _make_langsplat(options: SourceOptions, device: str) -> FeatureSource:
    from normlift_ns.encoders.build import make_texts  # noqa: PLC0415 (needs torch)
    from normlift_ns.encoders.langsplat import LangSplat  # noqa: PLC0415 (needs torch)

    assert options.features_dir is not None  # checked below
    level: Any = options.level or "l"
    texts = make_texts(options, device)
    return LangSplat(options.features_dir, texts, level, options.features_missing, options.regions_resample)


def _check_langsplat(options: SourceOptions) -> None:
    if options.features_dir is None:
        raise InputError("features 'langsplat' need their folder: give --features langsplat --features-dir FOLDER")
    _check_level(options, "langsplat", (*_LEVELS, "sum"))
    if options.regions != "auto" or options.regions_dir is not None:
        raise InputError(
            "--regions and --regions-dir segment images, but --features imports its own regions; leave one of them out"
        )
    if not encoder_kind(options.encoder).learned and options.text_vectors is None:
        raise InputError(
            f"--encoder {options.encoder} did not make the features in {options.features_dir}; name the OpenCLIP model "
            "that did with --encoder-model and --encoder-pretrained, or give --text-vectors"
        )


LANGSPLAT = MaskSource(_make_langsplat, _check_langsplat, MASK_OPTIONS, has_features=True)
"""Masks and features of LangSplat's preprocessing."""
