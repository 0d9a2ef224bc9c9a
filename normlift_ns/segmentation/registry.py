"""Mask sources by their `--regions` and `--features` names: how each is made, and which options it takes.

Every mask source, built-in or from another package, is an entry point of the group `normlift_ns.masks`. Imports nothing
heavy.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from typing import TYPE_CHECKING, get_args

from normlift_ns.encoders.registry import accept_all_options, encoder_kind
from normlift_ns.encoders.weights import has_local_sam_weights
from normlift_ns.errors import InputError
from normlift_ns.options import DEFAULT_SAM, MASK_GROUP, FeatureKind, SourceOptions
from normlift_ns.registry import Registry

if TYPE_CHECKING:
    from normlift_ns.encoders.base import FeatureSource, Regions

MASK_OPTIONS = ("sam_model", "sam_precision", "region_texts", "regions_dir", "level")
"""Options of `SourceOptions` that only some mask sources take."""


@dataclass(frozen=True)
class MaskSource:
    """A mask source; the object that an entry point of the group `normlift_ns.masks` names.

    The module that defines it should import torch only inside `make`, so that error messages stay fast.

    >>> from normlift_ns.segmentation.registry import MASK_SOURCES
    >>> MASK_SOURCES.load("files").options
    ('regions_dir', 'level')
    """

    make: Callable[[SourceOptions, str], Regions | FeatureSource]
    """Makes the regions from the options and a device such as "cuda". It should load weights at their first use."""
    check: Callable[[SourceOptions], None] = accept_all_options
    """Raises InputError or FileNotFoundError for options that cannot work, without importing torch."""
    options: tuple[str, ...] = ()
    """Those of `MASK_OPTIONS` that it takes."""
    has_features: bool = False
    """True if `make` returns a `FeatureSource`, which needs no encoder of regions."""


MASK_SOURCES = Registry(
    MASK_GROUP,
    {
        "sam": "normlift_ns.segmentation.builtin:SAM_MASKS",
        "sam3": "normlift_ns.segmentation.builtin:SAM3_MASKS",
        "patches": "normlift_ns.segmentation.builtin:PATCHES",
        "superpixel": "normlift_ns.segmentation.builtin:SUPERPIXEL",
        "grid": "normlift_ns.segmentation.builtin:GRID",
        "files": "normlift_ns.segmentation.builtin:FILES",
        "langsplat": "normlift_ns.segmentation.builtin:LANGSPLAT",
    },
    MaskSource,
    "mask source",
    "--regions",
    "superpixel",
)
"""Mask sources by name. Those in `FeatureKind` are selected with `--features`, all others with `--regions`."""


def requested_regions(options: SourceOptions) -> str:
    """Return the regions that the options name or imply; "auto" if they depend on the encoder and the device."""
    if options.regions != "auto":
        return options.regions
    if options.regions_dir is not None:
        return "files"
    return "auto" if options.sam_model is None else "sam"


def resolve_regions(options: SourceOptions, device: str = "cpu") -> str:
    """Return the regions of the options, with "auto" resolved."""
    name = requested_regions(options)
    if name != "auto":
        return name
    kind = encoder_kind(options.encoder)
    if not kind.learned:
        return "superpixel"
    if device.startswith("cuda") and find_spec("transformers") is not None and has_local_sam_weights(DEFAULT_SAM):
        return "sam"
    return "patches" if kind.has_patches(options) else "superpixel"


def check_mask_options(options: SourceOptions, name: str) -> MaskSource:
    """Return a mask source whose options can work, as far as this is known without torch.

    Raises:
        ValueError: If the name is unknown, an option is set that only other mask sources take, or the mask source
            rejects the options.
        FileNotFoundError: If a file of the mask source does not exist.
    """
    source, default = MASK_SOURCES.load(name), SourceOptions()
    for option in MASK_OPTIONS:
        value = getattr(options, option)
        if option not in source.options and value != getattr(default, option):
            shown = " ".join(value) if isinstance(value, tuple) else value
            takers = " or ".join(x for x in sorted(MASK_SOURCES.built_in) if _takes(x, option))
            raise InputError(
                f'{_flag(option)} {shown} is for --regions {takers}, not for "{name}"; leave one of them out'
            )
    source.check(options)
    return source


def _takes(name: str, option: str) -> bool:
    """Return whether regions take an option."""
    return name not in get_args(FeatureKind) and option in MASK_SOURCES.load(name).options


def _flag(option: str) -> str:
    return f"--{option.replace('_', '-')}"
