"""A feature source from flat options, as command lines and configs hold them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal, get_args

from normlift_ns.encoders.clip_weights import DEFAULT_MODEL, DEFAULT_PRETRAINED
from normlift_ns.encoders.colour import ColourEncoder
from normlift_ns.encoders.crops import Fill
from normlift_ns.encoders.langsplat import LangSplat, Missing
from normlift_ns.encoders.open_clip import OpenClipEncoder
from normlift_ns.encoders.patches import PatchFeatures, why_not_dense
from normlift_ns.encoders.regions import Grid, LabelFiles, Superpixels
from normlift_ns.encoders.sam import SamMasks
from normlift_ns.encoders.sam_weights import DEFAULT_SAM, local_sam
from normlift_ns.encoders.source import Encoder, FeatureSource, RegionFeatures, Regions, TextEncoder
from normlift_ns.encoders.text_vectors import TextVectors

EncoderName = Literal["open_clip", "colour"]
RegionsName = Literal["auto", "sam", "patches", "superpixel", "grid", "files"]
FeaturesName = Literal["none", "langsplat"]


@dataclass(frozen=True)
class SourceOptions:
    """What to see in the images: an encoder, and the regions that it looks at."""

    encoder: EncoderName = "open_clip"
    """open_clip: CLIP features of masked crops, or of patches. colour: mean colours against colour names, without
    learned weights."""
    encoder_model: str = DEFAULT_MODEL
    """Architecture of the open_clip encoder."""
    encoder_pretrained: str = DEFAULT_PRETRAINED
    """Weights of the open_clip encoder: a tag to download, or a local file of that architecture."""
    crop_fill: Fill = "black"
    """What the open_clip encoder sees around a region."""
    text_template: str = "{}"
    """What open_clip reads for a text, which takes the place of {}, such as "a photo of a {}". ensemble: the mean of
    seven. The default is the bare text."""
    regions: RegionsName = "auto"
    """sam: SAM's masks. patches: the patches of a CLIP vision transformer, each with a feature of its own. superpixel,
    grid. files: label maps from regions_dir. auto: files if regions_dir is given, sam if sam_model is; else, for
    open_clip, sam on a GPU if its weights are on this machine, or else patches; superpixel for encoders without."""
    region_count: int | None = None
    """Regions per image, about: of superpixel and grid 256 by default, of patches 1024."""
    sam_model: str | None = None
    """Weights of sam: a folder as transformers writes it, a file as Meta publishes it, or a name to download. By
    default facebook/sam-vit-huge, LangSplat's."""
    regions_dir: Path | None = None
    """Folder with one label map per image, PNG or NPY of the same stem."""
    regions_background: int = 0
    """The value in label maps that means no region; negative values never mean one."""
    regions_resample: bool = False
    """Bring label maps of another size to the image's by nearest neighbour, instead of refusing them."""
    level: str | None = None
    """Which level of regions counts. files: the number of a map in NPY files [levels, H, W]. sam and langsplat: s, m, l
    (subparts, parts, wholes; l by default) or default (all of SAM's masks in one map); langsplat also sum (the vectors
    of all levels added up)."""
    features: FeaturesName = "none"
    """Take regions and features from features_dir instead of looking at images. langsplat: its preprocessing."""
    features_dir: Path | None = None
    """Folder of the features."""
    features_missing: Missing = "error"
    """Images without features: error, or skip to leave them out of the lift."""
    text_vectors: Path | None = None
    """NPZ file, text -> vector, to look texts up in instead of encoding them, for imported features."""


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
        raise ValueError(f"unknown features {options.features!r}; --features is one of {known}")
    if options.features == "none":
        if options.features_dir is not None:
            raise ValueError(f"--features-dir {options.features_dir} is without use; add --features langsplat")
        if options.text_vectors is not None:
            raise ValueError(
                f"--text-vectors {options.text_vectors} is for imported features; add --features langsplat"
            )
        options = replace(options, regions=resolve_regions(options, device))
        if options.regions == "patches":
            return _make_patches(options, device)
        return RegionFeatures(make_regions(options, device), make_encoder(options, device))
    if options.features_dir is None:
        raise ValueError(f"features {options.features!r} need their folder: give it with --features-dir")
    if options.regions != "auto" or options.regions_dir is not None:
        raise ValueError(
            "--regions and --regions-dir cut images up, but --features brings regions of its own; leave one out"
        )
    if options.encoder != "open_clip" and options.text_vectors is None:
        raise ValueError(
            f"encoder {options.encoder!r} did not make the features in {options.features_dir}; name the OpenCLIP model "
            "that did with --encoder-model and --encoder-pretrained, or give --text-vectors"
        )
    level: Any = options.level or "l"
    texts = make_texts(options, device)
    return LangSplat(options.features_dir, texts, level, options.features_missing, options.regions_resample)


def make_texts(options: SourceOptions, device: str = "cpu") -> TextEncoder:
    """The text encoder of the options; arguments and errors as in `make_encoder` and `TextVectors`."""
    return make_encoder(options, device) if options.text_vectors is None else TextVectors(options.text_vectors)


def make_encoder(options: SourceOptions, device: str = "cpu") -> Encoder:
    """The encoder of the options.

    Args:
        device: where a network runs, such as "cuda"; results are on the CPU anyway.
    Raises:
        ValueError: an unknown encoder, model, tag of weights or fill.
        FileNotFoundError: a weight file that does not exist.
    """
    if options.encoder == "open_clip":
        return _make_clip(options, device)
    if options.encoder == "colour":
        if options.text_template != "{}":
            raise ValueError(f"--text-template {options.text_template!r} is for --encoder open_clip; leave it out")
        return ColourEncoder()
    raise ValueError(f"unknown encoder {options.encoder!r}; --encoder is one of {', '.join(get_args(EncoderName))}")


def resolve_regions(options: SourceOptions, device: str = "cpu") -> RegionsName:
    """The regions of the options, "auto" decided.

    Raises:
        ValueError: unknown regions.
    """
    if options.regions not in get_args(RegionsName):
        raise ValueError(f"unknown regions {options.regions!r}; --regions is one of {', '.join(get_args(RegionsName))}")
    if options.regions != "auto":
        return options.regions
    if options.regions_dir is not None:
        return "files"
    if options.sam_model is not None:
        return "sam"
    if options.encoder != "open_clip":
        return "superpixel"
    if device.startswith("cuda") and find_spec("transformers") is not None and local_sam(DEFAULT_SAM) is not None:
        return "sam"
    return "patches" if why_not_dense(options.encoder_model) is None else "superpixel"


def make_regions(options: SourceOptions, device: str = "cpu") -> Regions:
    """The regions of the options, but for patches, which are not to be had without their features.

    Args:
        device: where a network runs, such as "cuda"; results are on the CPU anyway.
    Raises:
        ValueError: unknown regions, "files" without a folder, a folder or a level that the regions have no use for;
            what `SamMasks` raises.
        FileNotFoundError: the folder, or the checkpoint of sam, does not exist.
    """
    kind = resolve_regions(options, device)
    if kind != "sam":
        _refuse(options.sam_model, "--sam-model", kind, "sam")
    if kind == "files":
        if options.regions_dir is None:
            raise ValueError(
                'regions "files" need a folder of label maps, one PNG or NPY file per image: give it with --regions-dir'
            )
        level = _number(options.level)
        return LabelFiles(options.regions_dir, options.regions_background, level, options.regions_resample)
    _refuse(options.regions_dir, "--regions-dir", kind, "files")
    if kind == "sam":
        level: Any = options.level or "l"
        return SamMasks(options.sam_model or DEFAULT_SAM, level, device)
    _refuse(options.level, "--level", kind, "files or sam")
    count = 256 if options.region_count is None else options.region_count
    if kind == "patches":
        raise ValueError("patches are no regions that another encoder could look at; use make_source")
    return Superpixels(count) if kind == "superpixel" else Grid(count)


def _make_patches(options: SourceOptions, device: str) -> PatchFeatures:
    _refuse(options.sam_model, "--sam-model", "patches", "sam")
    _refuse(options.regions_dir, "--regions-dir", "patches", "files")
    _refuse(options.level, "--level", "patches", "files or sam")
    if options.encoder != "open_clip":
        raise ValueError(f"--regions patches are those of --encoder open_clip; {options.encoder!r} has none")
    return PatchFeatures(_make_clip(options, device), 1024 if options.region_count is None else options.region_count)


def _make_clip(options: SourceOptions, device: str) -> OpenClipEncoder:
    return OpenClipEncoder(
        options.encoder_model, options.encoder_pretrained, options.crop_fill, device, options.text_template
    )


def _refuse(value: object, flag: str, kind: str, meant: str) -> None:
    if value is not None:
        raise ValueError(f'{flag} {value} is for --regions {meant}, not for "{kind}"; leave one of the two out')


def _number(level: str | None) -> int | None:
    if level is not None and not (level.isascii() and level.isdigit()):
        raise ValueError(f"--level of --regions files is the number of a map, 0, 1, ...; got {level!r}")
    return None if level is None else int(level)
