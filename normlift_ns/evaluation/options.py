"""Options of the evaluation protocols. Imports no heavy package, to keep --help fast."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from normlift_ns.options import WithoutDirection
from normlift_ns.ranges import check_options

Masking = Literal["background", "auto", "langsplat", "langsplat_composited"]
LANGSPLAT: tuple[Masking, ...] = ("langsplat", "langsplat_composited")
"""Maskings that use LangSplat's relevancy."""
Average = Literal["frames", "pairs", "categories"]
MARGIN = 0.02
"""Lead of a score over every background word (section "Mask thresholding" of the paper; 0 in SFS's code)."""


POSES = 5
"""Largest number of new poses that the coverage study suggests."""


def pose_files(stem: Path) -> tuple[Path, ...]:
    """Return all paths that new poses may be written to: a camera path, and a render of each pose.

    >>> [path.name for path in pose_files(Path("next"))][:2]
    ['next_camera_path.json', 'next_pose_1.png']
    """
    renders = (stem.with_name(f"{stem.name}_pose_{i}.png") for i in range(1, POSES + 1))
    return (stem.with_name(f"{stem.name}_camera_path.json"), *renders)


@dataclass(frozen=True)
class ScannetOptions:
    """Options of --protocol scannet, which needs one *_vh_clean_2.labels.ply per run in --labels."""

    min_opacity: float = 0.1
    """Smallest opacity of a scored Gaussian, in 0..1; larger values score fewer Gaussians, and 0 scores all."""
    without_direction: WithoutDirection = "first"
    """Class of Gaussians without a direction. first: wall, as in published scripts. none: no class. The table also
    has the result of the other choice."""
    spelling: Literal["script", "paper"] = "script"
    """Spelling of the shower curtain prompt. script: showercurtain, as in OpenGaussian's script. paper: shower
    curtain."""

    def __post_init__(self) -> None:
        check_options(self)


@dataclass(frozen=True)
class LerfOptions:
    """Options of --protocol lerf, which needs one folder of label files per run in --labels."""

    masking: Masking = "background"
    """Conversion of scores to a mask. background: scores above all background words by --margin. auto: SFS's
    threshold from the histogram. langsplat: LERF's relevancy of each pixel's unit feature, scaled as in LangSplat.
    langsplat_composited: the same for composited scores, without division by the length of the pixel's feature."""
    margin: float = MARGIN
    """Lead over the best background word for --masking background, in cosine; larger values give smaller masks. SFS's
    code has 0."""
    average: Average = "frames"
    """Order of averaging within a scene; the scenes are averaged last. frames: categories of a frame, then frames.
    pairs: all pairs of frame and category equally. categories: frames of a category, then categories."""
    clean: bool = False
    """Open and close each mask, keep its largest component and fill its holes, as in SFS's code; this empties the image
    border. The paper does not specify it."""
    scale: Literal["unit", "norm"] = "unit"
    """Scores to composite. unit: cosines. norm: cosines times ||f||, as in SFS, whose features are not normalized."""

    def __post_init__(self) -> None:
        check_options(self)


@dataclass(frozen=True)
class MaskOptions:
    """Options of --protocol masks, which needs a folder of PNG or NPY instance masks with the images' names."""

    names: Path | None = None
    """JSON file with the name of every mask value. Default: labels.json next to the mask folder."""
    purity: float = 0.75
    """Smallest share of a Gaussian's weight that must lie in masks of one class to score it, in 0..1; larger values
    score fewer Gaussians."""
    min_weight: float = 1.0
    """Smallest weight of a scored Gaussian, in pixels over all training views, >= 0; larger values score fewer
    Gaussians."""

    def __post_init__(self) -> None:
        check_options(self)
