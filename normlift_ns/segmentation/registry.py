"""Registry of mask sources by `--regions` or `--features` name, and the built-in mask sources.

Each mask source, built-in or from another package, is an entry point of the group `normlift_ns.masks`. This module does
not import torch.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from itertools import takewhile
from typing import TYPE_CHECKING, Any, get_args

from normlift_ns.encoders.registry import encoder_kind, make_encoder, make_texts, with_encoder
from normlift_ns.encoders.weights import EDGES, PackageFile, find_local_sam
from normlift_ns.errors import InputError
from normlift_ns.options import DEFAULT_SAM, DEFAULT_SAM3, MASK_GROUP, FeatureKind, SourceOptions, short_repr
from normlift_ns.registry import Registry

if TYPE_CHECKING:
    from normlift_ns.encoders.base import FeatureSource, Regions

MASK_OPTIONS = ("sam_model", "sam_precision", "sam3_prompts", "regions_dir", "level")
"""Options of `SourceOptions` that only some mask sources accept."""


@dataclass(frozen=True)
class MaskSource:
    """A mask source, as registered by an entry point of the group `normlift_ns.masks`.

    The module of an entry point should import torch only inside `make`, so that errors are reported quickly.

    >>> from normlift_ns.segmentation.registry import MASK_SOURCES
    >>> MASK_SOURCES.load("files").options
    ('regions_dir', 'level')
    """

    make: Callable[[SourceOptions, str], Regions | FeatureSource]
    """Function that creates the regions for options and a device such as "cuda". Weights should be loaded on first
    use."""
    check: Callable[[SourceOptions], None] = lambda options: None
    """Function that raises InputError or FileNotFoundError for unusable options, without importing torch."""
    options: tuple[str, ...] = ()
    """Names from `MASK_OPTIONS` that the source accepts."""
    has_features: bool = False
    """True if `make` returns a `FeatureSource`, which computes or reads the features of its regions itself."""
    weights: PackageFile | None = None
    """Weight file that a lift needs and `ns-normlift-weights` downloads, or None."""


_COUNT, _PATCH_COUNT = 256, 1024
"""Default numbers of regions and of patches per image."""
_LEVELS = ("s", "m", "l", "default")


def _check_level(options: SourceOptions, name: str, levels: Sequence[str]) -> None:
    if options.level is not None and options.level not in levels:
        raise InputError(f"--level must be one of {', '.join(levels)} for {name}, got {short_repr(options.level)}")


def _make(path: str, arguments: Callable[[SourceOptions, str], tuple[Any, ...]]) -> Callable[[SourceOptions, str], Any]:
    """Return a function that imports a class, which needs torch, and creates an instance of it.

    Args:
        path: Module in this package and name of the class, such as "segmentation.sam:SamMasks".
        arguments: Function that returns the arguments of the class for options and a device.
    """
    module, _, name = path.partition(":")
    return lambda options, device: getattr(import_module(f"normlift_ns.{module}"), name)(*arguments(options, device))


_make_sam = _make(
    "segmentation.sam:SamMasks", lambda o, device: (o.sam_model or DEFAULT_SAM, o.level or "l", device, o.sam_precision)
)


SAM_MASKS = MaskSource(
    _make_sam, partial(_check_level, name="sam", levels=_LEVELS), ("sam_model", "sam_precision", "level")
)
"""Masks of SAM, SAM 2 or HQ-SAM for a grid of points."""


_make_sam3 = _make(
    "segmentation.sam3:Sam3Masks",
    lambda o, device: (o.sam3_prompts, o.sam_model or DEFAULT_SAM3, device, o.sam_precision),
)


def _check_sam3(options: SourceOptions) -> None:
    if len(options.sam3_prompts) == 0:
        raise InputError("--regions sam3 needs text prompts; add them with --queries, for example --queries mug plate")


SAM3_MASKS = MaskSource(_make_sam3, _check_sam3, ("sam_model", "sam_precision", "sam3_prompts"))
"""Masks of SAM 3 for text prompts."""


_make_edges = _make("segmentation.edges:EdgeRegions", lambda o, device: (o.level or "m", o.region_count, device))


def _check_edges(options: SourceOptions) -> None:
    _check_level(options, "edges", ("s", "m", "l"))
    if options.level is not None and options.region_count is not None:
        raise InputError(
            f"--level {options.level} and --region-count {options.region_count} both set the number of regions of "
            "--regions edges; leave one of them out"
        )


EDGE_REGIONS = MaskSource(_make_edges, _check_edges, ("level",), weights=EDGES)
"""Regions between learned edges."""


def _make_patches(options: SourceOptions, device: str) -> FeatureSource:
    from normlift_ns.encoders.base import PatchFeatures  # noqa: PLC0415 (needs torch)

    encoder: Any = make_encoder(options, device)
    if not hasattr(encoder, "patches"):
        raise InputError(
            f"--regions patches needs an encoder that can embed patches, but --encoder {with_encoder(options).encoder} "
            "cannot. Use --regions superpixel or --encoder open_clip"
        )
    return PatchFeatures(encoder, options.region_count or _PATCH_COUNT)


PATCHES = MaskSource(_make_patches, has_features=True)
"""Patches of a grid over the image, which the encoder embeds without masks."""


SUPERPIXEL = MaskSource(_make("segmentation.regions:Superpixels", lambda o, device: (o.region_count or _COUNT, device)))
"""Superpixels of color and position."""


GRID = MaskSource(_make("segmentation.regions:Grid", lambda o, _: (o.region_count or _COUNT,)))
"""Grid of square cells."""


_make_files = _make(
    "segmentation.regions:LabelFiles",
    lambda o, _: (o.regions_dir, o.regions_background, None if o.level is None else int(o.level), o.regions_resample),
)


def _check_files(options: SourceOptions) -> None:
    if options.regions_dir is None:
        raise InputError(
            "--regions files needs a folder of label maps, one PNG or NPY file per image; add --regions-dir FOLDER"
        )
    if options.level is not None and not (options.level.isascii() and options.level.isdigit()):
        raise InputError(
            f"--level must be the index of a map (0, 1, ...) for --regions files, got {short_repr(options.level)}"
        )


FILES = MaskSource(_make_files, _check_files, ("regions_dir", "level"))
"""Label maps from a folder."""


_make_langsplat = _make(
    "encoders.langsplat:LangSplat",
    lambda o, device: (o.features_dir, make_texts(o, device), o.level or "l", o.features_missing, o.regions_resample),
)


def _check_langsplat(options: SourceOptions) -> None:
    if options.features_dir is None:
        raise InputError("--features langsplat needs the folder of the features; add --features-dir FOLDER")
    _check_level(options, "langsplat", (*_LEVELS, "sum"))
    if options.regions != "auto" or options.regions_dir is not None:
        flag = "--regions" if options.regions != "auto" else "--regions-dir"
        raise InputError(
            f"{flag} cannot be combined with --features langsplat, which imports its own regions; leave out one of the "
            "two options"
        )
    if not encoder_kind(with_encoder(options).encoder).learned and options.text_embeddings is None:
        raise InputError(
            f"--encoder {options.encoder} did not compute the features in {options.features_dir}; use --encoder "
            "open_clip with the --encoder-model and --encoder-pretrained that did, or give --text-embeddings FILE"
        )


LANGSPLAT = MaskSource(_make_langsplat, _check_langsplat, MASK_OPTIONS, has_features=True)
"""Masks and features from LangSplat's preprocessing."""


MASK_SOURCES = Registry(
    MASK_GROUP,
    {
        "sam": "normlift_ns.segmentation.registry:SAM_MASKS",
        "sam3": "normlift_ns.segmentation.registry:SAM3_MASKS",
        "edges": "normlift_ns.segmentation.registry:EDGE_REGIONS",
        "patches": "normlift_ns.segmentation.registry:PATCHES",
        "superpixel": "normlift_ns.segmentation.registry:SUPERPIXEL",
        "grid": "normlift_ns.segmentation.registry:GRID",
        "files": "normlift_ns.segmentation.registry:FILES",
        "langsplat": "normlift_ns.segmentation.registry:LANGSPLAT",
    },
    MaskSource,
    "mask source",
    "--regions",
    "superpixel",
)
"""Mask sources by name. Those in `FeatureKind` are selected with `--features`, all others with `--regions`."""


def requested_regions(options: SourceOptions) -> str:
    """Return the regions that the options select, or "auto" if they depend on the encoder and the device."""
    if options.regions != "auto":
        return options.regions
    if options.regions_dir is not None:
        return "files"
    return "auto" if options.sam_model is None else "sam"


_PACKAGES = {"sam": "transformers", "edges": "h5py"}
"""Optional packages that regions need."""
_NEXT_ENCODER = {"color": ("imagenet", "object names"), "imagenet": ("open_clip", "words outside ImageNet")}
"""Recommended encoder and its advantage, by the encoder that is selected automatically on this machine."""
_ADVANTAGES = {"sam": "masks of objects", "edges": "regions along outlines"}
"""Advantages of recommended regions."""


def resolve_regions(options: SourceOptions, device: str = "cpu") -> str:
    """Return the regions that the options select, with "auto" replaced by the preferred regions on this machine."""
    name = requested_regions(options)
    return name if name != "auto" else next(filter(_is_here, _preferred_regions(with_encoder(options), device)))


def _preferred_regions(options: SourceOptions, device: str) -> list[str]:
    """Return the regions that "auto" can select for the encoder, in order of preference.

    The result does not depend on the weights on this machine. On a CPU, it excludes SAM, and also edges if the
    encoder can encode patches, but would encode each region as a crop. Twelve crops through CLIP take longer than all
    patches of an image (`python -m research.edges --clip`).
    """
    kind, on_gpu = encoder_kind(options.encoder), device.startswith("cuda")
    if not kind.learned:
        return ["superpixel"]
    patches = kind.has_patches(options)
    edges = on_gpu or kind.pools or not patches
    return [*["sam"] * on_gpu, *["edges"] * edges, "patches" if patches else "superpixel"]


def _is_here(regions: str) -> bool:
    """Return whether the default weights and the packages that regions need are on this machine."""
    if regions in _PACKAGES and find_spec(_PACKAGES[regions]) is None:
        return False
    return EDGES.is_here if regions == "edges" else regions != "sam" or find_local_sam(DEFAULT_SAM) is not None


def resolve_source(options: SourceOptions, device: str = "cpu") -> SourceOptions:
    """Return the options with "auto" replaced by an encoder and regions. Imported features need no regions."""
    options = with_encoder(options)
    return options if options.features != "none" else replace(options, regions=resolve_regions(options, device))


def describe_choice(options: SourceOptions, device: str) -> str | None:
    """Return one line with the automatic encoder and regions, and a command for better weights, if there are any.

    Return None if features are imported, or if neither the encoder nor the regions of a learned encoder are automatic.
    """
    any_encoder, any_regions = options.encoder == "auto", requested_regions(options) == "auto"
    named = not any_encoder and not (any_regions and encoder_kind(options.encoder).learned)
    if named or options.features != "none":
        return None
    chosen = resolve_source(options, device)
    wanted = dict([_NEXT_ENCODER[chosen.encoder]]) if any_encoder and chosen.encoder in _NEXT_ENCODER else {}
    if any_regions:
        encoder = "imagenet" if "imagenet" in wanted else chosen.encoder
        preferred = _preferred_regions(replace(chosen, encoder=encoder), device)
        missing = list(takewhile(lambda name: not _is_here(name), preferred))
        wanted |= {name: _ADVANTAGES[name] for name in missing[-1:]}
    packages = [name for regions, name in _PACKAGES.items() if regions in wanted and find_spec(name) is None]
    install = f"pip install {' '.join(packages)} && " if len(packages) > 0 else ""
    purposes = " and ".join(wanted.values())
    advice = f"; for {purposes}, run: {install}ns-normlift-weights --get {' '.join(wanted)}" if len(wanted) > 0 else ""
    automatic = [f"--encoder {chosen.encoder}"] * any_encoder + [f"--regions {chosen.regions}"] * any_regions
    return f"2D features: {' '.join(automatic)}, chosen automatically{advice}"


def check_mask_options(options: SourceOptions, name: str) -> MaskSource:
    """Check the options of a mask source without importing torch, and return the mask source.

    Raises:
        ValueError: If the name is unknown, an option applies only to other mask sources, or the mask source rejects the
            options.
        FileNotFoundError: If a file of the mask source does not exist.
    """
    source, default = MASK_SOURCES.load(name), SourceOptions()
    for option in MASK_OPTIONS:
        value = getattr(options, option)
        if option not in source.options and value != getattr(default, option):
            shown = " ".join(value) if isinstance(value, tuple) else value
            regions = sorted(set(MASK_SOURCES.built_in).difference(get_args(FeatureKind)))
            *others, last = (x for x in regions if option in MASK_SOURCES.load(x).options)
            takers = f"{', '.join(others)} or {last}" if len(others) > 0 else last
            flag = f"--{option.replace('_', '-')}"
            raise InputError(
                f'{flag} {shown} applies to --regions {takers}, but the regions of this lift are "{name}"; omit '
                f"{flag}, or choose other regions with --regions"
            )
    source.check(options)
    return source
