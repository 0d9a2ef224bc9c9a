"""A feature source from flat options, as command lines and configs hold them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from normlift_ns.encoders.clip_weights import DEFAULT_MODEL, DEFAULT_PRETRAINED
from normlift_ns.encoders.colour import ColourEncoder
from normlift_ns.encoders.open_clip import Fill, OpenClipEncoder
from normlift_ns.encoders.regions import Grid, LabelFiles, Superpixels
from normlift_ns.encoders.source import Encoder, FeatureSource, RegionFeatures, Regions

EncoderName = Literal["open_clip", "colour"]
RegionsName = Literal["auto", "superpixel", "grid", "files"]
FeaturesName = Literal["none", "langsplat"]


@dataclass(frozen=True)
class SourceOptions:
    """What to see in the images: an encoder, and the regions that it looks at."""

    encoder: EncoderName = "open_clip"
    """open_clip: CLIP features of masked crops. colour: mean colours against colour names, without learned weights."""
    encoder_model: str = DEFAULT_MODEL
    """Architecture of the open_clip encoder."""
    encoder_pretrained: str = DEFAULT_PRETRAINED
    """Weights of the open_clip encoder: a tag to download, or a local file of that architecture."""
    crop_fill: Fill = "black"
    """What the open_clip encoder sees around a region."""
    regions: RegionsName = "auto"
    """superpixel, grid, files: label maps from regions_dir. auto: files if regions_dir is given, else superpixel."""
    region_count: int = 256
    """Regions per image, about, of superpixel and grid."""
    regions_dir: Path | None = None
    """Folder with one label map per image, PNG or NPY of the same stem."""
    regions_background: int = 0
    """The value in label maps that means no region; negative values never mean one."""
    regions_resample: bool = False
    """Bring label maps of another size to the image's by nearest neighbour, instead of refusing them."""
    level: str | None = None
    """Which level of regions counts. files: the number of a map in NPY files [levels, H, W]."""
    features: FeaturesName = "none"
    """Take regions and features from features_dir instead of looking at images. langsplat: its preprocessing."""
    features_dir: Path | None = None
    """Folder of the features."""


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
        return RegionFeatures(make_regions(options), make_encoder(options, device))
    if options.features_dir is None:
        raise ValueError(f"features {options.features!r} need their folder: give it with --features-dir")
    raise ValueError("features langsplat cannot be read yet")


def make_encoder(options: SourceOptions, device: str = "cpu") -> Encoder:
    """The encoder of the options, which is all that a text query needs.

    Args:
        device: where a network runs, such as "cuda"; results are on the CPU anyway.
    Raises:
        ValueError: an unknown encoder, model, tag of weights or fill.
        FileNotFoundError: a weight file that does not exist.
    """
    if options.encoder == "open_clip":
        return OpenClipEncoder(options.encoder_model, options.encoder_pretrained, options.crop_fill, device)
    if options.encoder == "colour":
        return ColourEncoder()
    raise ValueError(f"unknown encoder {options.encoder!r}; --encoder is one of {', '.join(get_args(EncoderName))}")


def make_regions(options: SourceOptions) -> Regions:
    """The regions of the options.

    Raises:
        ValueError: unknown regions, "files" without a folder, a folder or a level that the regions have no use for.
        FileNotFoundError: the folder does not exist.
    """
    kind = options.regions
    if kind not in get_args(RegionsName):
        raise ValueError(f"unknown regions {kind!r}; --regions is one of {', '.join(get_args(RegionsName))}")
    if kind == "auto":
        kind = "superpixel" if options.regions_dir is None else "files"
    if kind == "files":
        if options.regions_dir is None:
            raise ValueError(
                'regions "files" need a folder of label maps, one PNG or NPY file per image: give it with --regions-dir'
            )
        level = _number(options.level)
        return LabelFiles(options.regions_dir, options.regions_background, level, options.regions_resample)
    for flag, value in (("--regions-dir", options.regions_dir), ("--level", options.level)):
        if value is not None:
            raise ValueError(f'{flag} {value} is for --regions files, not for "{kind}"; leave one of the two out')
    return Superpixels(options.region_count) if kind == "superpixel" else Grid(options.region_count)


def _number(level: str | None) -> int | None:
    if level is not None and not (level.isascii() and level.isdigit()):
        raise ValueError(f"--level of --regions files is the number of a map, 0, 1, ...; got {level!r}")
    return None if level is None else int(level)
