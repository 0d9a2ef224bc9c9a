"""Options, documents and results of the evaluation protocols."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import msgspec

from normlift_ns.errors import InputError
from normlift_ns.io.atomic import write_text_file
from normlift_ns.io.guard import read_text
from normlift_ns.options import CheckedOptions, WithoutDirection

Masking = Literal["background", "auto", "langsplat", "langsplat_composited"]
LANGSPLAT_MASKINGS: tuple[Masking, ...] = ("langsplat", "langsplat_composited")
"""Maskings that use LangSplat's relevancy."""
AveragingOrder = Literal["frames", "pairs", "categories"]
MASK_MARGIN = 0.02
"""Default lead in cosine over every background word, from section "Mask thresholding" of the paper. The code of Splat
Feature Solver uses 0."""


MAX_SUGGESTED_POSES = 5
"""Maximum number of new poses that the coverage study suggests."""


def pose_output_paths(stem: Path) -> tuple[Path, ...]:
    """Return the paths of all files for new poses: the camera path, and the render of each pose.

    >>> [path.name for path in pose_output_paths(Path("next"))][:2]
    ['next_camera_path.json', 'next_pose_1.png']
    """
    renders = (stem.with_name(f"{stem.name}_pose_{i}.png") for i in range(1, MAX_SUGGESTED_POSES + 1))
    return (stem.with_name(f"{stem.name}_camera_path.json"), *renders)


@dataclass(frozen=True)
class ScannetOptions(CheckedOptions):
    """Options of --protocol scannet, which needs one *_vh_clean_2.labels.ply per run in --labels."""

    min_opacity: float = 0.1
    """Smallest opacity of a scored Gaussian, in 0..1. With larger values, fewer Gaussians are scored."""
    without_direction: WithoutDirection = "first"
    """Class of Gaussians without a direction. first: the class wall, as in published scripts. none: no class. The table
    also shows the result of the other choice."""
    spelling: Literal["script", "paper"] = "script"
    """Spelling of one prompt. script: "showercurtain", as in OpenGaussian's script. paper: "shower curtain"."""


@dataclass(frozen=True)
class LerfOptions(CheckedOptions):
    """Options of --protocol lerf, which needs one folder of label files per run in --labels."""

    masking: Masking = "background"
    """Conversion of scores to masks. background: select pixels whose score exceeds that of every background word by
    more than --margin. auto: apply the threshold of Splat Feature Solver, from the histogram of an image's scores and
    the true number of objects. langsplat: threshold LERF's relevancy of composited features, normalized per pixel, as
    in LangSplat. langsplat_composited: the same relevancy, computed from composited scores."""
    margin: float = MASK_MARGIN
    """Lead over the best background word for --masking background, in cosine. Larger values give smaller masks. The
    code of Splat Feature Solver uses 0."""
    average: AveragingOrder = "frames"
    """Averaging within a scene. frames: average the categories of each frame, then the frames. pairs: average all
    pairs of frame and category. categories: average the frames of each category, then the categories."""
    clean: bool = False
    """Open and close each mask (morphology), keep its largest component and fill its holes, as in the code of Splat
    Feature Solver. The outermost rows and columns of the masks are then empty. The paper does not specify this step."""
    scale: Literal["unit", "norm"] = "unit"
    """Scores to composite. unit: cosines. norm: cosines times ||f||, the norm of the mean feature, as in Splat Feature
    Solver, which does not normalize features."""


@dataclass(frozen=True)
class MaskOptions(CheckedOptions):
    """Options of --protocol masks, which needs a folder of PNG or NPY instance masks in --labels, named like the
    images."""

    names: Path | None = None
    """JSON file with the names of mask values. Other values are ignored. None: labels.json next to the mask folder."""
    purity: float = 0.75
    """Minimum share of a Gaussian's weight that must lie in masks of one class for the Gaussian to be scored, in 0..1.
    Larger values score fewer Gaussians."""
    min_weight: float = 1.0
    """Smallest weight of a scored Gaussian, in pixels over all training views, >= 0. Larger values score fewer
    Gaussians."""


# JSON files of other programs, which are validated against the types that a protocol expects.


PromptText = Annotated[str, msgspec.Meta(pattern=r"(?s)\A(?!.*[\ud800-\udfff]).*\S")]
"""Text of a prompt, which is not blank and has no lone surrogates."""
_Document = TypeVar("_Document")


def read_document(path: Path, kind: type[_Document]) -> _Document:
    """Read a JSON file and convert it to a type.

    Raises:
        ValueError: If the file is missing, too large or not valid JSON, a key is duplicated, or a value has the wrong
            type.
    """
    try:
        text = read_text(path)
        document = json.loads(text, object_pairs_hook=_unique_keys, parse_constant=_reject_constant)
        return msgspec.convert(document, kind)
    except (OSError, ValueError, RecursionError) as error:  # msgspec's errors are ValueErrors
        raise InputError(str(error)) from None


def _unique_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    for key, count in Counter(key for key, _ in pairs).items():
        if count > 1:
            raise InputError(f"the key {key!r} occurs more than once")
    return dict(pairs)


def _reject_constant(text: str) -> float:
    raise InputError(f"{text} is not a valid JSON number")


@dataclass(frozen=True)
class Evaluation:
    """Metrics of one protocol for one or several runs."""

    results: Mapping[str, float]
    """Metrics by name, as in the `results` of an ns-eval file. Shares are in 0..1."""
    rows: Sequence[Mapping[str, Any]]
    """Metrics per class and per scene or frame, as JSON types."""
    settings: Mapping[str, Any]
    """Protocol and its settings."""
    scenes: Sequence[Mapping[str, Any]] = ()
    """Metrics of each scene, if `results` are means over scenes."""


def mean(values: Sequence[float]) -> float:
    """Return the mean of the values that are not NaN, or NaN if there are none.

    >>> mean([1.0, float("nan"), 3.0])
    2.0
    """
    numbers = [value for value in values if not math.isnan(value)]
    return sum(numbers) / len(numbers) if len(numbers) > 0 else float("nan")


def write_evaluation(
    path: Path,
    evaluation: Evaluation,
    runs: Sequence[tuple[str, str]],
    *,
    studies: Mapping[str, Any] | None = None,
    comparison: Mapping[str, Any] | None = None,
    overwrite: bool = False,
) -> None:
    """Write an evaluation as a JSON file in the format of ns-eval.

    The keys settings, scenes, rows, studies and comparison are additional. NaN is written as null.

    Args:
        runs: Name and checkpoint of every run.
    Raises:
        FileExistsError: If the file exists and `overwrite` is False.
    """
    names, checkpoints = (", ".join(values) for values in zip(*runs))
    document: dict[str, Any] = {"experiment_name": names, "method_name": "normlift", "checkpoint": checkpoints}
    document |= {"results": evaluation.results, "settings": evaluation.settings}
    document |= {"scenes": evaluation.scenes} if evaluation.scenes else {}
    document |= {"rows": evaluation.rows} | ({"studies": studies} if studies else {})
    document |= {"comparison": comparison} if comparison else {}
    write_text_file(path, json.dumps(_to_json(document), indent=2, allow_nan=False) + "\n", overwrite=overwrite)


def _to_json(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _to_json(x) for key, x in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [_to_json(x) for x in value]
    return None if isinstance(value, float) and math.isnan(value) else value
