"""Options of the protocols. Imports nothing heavy, so that --help is quick."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from normlift_ns.options import WithoutDirection
from normlift_ns.ranges import check_options

Masking = Literal["background", "auto", "langsplat", "langsplat_composited"]
LANGSPLAT: tuple[Masking, ...] = ("langsplat", "langsplat_composited")
"""Those of the relevancy."""
Average = Literal["frames", "pairs", "categories"]
MARGIN = 0.02
"""By which a score must exceed every background word (section "Mask thresholding" of the paper; SFS's code has 0)."""


POSES = 5
"""New poses that the study of coverage suggests, at most."""


def pose_files(stem: Path) -> tuple[Path, ...]:
    """All files that new poses may be written to: a camera path, and a picture of each.

    >>> [path.name for path in pose_files(Path("next"))][:2]
    ['next_camera_path.json', 'next_pose_1.png']
    """
    pictures = (stem.with_name(f"{stem.name}_pose_{i}.png") for i in range(1, POSES + 1))
    return (stem.with_name(f"{stem.name}_camera_path.json"), *pictures)


@dataclass(frozen=True)
class ScannetOptions:
    """Protocol scannet; --labels gives one *_vh_clean_2.labels.ply per run."""

    min_opacity: float = 0.1
    """Gaussians with a lower opacity are not scored. 0: all are."""
    without_direction: WithoutDirection = "first"
    """Class of Gaussians without a direction: wall (first, as in published scripts) or no class (none). The result of
    the other choice is reported beside it."""
    spelling: Literal["script", "paper"] = "script"
    """How the shower curtain is asked. script: showercurtain, as in OpenGaussian's script. paper: shower curtain."""

    def __post_init__(self) -> None:
        check_options(self)


@dataclass(frozen=True)
class LerfOptions:
    """Protocol lerf; --labels gives one folder of label files per run."""

    masking: Masking = "background"
    """How a mask is cut from scores. background: above all background words by the margin. auto: SFS's threshold from
    the histogram. langsplat: LERF's relevancy of each pixel's unit feature, scaled, as LangSplat does.
    langsplat_composited: the same of composited scores, not divided by the length of the pixel's feature."""
    margin: float = MARGIN
    """Of --masking background. SFS's code has 0."""
    average: Average = "frames"
    """What is averaged first in a scene. frames: the categories of a frame, then frames. pairs: all frames and
    categories alike. categories: the frames of a category, then categories. Then scenes are averaged."""
    clean: bool = False
    """Open, close, keep the largest component and fill its holes, as SFS's code does, which empties the border of the
    image. The paper does not say."""
    scale: Literal["unit", "norm"] = "unit"
    """What is composited. unit: cosines. norm: cosines times ||f||, as in SFS, whose features are not normalised."""

    def __post_init__(self) -> None:
        check_options(self)


@dataclass(frozen=True)
class MaskOptions:
    """Protocol masks; --labels gives a folder of instance masks, PNG or NPY, named as the images."""

    names: Path | None = None
    """JSON file with the name of every value in the masks. By default labels.json beside their folder."""
    purity: float = 0.75
    """A Gaussian is scored if at least this share of its weight lies in the masks of one class."""
    min_weight: float = 1.0
    """A Gaussian is scored if it has at least this weight, in pixels over all training views."""

    def __post_init__(self) -> None:
        check_options(self)
